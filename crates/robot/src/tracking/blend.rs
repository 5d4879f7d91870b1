//! Estimates a view's pose from its most similar mapped frames.
//!
//! The pose is a weighted mean (blend) of the three nearest frames. The size of its error is
//! predicted from the distances of the frames and, above all, from their disagreement. The relation
//! is fitted to the room itself: each sampled frame is queried with itself and its neighbors
//! removed from the map.

use nalgebra::{Matrix5, Matrix6, Vector5, Vector6};
use ndarray::Array2;

use super::PoseWithCovariance;
use super::appearance::part_of;
use seese3_core::adapter::ErrorModel;
use seese3_core::geometry::{Pose, Twist, body_twist, exp};
use seese3_core::index::{Nearest, Neighbor, distance};
use seese3_core::navigation::Navigator;
use seese3_core::room::{FrameId, Timeline};
use seese3_core::statistics::robust_covariance;

/// Number of blended frames.
const BLENDED: usize = 3;
/// Number of nearest frames a blend needs: the blended ones, and one more to compare the distance
/// of the nearest with.
pub const LOOKED_AT: usize = BLENDED + 1;
/// Largest motion from the nearest frame to a blended one, ‖(v, ω)‖, meters and radians mixed.
const SAME_PLACE: f64 = 0.5;
/// Exponent of the inverse-distance weights.
const POWER: i32 = 4;
/// Offset added before logarithms: to distances, in the unit of the coordinates, and to lengths of
/// motions, meters and radians mixed.
const LEAST: f64 = 1e-3;

/// Maximum number of mapped frames that are left out.
const SAMPLES: usize = 300;
/// Exclusion radii in rows, one round each. A last round excludes the whole sequence of the frame.
const LEFT_OUT_ROWS: [u32; 9] = [0, 1, 2, 4, 8, 15, 30, 60, 120];
/// Exclusion radius in rows from which a left-out frame represents an unmapped place.
const UNSEEN_ROWS: u32 = 8;
/// Minimum number of left-out blends for the errors of a room.
const FEWEST_BLENDS: usize = 240;
/// Standard deviation added to each component for errors of the map, meters and radians: 5 mm and
/// 0.3°.
const LEAST_DEVIATION: f64 = 0.005;

/// Index in `predictors` of the log distance to the latent-based pose.
const DISAGREEMENT: usize = 4;

/// Weighted mean of the poses of the frames most similar to a view.
#[derive(Debug, Clone)]
pub struct Blend {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Distance of the nearest frame, in the unit of the coordinates.
    distance: f64,
    /// Predictors of the error size.
    predictors: Vector5<f64>,
}

/// Errors of the blends of one room: their covariance is size² · shape.
#[derive(Debug, Clone)]
pub struct BlendErrors {
    /// Coefficients of the predictors for the log error size.
    coefficients: Vector5<f64>,
    /// Largest predicted size of a left-out blend.
    largest: f64,
    /// Robust covariance of errors divided by their predicted sizes.
    shape: Matrix6<f64>,
}

/// Blend errors of one room for views with and without a latent in distribution.
#[derive(Debug, Clone)]
pub struct ViewErrors {
    /// The latent gives a second pose estimate.
    pub with_latent: BlendErrors,
    /// The latent is not used.
    pub without_latent: BlendErrors,
}

/// Blend of a left-out frame, with the motion from the blend to the frame.
struct LeftOut {
    blend: Blend,
    error: Vector6<f64>,
}

impl Blend {
    /// Blends the frames nearest to a view; `nearest` is in order of distance and not empty.
    /// `second_opinion` is the view's pose by another similarity measure, if there is one.
    pub fn of(navigator: &Navigator, nearest: &[Neighbor], second_opinion: Option<&Pose>) -> Self {
        let poses = navigator.room().poses();
        let first = poses[nearest[0].frame.row()];

        // All motions are relative to the nearest frame.
        let blended = &nearest[..nearest.len().min(BLENDED)];
        let weights: Vec<f64> = blended
            .iter()
            .map(|found| (found.distance + LEAST).powi(-POWER))
            .collect();
        let sum: f64 = weights.iter().sum();
        let motions = blended.iter().map(|found| {
            let motion = body_twist(&first, &poses[found.frame.row()]);
            if motion.is_unique_logarithm() {
                motion.to_vector()
            } else {
                Vector6::zeros()
            }
        });
        let motions: Vec<Vector6<f64>> = motions.collect();
        let weighted = || motions.iter().zip(&weights);

        // Frames at another place than the nearest do not enter the mean, but increase the spread.
        let same_place = || weighted().filter(|(motion, _)| motion.norm() <= SAME_PLACE);
        let sum_here: f64 = same_place().map(|(_, weight)| weight).sum();
        let mean: Vector6<f64> = same_place()
            .map(|(motion, weight)| motion * (weight / sum_here))
            .sum();
        let spread: f64 = weighted()
            .map(|(motion, weight)| (motion - mean).norm_squared() * weight / sum)
            .sum();

        let pose = first * exp(&Twist::from_vector(&mean));
        let disagreement = second_opinion.map_or(0.0, |other| body_twist(&pose, other).norm());

        let distance = nearest[0].distance;
        let last = nearest.get(BLENDED).unwrap_or(&nearest[nearest.len() - 1]);
        let log = |value: f64| (value + LEAST).ln();
        Self {
            pose,
            distance,
            predictors: Vector5::new(
                1.0,
                log(distance),
                log(spread.sqrt()),
                log(distance) - log(last.distance),
                log(disagreement),
            ),
        }
    }

    /// The same blend without the terms that depend on the latent.
    #[must_use]
    pub fn without_latent(mut self) -> Self {
        self.predictors[DISAGREEMENT] = LEAST.ln();
        self
    }

    /// The pose in a room whose errors are not known: with those of the calibration rooms.
    pub fn calibrated(&self, error_model: &ErrorModel) -> PoseWithCovariance {
        PoseWithCovariance {
            pose: self.pose,
            covariance: error_model.match_errors(self.distance).covariance,
        }
    }
}

impl ViewErrors {
    /// Fits both errors to the same blends. `None` if too few frames are mapped.
    pub fn measured(
        navigator: &Navigator,
        likeness: Likeness<'_>,
        mapped: &[FrameId],
    ) -> Option<Self> {
        let mut left_out = left_out_blends(navigator, likeness, mapped);
        let with_latent = BlendErrors::of(&left_out)?;

        for found in &mut left_out {
            found.blend = found.blend.clone().without_latent();
        }
        Some(Self {
            with_latent,
            without_latent: BlendErrors::of(&left_out)?,
        })
    }
}

impl BlendErrors {
    /// How many numbers [`BlendErrors::to_numbers`] gives.
    pub const NUMBERS: usize = 5 + 1 + 36;

    /// The coefficients, the largest size, and the shape row by row.
    pub fn to_numbers(&self) -> Vec<f64> {
        let shape = self.shape.transpose();
        let largest = std::iter::once(&self.largest);
        let numbers = self.coefficients.iter().chain(largest).chain(&shape);
        numbers.copied().collect()
    }

    /// The errors of [`BlendErrors::to_numbers`]; `None` for another number of numbers.
    pub fn of_numbers(numbers: &[f64]) -> Option<Self> {
        (numbers.len() == Self::NUMBERS).then(|| Self {
            coefficients: Vector5::from_column_slice(&numbers[..5]),
            largest: numbers[5],
            shape: Matrix6::from_row_slice(&numbers[6..]),
        })
    }

    /// Fits the errors of a room. `None` if too few frames are mapped.
    pub fn measured(
        navigator: &Navigator,
        likeness: Likeness<'_>,
        mapped: &[FrameId],
    ) -> Option<Self> {
        Self::of(&left_out_blends(navigator, likeness, mapped))
    }

    fn of(left_out: &[LeftOut]) -> Option<Self> {
        if left_out.len() < FEWEST_BLENDS {
            return None;
        }

        let coefficients = size_coefficients(left_out)?;
        let size = |found: &LeftOut| found.blend.predictors.dot(&coefficients).exp();
        let scaled: Vec<Vector6<f64>> = left_out
            .iter()
            .map(|found| found.error / size(found))
            .collect();
        Some(Self {
            coefficients,
            largest: left_out.iter().map(size).fold(0.0, f64::max),
            shape: robust_covariance(&scaled)?,
        })
    }

    /// The pose of a blend with its covariance.
    pub fn pose(&self, blend: &Blend) -> PoseWithCovariance {
        // NaN gets the largest size, to be safe.
        let size = blend.predictors.dot(&self.coefficients).exp();
        let size = if size < self.largest {
            size
        } else {
            self.largest
        };
        let of_map = Matrix6::identity() * LEAST_DEVIATION.powi(2);
        PoseWithCovariance {
            pose: blend.pose,
            covariance: self.shape * size.powi(2) + of_map,
        }
    }
}

/// Least-squares coefficients that predict the log error size.
fn size_coefficients(left_out: &[LeftOut]) -> Option<Vector5<f64>> {
    // The ridge term keeps the system solvable if a predictor is constant.
    let mut moment = Matrix5::identity() * 1e-6;
    let mut product = Vector5::zeros();
    for found in left_out {
        let x = found.blend.predictors;
        moment += x * x.transpose();
        product += x * (found.error.norm() + LEAST).ln();
    }

    Some(moment.cholesky()?.solve(&product))
}

/// Leave-one-out blends of mapped frames, for all exclusion radii.
fn left_out_blends(
    navigator: &Navigator,
    likeness: Likeness<'_>,
    mapped: &[FrameId],
) -> Vec<LeftOut> {
    let every = mapped.len().div_ceil(SAMPLES).max(1);
    let sampled = mapped.iter().step_by(every);
    sampled
        .flat_map(|frame| blends_without(navigator, likeness, mapped, *frame))
        .collect()
}

/// Coordinates of the room's frames in which distance measures dissimilarity, row by frame.
#[derive(Clone, Copy)]
pub struct Likeness<'a> {
    /// Coordinates used for retrieval.
    pub coordinates: &'a Array2<f64>,
    /// Coordinates fitted without one fold of the mapped frames, one array per fold. `None` if
    /// `coordinates` were not fitted to the mapped frames.
    pub without_part: Option<&'a [Array2<f64>]>,
    /// Other coordinates, for a second pose estimate.
    pub second_opinion: Option<&'a Array2<f64>>,
}

/// Distances of all mapped frames from one of them.
fn distances_from(coordinates: &Array2<f64>, mapped: &[FrameId], frame: FrameId) -> Vec<Neighbor> {
    let coordinates = coordinates.as_standard_layout();
    let width = coordinates.ncols();
    let values = coordinates.as_slice().unwrap_or_default();
    let row = |frame: FrameId| &values[frame.row() * width..][..width];

    let here = row(frame);
    let of = |&other: &FrameId| Neighbor {
        frame: other,
        distance: distance(row(other), here),
    };
    mapped.iter().map(of).collect()
}

/// Blends of a mapped frame with their errors, one per exclusion round with enough other frames.
fn blends_without(
    navigator: &Navigator,
    likeness: Likeness<'_>,
    mapped: &[FrameId],
    frame: FrameId,
) -> Vec<LeftOut> {
    let distances = distances_from(likeness.coordinates, mapped, frame);
    let distances_unseen = likeness.without_part.map(|coordinates| {
        let place = mapped.partition_point(|other| other < &frame);
        distances_from(&coordinates[part_of(place, mapped.len())], mapped, frame)
    });
    let second = likeness
        .second_opinion
        .map(|coordinates| distances_from(coordinates, mapped, frame));

    let timeline = navigator.room().timeline();
    let left = |distances: &[Neighbor]| left_by_round(timeline, distances, frame);
    let nearest = left(&distances);
    let nearest_unseen = distances_unseen.as_deref().map(left);
    let nearest_by_second = second.as_deref().map(left);

    let found = |round: usize| {
        // Use the full PCA while neighbors remain in the map; otherwise the PCA without the frame's
        // fold.
        let rows = LEFT_OUT_ROWS.get(round);
        let is_unseen = rows.is_none_or(|&rows| rows >= UNSEEN_ROWS);
        let nearest = match &nearest_unseen {
            Some(unseen) if is_unseen => unseen,
            _ => &nearest,
        };
        let enough = |left: &Vec<Neighbor>| left.len() == LOOKED_AT;

        let second = nearest_by_second.as_ref().map(|by_round| &by_round[round]);
        let second = second.filter(|left| enough(left));
        let second = second.map(|left| Blend::of(navigator, left, None).pose);
        let left = Some(&nearest[round]).filter(|left| enough(left))?;
        let blend = Blend::of(navigator, left, second.as_ref());
        let error = body_twist(&blend.pose, &navigator.room().poses()[frame.row()]);
        let is_known = error.is_unique_logarithm();
        let error = error.to_vector();
        is_known.then_some(LeftOut { blend, error })
    };

    (0..=LEFT_OUT_ROWS.len()).filter_map(found).collect()
}

/// The [`LOOKED_AT`] nearest frames of each round of [`LEFT_OUT_ROWS`], and of the round without the
/// sequence of `frame`; fewer if fewer are left.
fn left_by_round(
    timeline: &Timeline,
    distances: &[Neighbor],
    frame: FrameId,
) -> Vec<Vec<Neighbor>> {
    // A round leaves out at most this many frames, so that the nearest that it leaves are among as many
    // frames more.
    let most_left_out = 2 * LEFT_OUT_ROWS.iter().copied().max().unwrap_or(0) as usize + 1;
    let mut near = distances.to_vec();
    let count = LOOKED_AT + most_left_out;
    if count < near.len() {
        near.select_nth_unstable_by(count, Neighbor::nearer);
        near.truncate(count);
    }
    near.sort_unstable_by(Neighbor::nearer);
    let rounds = LEFT_OUT_ROWS.iter().map(|&rows| {
        let is_left = |other: &&Neighbor| other.frame.0.abs_diff(frame.0) > rows;
        near.iter()
            .filter(is_left)
            .take(LOOKED_AT)
            .copied()
            .collect()
    });

    // A sequence may have any number of frames.
    let mut elsewhere = Nearest::new(LOOKED_AT);
    for other in distances {
        if !timeline.joins(other.frame, frame) {
            elsewhere.offer(*other);
        }
    }
    rounds.chain([elsewhere.found()]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition: the nearest of the frames that a round leaves.
    #[test]
    fn each_round_has_the_nearest_of_what_it_leaves() {
        for count in [3, 10, 245, 246, 400] {
            let timeline = Timeline {
                frame_count: count,
                sequences: (0..count).map(|row| (row / 150) as u32).collect(),
                held_out: Vec::new(),
            };
            // Many distances are equal.
            let distances: Vec<Neighbor> = (0..count)
                .map(|row| Neighbor {
                    frame: FrameId(row as u32),
                    distance: ((row * 7919) % 31) as f64,
                })
                .collect();

            for frame in [0, count / 2, count - 1].map(|row| FrameId(row as u32)) {
                let found = left_by_round(&timeline, &distances, frame);
                let rounds = LEFT_OUT_ROWS.map(Some).into_iter().chain([None]);
                for (rows, found) in rounds.zip(found) {
                    let mut expected = distances.clone();
                    expected.retain(|other| match rows {
                        Some(rows) => other.frame.0.abs_diff(frame.0) > rows,
                        None => !timeline.joins(other.frame, frame),
                    });
                    expected.sort_by(Neighbor::nearer);
                    expected.truncate(LOOKED_AT);
                    assert_eq!(found, expected, "{count} frames, {frame:?}, {rows:?}");
                }
            }
        }
    }
}

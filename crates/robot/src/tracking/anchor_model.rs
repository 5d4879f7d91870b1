//! Estimates a view's pose from its most similar mapped frames, with a covariance calibrated on
//! this room by leave-one-out.
//!
//! The pose is a weighted mean (blend) of the three nearest frames. The size of its error is
//! predicted from the distances of the frames and, above all, from their disagreement. This
//! relation is fitted on the room itself: each sampled frame is queried with itself and its
//! neighbors removed from the map.

use nalgebra::{Matrix5, Matrix6, Vector5, Vector6};
use ndarray::{Array2, ArrayView1};

use super::PoseWithCovariance;
use super::appearance::part_of;
use super::clock::seconds_between;
use seese3_core::adapter::ErrorModel;
use seese3_core::geometry::{Pose, Twist, body_twist, exp};
use seese3_core::index::{Nearest, Neighbour, distance};
use seese3_core::navigation::Navigator;
use seese3_core::room::FrameId;
use seese3_core::statistics::{median, robust_covariance};

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

/// Maximum number of pairs of mapped frames that are left out.
const SAMPLES: usize = 150;
/// Exclusion radii in rows, one round each. A last round excludes the whole sequence of the frame.
const LEFT_OUT_ROWS: [u32; 9] = [0, 1, 2, 4, 8, 15, 30, 60, 120];
/// Exclusion radius in rows from which a left-out frame represents an unmapped place.
const UNSEEN_ROWS: u32 = 8;
/// Number of bins of about equally many blends, by predicted error size.
const STRATA: usize = 8;
/// Minimum number of left-out blends for an anchor model of the room.
const FEWEST_BLENDS: usize = 240;

/// Number of lowest bins with errors that are independent between frames, since they depend on the
/// mapped frames around the view. Chosen on calibration rooms.
const INDEPENDENT_STRATA: usize = 3;
/// Interval of mapped frames, seconds, up to which independent errors average out completely.
/// Chosen on calibration rooms.
const DENSE_STEP_S: f64 = 0.14;
/// Interval of mapped frames, seconds, from which [`LASTING_ON_SPARSE_MAPS`] applies in full: a
/// camera then stays between the same two frames for a while.
const SPARSE_STEP_S: f64 = 0.2;
/// Fraction of the anchor covariance treated as correlated if mapped frames are at least
/// [`SPARSE_STEP_S`] apart.
const LASTING_ON_SPARSE_MAPS: f64 = 0.15;
/// Factors on the covariances of the lowest bins. A camera that passes between mapped frames is
/// nearer to them than a left-out mapped frame to its neighbors. Chosen on calibration rooms.
const SHARE_OF_LOWEST: [f64; 2] = [0.5, 0.7];
/// Standard deviation added to each component for errors of the map, meters and radians: 5 mm and
/// 0.3°.
const LEAST_DEVIATION: f64 = 0.005;
/// Default correlation time of anchor errors, seconds, if the room has no anchor model.
const ASSUMED_MEMORY_S: f64 = 0.5;
/// Maximum factor by which standard deviations grow above the highest bin.
const MOST_GROWTH: f64 = 3.0;
/// Minimum factor by which standard deviations shrink below the lowest bin.
const LEAST_SHRINKAGE: f64 = 0.7;

/// Index in `predictors` of the log distance to the latent-based pose.
const DISAGREEMENT: usize = 4;

/// Weighted mean of the poses of the frames most similar to a view.
#[derive(Debug, Clone)]
pub struct Blend {
    /// `world_from_camera`.
    pose: Pose,
    /// Motion from `pose` to the view, predicted by the adapter.
    read: Vector6<f64>,
    /// Distance of the nearest frame, in the unit of the coordinates.
    distance: f64,
    /// Predictors of the error size.
    predictors: Vector5<f64>,
}

/// A pose estimated from retrieved map frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapAnchor {
    /// `world_from_camera`.
    pub belief: PoseWithCovariance,
    /// Correlation time of anchor errors, seconds.
    pub memory_s: f64,
    /// Fraction of the covariance that does not average out over anchors, 0 to 1.
    pub lasting_share: f64,
}

/// Calibrated errors of blends in one room.
#[derive(Debug, Clone)]
pub struct AnchorModel {
    /// Coefficients of the predictors for the log error size.
    coefficients: Vector5<f64>,
    strata: Vec<Stratum>,
    /// Lasting fraction of the covariance of anchors with independent errors.
    lasting_share: f64,
}

/// Anchor models of one room for views with and without a latent in distribution.
#[derive(Debug, Clone)]
pub struct AnchorModels {
    /// The latent gives a second pose estimate, and the motion from the blend to the view.
    pub with_latent: AnchorModel,
    /// The latent is not used.
    pub without_latent: AnchorModel,
}

/// Bin of blends with similar predicted error size.
#[derive(Debug, Clone)]
struct Stratum {
    /// Predicted error size.
    size: f64,
    /// Shrinkage gain of the predicted motion, 0 to 1.
    gain: f64,
    covariance: Matrix6<f64>,
    memory_s: f64,
}

/// Blend of a left-out frame, with its true error.
struct LeftOut {
    blend: Blend,
    /// Motion from the blend to the frame.
    error: Vector6<f64>,
    /// The error of the next mapped frame.
    next_error: Vector6<f64>,
    /// Time between the two frames, seconds.
    seconds: f64,
}

impl Blend {
    /// Blends the frames nearest to a view; `nearest` is in order of distance and not empty.
    /// `second_opinion` is the view's pose by another similarity measure, if there is one.
    pub fn of(
        navigator: &Navigator,
        nearest: &[Neighbour],
        latent: ArrayView1<'_, f64>,
        second_opinion: Option<&Pose>,
    ) -> Self {
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

        let latents = navigator.latents();
        let read = blended.iter().zip(&weights).map(|(found, weight)| {
            let from = latents.row(found.frame.row());
            let motion = navigator.adapter().motion_without_mean(from, latent);
            motion.to_vector() * (weight / sum)
        });

        let pose = first * exp(&Twist::from_vector(&mean));
        let disagreement = second_opinion.map_or(0.0, |other| body_twist(&pose, other).norm());

        let distance = nearest[0].distance;
        let last = nearest.get(BLENDED).unwrap_or(&nearest[nearest.len() - 1]);
        let log = |value: f64| (value + LEAST).ln();
        Self {
            pose,
            read: read.sum(),
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

    /// `world_from_camera`, without the predicted motion.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// The same blend without the terms that depend on the latent.
    #[must_use]
    pub fn without_latent(mut self) -> Self {
        self.read = Vector6::zeros();
        self.predictors[DISAGREEMENT] = LEAST.ln();
        self
    }

    /// The pose after the predicted motion times `gain`.
    fn pose_with(&self, gain: f64) -> Pose {
        self.pose * exp(&Twist::from_vector(&(self.read * gain)))
    }
}

impl AnchorModel {
    /// Fits the error model of a room. `None` if too few frames are mapped.
    pub fn measured(
        navigator: &Navigator,
        likeness: Likeness<'_>,
        mapped: &[FrameId],
    ) -> Option<Self> {
        Self::of(&left_out_blends(navigator, likeness, mapped))
    }

    /// Fits two error models to the same blends: with the views' latents, and without.
    pub fn measured_with_and_without(
        navigator: &Navigator,
        likeness: Likeness<'_>,
        mapped: &[FrameId],
    ) -> Option<AnchorModels> {
        let mut left_out = left_out_blends(navigator, likeness, mapped);
        let with_latent = Self::of(&left_out)?;

        for found in &mut left_out {
            found.blend = found.blend.clone().without_latent();
        }
        Some(AnchorModels {
            with_latent,
            without_latent: Self::of(&left_out)?,
        })
    }

    fn of(left_out: &[LeftOut]) -> Option<Self> {
        if left_out.len() < FEWEST_BLENDS {
            return None;
        }

        let coefficients = size_coefficients(left_out)?;
        let size = |found: &LeftOut| found.blend.predictors.dot(&coefficients).exp();
        let mut by_size: Vec<(f64, &LeftOut)> =
            left_out.iter().map(|found| (size(found), found)).collect();
        by_size.sort_by(|a, b| a.0.total_cmp(&b.0));

        let mut strata: Vec<Stratum> = Vec::new();
        for part in by_size.chunks(by_size.len().div_ceil(STRATA)) {
            let mut stratum = Stratum::of(part)?;
            let place = strata.len();
            if strata
                .last()
                .is_some_and(|below| stratum.size <= below.size)
            {
                continue;
            }
            stratum.covariance *= SHARE_OF_LOWEST.get(place).copied().unwrap_or(1.0);
            if place < INDEPENDENT_STRATA {
                stratum.memory_s = 0.0;
            }
            strata.push(stratum);
        }

        let steps: Vec<f64> = left_out.iter().map(|found| found.seconds).collect();
        Some(Self {
            coefficients,
            strata,
            lasting_share: lasting_share(median(&steps)),
        })
    }

    /// The anchor of a blend: its pose with the calibrated covariance.
    pub fn anchor(&self, blend: &Blend) -> MapAnchor {
        let size = blend.predictors.dot(&self.coefficients).exp();
        let Stratum {
            gain,
            covariance,
            memory_s,
            ..
        } = self.at(size);

        MapAnchor {
            belief: PoseWithCovariance {
                pose: blend.pose_with(gain),
                covariance,
            },
            memory_s,
            lasting_share: if memory_s > 0.0 {
                1.0
            } else {
                self.lasting_share
            },
        }
    }

    /// Errors at a predicted size, interpolated between the bins in the logarithm of the size.
    fn at(&self, size: f64) -> Stratum {
        let first = &self.strata[0];
        let last = &self.strata[self.strata.len() - 1];
        let scaled = |stratum: &Stratum, factor: f64| Stratum {
            covariance: stratum.covariance * (factor * factor),
            ..stratum.clone()
        };

        // NaN gets the largest errors, to be safe.
        if size.is_nan() {
            return scaled(last, MOST_GROWTH);
        }
        if size >= last.size {
            return scaled(last, (size / last.size).clamp(1.0, MOST_GROWTH));
        }
        if size <= first.size {
            return scaled(first, (size / first.size).max(LEAST_SHRINKAGE));
        }

        let above = self.strata.partition_point(|stratum| stratum.size <= size);
        let (low, high) = (&self.strata[above - 1], &self.strata[above]);
        let share = (size / low.size).ln() / (high.size / low.size).ln();
        let between = |low: f64, high: f64| low + share * (high - low);
        Stratum {
            size,
            gain: between(low.gain, high.gain),
            // A weighted mean of two positive definite matrices is positive definite.
            covariance: low.covariance * (1.0 - share) + high.covariance * share,
            memory_s: between(low.memory_s, high.memory_s),
        }
    }
}

/// The anchor of a blend in a room without an anchor model: with the errors of the calibration
/// rooms.
pub fn calibrated_anchor(error_model: &ErrorModel, blend: &Blend) -> MapAnchor {
    let errors = error_model.anchor_errors(blend.distance);
    MapAnchor {
        belief: PoseWithCovariance {
            pose: blend.pose_with(errors.gain),
            covariance: errors.covariance,
        },
        memory_s: ASSUMED_MEMORY_S,
        lasting_share: 1.0,
    }
}

/// Lasting fraction of independent errors, for a map with frames `step_s` seconds apart.
fn lasting_share(step_s: f64) -> f64 {
    let sparseness = (step_s - DENSE_STEP_S) / (SPARSE_STEP_S - DENSE_STEP_S);
    LASTING_ON_SPARSE_MAPS * sparseness.clamp(0.0, 1.0)
}

impl Stratum {
    /// Fits a bin to blends with their predicted error sizes. `None` if the errors do not span six
    /// dimensions.
    fn of(part: &[(f64, &LeftOut)]) -> Option<Self> {
        let sizes: Vec<f64> = part.iter().map(|(size, _)| *size).collect();

        // Regression slope of true on predicted motions. Meters and radians have similar size here.
        let on_read = |(_, found): &(f64, &LeftOut)| found.error.dot(&found.blend.read);
        let read_on_read = |(_, found): &(f64, &LeftOut)| found.blend.read.norm_squared();
        let slope =
            part.iter().map(on_read).sum::<f64>() / part.iter().map(read_on_read).sum::<f64>();
        let gain = if slope.is_finite() {
            slope.clamp(0.0, 1.0)
        } else {
            0.0
        };

        let rest = |found: &LeftOut| found.error - found.blend.read * gain;
        let residuals: Vec<Vector6<f64>> = part.iter().map(|(_, found)| rest(found)).collect();
        let covariance = robust_covariance(&residuals)?
            + Matrix6::identity() * (LEAST_DEVIATION * LEAST_DEVIATION);

        Some(Self {
            size: median(&sizes),
            gain,
            memory_s: memory(part, &covariance)?,
            covariance,
        })
    }
}

/// Correlation time of errors, seconds, from the correlation between successive frames.
fn memory(part: &[(f64, &LeftOut)], covariance: &Matrix6<f64>) -> Option<f64> {
    let inverse = covariance.cholesky()?.inverse();
    let length = |error: &Vector6<f64>| error.dot(&(inverse * error)).sqrt();

    let mut product = 0.0;
    let mut square = 0.0;
    let mut seconds = 0.0;
    for (_, found) in part {
        // Downweight errors in the tail.
        let weight = (1.0 + length(&found.error).powi(2)).recip();
        product += weight * found.error.dot(&(inverse * found.next_error));
        square += weight * length(&found.error) * length(&found.next_error);
        seconds += found.seconds / part.len() as f64;
    }

    let correlation = (product / square).clamp(0.0, 0.98);
    Some(if correlation > 0.0 {
        -seconds / correlation.ln()
    } else {
        0.0
    })
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

/// Leave-one-out blends of pairs of successive mapped frames, for all exclusion radii.
fn left_out_blends(
    navigator: &Navigator,
    likeness: Likeness<'_>,
    mapped: &[FrameId],
) -> Vec<LeftOut> {
    let room = navigator.room();
    let pairs: Vec<[FrameId; 2]> = mapped
        .windows(2)
        .map(|pair| [pair[0], pair[1]])
        .filter(|[from, to]| room.timeline().joins(*from, *to))
        .collect();

    let mut left_out = Vec::new();
    let every = pairs.len().div_ceil(SAMPLES).max(1);
    for pair in pairs.iter().step_by(every) {
        let rounds = pair.map(|frame| blends_without(navigator, likeness, mapped, frame));
        let [first, second] = rounds;
        let seconds = seconds_between(room, pair[0], pair[1]);

        for (first, second) in first.into_iter().zip(second) {
            if let (Some((blend, error)), Some((_, next_error))) = (first, second) {
                left_out.push(LeftOut {
                    blend,
                    error,
                    next_error,
                    seconds,
                });
            }
        }
    }

    left_out
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
fn distances_from(coordinates: &Array2<f64>, mapped: &[FrameId], frame: FrameId) -> Vec<Neighbour> {
    // Rows of an array in standard layout are slices.
    let coordinates = coordinates.as_standard_layout();
    let row = |frame: FrameId| coordinates.row(frame.row()).to_slice().unwrap_or_default();

    let of = |&other: &FrameId| Neighbour {
        frame: other,
        distance: distance(row(other), row(frame)),
    };
    mapped.iter().map(of).collect()
}

/// Blends of a mapped frame with their errors, one per exclusion round. An element is `None` if too
/// few frames remain.
fn blends_without(
    navigator: &Navigator,
    likeness: Likeness<'_>,
    mapped: &[FrameId],
    frame: FrameId,
) -> Vec<Option<(Blend, Vector6<f64>)>> {
    let distances = distances_from(likeness.coordinates, mapped, frame);
    let distances_unseen = likeness.without_part.map(|coordinates| {
        let place = mapped.partition_point(|other| other < &frame);
        distances_from(&coordinates[part_of(place, mapped.len())], mapped, frame)
    });
    let second = likeness
        .second_opinion
        .map(|coordinates| distances_from(coordinates, mapped, frame));

    let timeline = navigator.room().timeline();
    let rounds = LEFT_OUT_ROWS.map(Some).into_iter().chain([None]);
    let found = |rows: Option<u32>| {
        let is_left = |other: &&Neighbour| match rows {
            Some(rows) => other.frame.0.abs_diff(frame.0) > rows,
            None => !timeline.joins(other.frame, frame),
        };
        let left = |distances: &[Neighbour]| -> Option<Vec<Neighbour>> {
            let mut nearest = Nearest::new(LOOKED_AT);
            for other in distances.iter().filter(is_left) {
                nearest.offer(*other);
            }
            let left = nearest.found();
            (left.len() == LOOKED_AT).then_some(left)
        };

        // Use the full PCA while neighbors remain in the map; otherwise the PCA without the frame's
        // fold.
        let is_unseen = rows.is_none_or(|rows| rows >= UNSEEN_ROWS);
        let distances = match &distances_unseen {
            Some(distances_unseen) if is_unseen => distances_unseen,
            _ => &distances,
        };

        let latents = navigator.latents();
        let latent = latents.row(frame.row());
        let second = second
            .as_deref()
            .and_then(left)
            .map(|left| Blend::of(navigator, &left, latent, None).pose);
        let blend = Blend::of(navigator, &left(distances)?, latent, second.as_ref());
        let error = body_twist(&blend.pose, &navigator.room().poses()[frame.row()]);
        let is_known = error.is_unique_logarithm();
        is_known.then(|| (blend, error.to_vector()))
    };

    rounds.map(found).collect()
}

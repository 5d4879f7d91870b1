//! The pose of a view by the mapped frames that look most like it, and how wrong that is in this
//! very room.
//!
//! The three nearest frames are blended: a view between two mapped frames lies between them. How
//! far off the blend is shows in the distances of the frames, and above all in whether they agree.
//! What that means in this room its own frames tell: each is looked for when it and its neighbours
//! are left out, and its true pose is known.

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

/// Frames that are blended.
const BLENDED: usize = 3;
/// Frames that a blend looks at: those, and one whose distance is compared with the nearest's.
pub const LOOKED_AT: usize = BLENDED + 1;
/// Frames further than this from the nearest are not blended with it, ‖(v, ω)‖, metres and radians
/// mixed.
const SAME_PLACE: f64 = 0.5;
/// A frame's weight falls with this power of its distance.
const POWER: i32 = 4;
/// Added to distances, in the unit of the coordinates, and to lengths of motions, metres and
/// radians mixed, before their logarithms are taken.
const LEAST: f64 = 1e-3;

/// At most so many mapped frames are left out.
const SAMPLES: usize = 150;
/// Rows to each side that are left out with a frame, one round each; in a last round its whole
/// sequence is.
const LEFT_OUT_ROWS: [u32; 9] = [0, 1, 2, 4, 8, 15, 30, 60, 120];
/// A frame with so many rows to each side left out stands for a view of a place that was not
/// mapped.
const UNSEEN_ROWS: u32 = 8;
/// Strata of about as many blends each, by the size that their errors are expected to have.
const STRATA: usize = 8;
/// A room whose frames give fewer blends than this tells nothing of its errors.
const FEWEST_BLENDS: usize = 240;

/// Errors of blends in this many of the strata are independent from frame to frame: they come from
/// which mapped frames a view lies between. Chosen on calibration rooms.
const INDEPENDENT_STRATA: usize = 3;
/// Where mapped frames follow one another faster than this, seconds, such errors average out. Chosen on
/// calibration rooms.
const DENSE_STEP_S: f64 = 0.14;
/// Where they follow more slowly than this, a camera sees the same two frames for a while,
const SPARSE_STEP_S: f64 = 0.2;
/// and this share of the covariance stays, however many views there are.
const LASTING_ON_SPARSE_MAPS: f64 = 0.15;
/// A view of a camera that passes between mapped frames is nearer to them than a mapped frame is to
/// its neighbours: the variances of the lowest strata are this share of what the left-out frames
/// show. Chosen on calibration rooms.
const SHARE_OF_LOWEST: [f64; 2] = [0.5, 0.7];
/// No map is known better than this, metres and radians: five millimetres and a third of a degree.
const LEAST_DEVIATION: f64 = 0.005;
/// Errors are remembered for this long where the room does not tell, seconds.
const ASSUMED_MEMORY_S: f64 = 0.5;
/// Beyond the highest stratum, standard deviations grow with the expected size up to this factor.
const MOST_GROWTH: f64 = 3.0;
/// Below the lowest one they fall to this factor at least.
const LEAST_SHRINKAGE: f64 = 0.7;

/// Which of a blend's predictors tells how far the second opinion is from it.
const DISAGREEMENT: usize = 4;

/// What the frames most like a view say of its pose.
#[derive(Debug, Clone)]
pub struct Blend {
    /// `world_from_camera`.
    pose: Pose,
    /// The motion from there to the view, as the adapter reads it.
    read: Vector6<f64>,
    /// The distance of the nearest frame, in the unit of the coordinates.
    distance: f64,
    /// What the size of the error is expected from.
    predictors: Vector5<f64>,
}

/// A pose that was told by mapped frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapAnchor {
    /// `world_from_camera`.
    pub belief: PoseWithCovariance,
    /// The errors of later anchors of this kind resemble this one's for about so long, seconds.
    pub memory_s: f64,
    /// The share of the covariance that no number of anchors takes away, 0 to 1.
    pub lasting_share: f64,
}

/// How wrong blends are in one room.
#[derive(Debug, Clone)]
pub struct AnchorModel {
    /// Of the predictors, for the logarithm of the size of the error.
    coefficients: Vector5<f64>,
    strata: Vec<Stratum>,
    /// Of anchors whose errors are independent.
    lasting_share: f64,
}

/// How wrong blends are in one room, for views with and without a latent that looks like the room.
#[derive(Debug, Clone)]
pub struct AnchorModels {
    /// The latent gives a second opinion on the place, and the motion from there to the view.
    pub with_latent: AnchorModel,
    /// It gives neither.
    pub without_latent: AnchorModel,
}

/// Blends whose errors are expected to be of about one size.
#[derive(Debug, Clone)]
struct Stratum {
    /// The expected size.
    size: f64,
    /// The share of the read motion to be believed, 0 to 1.
    gain: f64,
    covariance: Matrix6<f64>,
    memory_s: f64,
}

/// A left-out frame's blend, and its true error.
struct LeftOut {
    blend: Blend,
    /// The motion from the blend to the frame.
    error: Vector6<f64>,
    /// The same of the next mapped frame.
    next_error: Vector6<f64>,
    /// The time between the two, seconds.
    seconds: f64,
}

impl Blend {
    /// The blend of the frames nearest to a view, in order of their distance; there is at least
    /// one. `second_opinion` is the pose that the same view has by another measure of likeness, if
    /// there is one.
    pub fn of(
        navigator: &Navigator,
        nearest: &[Neighbour],
        latent: ArrayView1<'_, f64>,
        second_opinion: Option<&Pose>,
    ) -> Self {
        let poses = navigator.room().poses();
        let first = poses[nearest[0].frame.row()];

        // Everything is said in the body frame of the nearest frame.
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

        // Frames of another place than the nearest are no reason to place the view in between, but
        // a reason to doubt.
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

    /// `world_from_camera`, without the read motion.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// The same of a view whose latent says nothing: neither on the place, nor on the motion there.
    #[must_use]
    pub fn without_latent(mut self) -> Self {
        self.read = Vector6::zeros();
        self.predictors[DISAGREEMENT] = LEAST.ln();
        self
    }

    /// The pose when a share of the read motion is believed.
    fn pose_with(&self, gain: f64) -> Pose {
        self.pose * exp(&Twist::from_vector(&(self.read * gain)))
    }
}

impl AnchorModel {
    /// Measures the errors in a room. None if too few of its frames are mapped.
    pub fn measured(
        navigator: &Navigator,
        likeness: Likeness<'_>,
        mapped: &[FrameId],
    ) -> Option<Self> {
        Self::of(&left_out_blends(navigator, likeness, mapped))
    }

    /// Two models of the same blends: with the views' latents, and without them.
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

    /// The pose that a blend tells, and how sure it is.
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

    /// The errors of blends whose errors are expected to be of a size.
    fn at(&self, size: f64) -> Stratum {
        let first = &self.strata[0];
        let last = &self.strata[self.strata.len() - 1];
        let scaled = |stratum: &Stratum, factor: f64| Stratum {
            covariance: stratum.covariance * (factor * factor),
            ..stratum.clone()
        };

        // A size that is not one is answered with the largest errors, the safe answer.
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

/// The pose that a blend tells where the room tells nothing of its errors: with those of the rooms
/// that the adapter was calibrated in.
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

/// The share of independent errors that lasts, in a map with so many seconds from frame to frame.
fn lasting_share(step_s: f64) -> f64 {
    let sparseness = (step_s - DENSE_STEP_S) / (SPARSE_STEP_S - DENSE_STEP_S);
    LASTING_ON_SPARSE_MAPS * sparseness.clamp(0.0, 1.0)
}

impl Stratum {
    /// Of blends with the sizes that their errors are expected to have; none if the errors do not
    /// span six dimensions.
    fn of(part: &[(f64, &LeftOut)]) -> Option<Self> {
        let sizes: Vec<f64> = part.iter().map(|(size, _)| *size).collect();

        // The slope of truth on reading. Errors in metres and radians are of about one size here.
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

/// How long errors are remembered, from how alike those of successive frames are, seconds.
fn memory(part: &[(f64, &LeftOut)], covariance: &Matrix6<f64>) -> Option<f64> {
    let inverse = covariance.cholesky()?.inverse();
    let length = |error: &Vector6<f64>| error.dot(&(inverse * error)).sqrt();

    let mut product = 0.0;
    let mut square = 0.0;
    let mut seconds = 0.0;
    for (_, found) in part {
        // Errors far out in the tail count for little.
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

/// The coefficients that predict the logarithm of the size of errors best, by least squares.
fn size_coefficients(left_out: &[LeftOut]) -> Option<Vector5<f64>> {
    // A little of the identity keeps predictors that do not vary from having any weight.
    let mut moment = Matrix5::identity() * 1e-6;
    let mut product = Vector5::zeros();
    for found in left_out {
        let x = found.blend.predictors;
        moment += x * x.transpose();
        product += x * (found.error.norm() + LEAST).ln();
    }

    Some(moment.cholesky()?.solve(&product))
}

/// Blends of mapped frames, each and the mapped frame after it, when they and their neighbours are
/// left out.
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

/// By what mapped frames are alike: coordinates, row by frame; frames are alike that lie near to
/// one another.
#[derive(Clone, Copy)]
pub struct Likeness<'a> {
    /// Those by which frames are found.
    pub coordinates: &'a Array2<f64>,
    /// For each part of the mapped frames, those that know nothing of the part, if the first were
    /// made from these very frames.
    pub without_part: Option<&'a [Array2<f64>]>,
    /// Others, by which frames are found a second time.
    pub second_opinion: Option<&'a Array2<f64>>,
}

/// How far the mapped frames are from one of them.
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

/// The blends of a mapped frame with their errors, one for each round of what is left out; none
/// where too few frames are left.
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

        // A frame with neighbours is told from them by coordinates that were made for its place.
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

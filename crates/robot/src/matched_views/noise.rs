//! Measures the noise of a map. Trials locate mapped frames as if a part of the map around them
//! were missing; the noise under which their errors are most probable is found.

use nalgebra::{Cholesky, Matrix6, Vector4, Vector6};
use rayon::prelude::*;

use super::absolute_pose::{MapNoise, PoseInformation};
use super::descriptors::unpacked;
use super::keypoint_map::{KeypointMap, MappedKeypoints, Mapping};
use super::matching::{Candidates, ViewKeypoints};
use super::parameters::MatchingParameters;
use super::retrieval::PlaceIndex;
use seese3_core::geometry::{Pose, log};
use seese3_core::statistics::quantile;

/// Maximum number of trials, in all and for each view.
const TRIALS: usize = 300;
const HOLES_PER_VIEW: usize = 4;
/// Minimum number of trials from which a noise is fitted.
const MIN_TRIALS: usize = 30;
/// Largest radius of a hole, units (median depths) plus radians.
const LARGEST_HOLE: f64 = 0.6;
/// The golden ratio: its multiples are evenly spaced modulo 1.
const GOLDEN: f64 = 1.618_033_988_75;
/// Share of the trials whose errors the 95 % ellipsoids hold. The errors have heavier tails than a
/// Gaussian: with 0.95, the 68 % ellipsoids would be too large.
const HELD: f64 = 0.93;
/// The 95 % quantile of χ² with six degrees of freedom.
const CHI_SQUARED_95: f64 = 12.591_587;
/// Degrees of freedom of the Student's t distribution of the errors.
const DEGREES_OF_FREEDOM: f64 = 5.0;
/// The search multiplies or divides each number by this factor, which shrinks when no step helps.
const FIRST_FACTOR: f64 = 2.0;
const LAST_FACTOR: f64 = 1.02;
/// Range of each number, times that of [`MapNoise::TYPICAL`].
const RANGE: [f64; 2] = [0.03, 30.0];

/// An estimated pose and its error.
#[derive(Debug, Clone)]
pub struct Trial {
    /// log(estimated⁻¹ · true), ordered (v, ω).
    pub error: Vector6<f64>,
    /// Information of the matches about the pose.
    pub information: PoseInformation,
}

/// The frames that are missing in a trial: the view's own frame, those within a radius of it and,
/// in some trials, the later or the earlier ones too, as for a robot that leaves the map.
#[derive(Debug, Clone, Copy)]
struct Hole {
    /// Row of the view.
    row: usize,
    /// Units (median depths) plus radians; 0 if only the view's own frame is missing.
    radius: f64,
    missing: Missing,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Missing {
    Near,
    NearOrLater,
    NearOrEarlier,
}

impl Hole {
    /// The holes of all trials: views evenly spaced over the recording. A quarter has the radius 0;
    /// the radii of the others are evenly spaced in their logarithms, from `least` on.
    fn all(frame_count: usize, least: f64) -> impl IndexedParallelIterator<Item = Self> {
        let count = TRIALS.min(HOLES_PER_VIEW * frame_count);
        (0..count).into_par_iter().map(move |trial| {
            let share = (trial as f64 * GOLDEN).fract();
            let radius = least * (LARGEST_HOLE / least).powf(share);
            let (missing, radius) = match trial % 4 {
                0 => (Missing::Near, 0.0),
                1 => (Missing::Near, radius),
                2 => (Missing::NearOrLater, radius),
                _ => (Missing::NearOrEarlier, radius),
            };
            Self {
                row: trial * frame_count / count,
                radius,
                missing,
            }
        })
    }
}

/// Trials with the views whose inliers are enough and spread widely enough for an accepted pose, on
/// the threads of the calling rayon pool. `map` has the frames of `mapping`.
pub fn trials(map: &KeypointMap, mapping: &Mapping<'_>) -> Vec<Trial> {
    let poses: Vec<Pose> = mapping.frames.iter().map(|frame| frame.pose).collect();
    let places = PlaceIndex::of(map);
    let recording = Recording {
        map,
        mapping,
        poses: &poses,
        places: &places,
    };

    let least = recording.smallest_hole();
    let found: Vec<Option<Trial>> = Hole::all(poses.len(), least)
        .map(|hole| recording.trial(hole))
        .collect();
    found.into_iter().flatten().collect()
}

/// A map and the frames that it was made of.
struct Recording<'a> {
    map: &'a KeypointMap,
    mapping: &'a Mapping<'a>,
    /// `world_from_camera`.
    poses: &'a [Pose],
    places: &'a PlaceIndex,
}

impl Recording<'_> {
    /// Median distance of successive frames, units plus radians.
    fn smallest_hole(&self) -> f64 {
        let steps: Vec<f64> = self
            .poses
            .windows(2)
            .map(|pair| self.map.distance(&pair[0], &pair[1]))
            .filter(|&distance| distance > 0.0)
            .collect();
        quantile(&steps, 0.5).map_or(LARGEST_HOLE, |step| step.min(LARGEST_HOLE))
    }

    fn is_in_map(&self, hole: Hole, row: usize) -> bool {
        let distance = self.map.distance(&self.poses[hole.row], &self.poses[row]);
        let is_near = row == hole.row || distance <= hole.radius;
        let is_missing = match hole.missing {
            Missing::Near => is_near,
            Missing::NearOrLater => is_near || row > hole.row,
            Missing::NearOrEarlier => is_near || row < hole.row,
        };
        !is_missing
    }

    /// Locates the view of a hole with the frames outside the hole.
    fn trial(&self, hole: Hole) -> Option<Trial> {
        let view = &self.mapping.frames[hole.row];
        let parameters = MatchingParameters::default();
        let is_used = |row: usize| self.is_in_map(hole, row);
        let similar = self.places.nearest_among(
            unpacked(&self.map.basis.compress(view.keypoints)).view(),
            parameters.more_frames,
            &is_used,
        );

        // Depths depend on the neighbors that are left, so that the frames are mapped again.
        let mut map = KeypointMap {
            basis: self.map.basis.clone(),
            frames: vec![MappedKeypoints::default(); self.poses.len()],
            ..*self.map
        };
        for &row in &similar {
            map.frames[row] = self.mapping.map_frame(row, &is_used);
        }

        let found = map.match_view(
            ViewKeypoints {
                keypoints: view.keypoints,
                camera: &map.camera,
            },
            Candidates::Listed(&similar),
            self.poses,
            &parameters,
        )?;

        // Without an information matrix that can be inverted, an error has no likelihood.
        let is_determined = Cholesky::new(found.information.independent).is_some();
        (is_determined && found.is_supported(&parameters)).then(|| Trial {
            error: log(&found.pose.inv_mul(&view.pose)).to_vector(),
            information: found.information,
        })
    }
}

/// The noise under which the errors of the trials are most probable, scaled so that the 95 %
/// ellipsoids hold 93 % of them; `None` if there are too few trials.
pub fn fitted_noise(trials: &[Trial]) -> Option<MapNoise> {
    if trials.len() < MIN_TRIALS {
        return None;
    }

    let noise_at = |logarithms: Vector4<f64>| MapNoise {
        design_effect: MapNoise::TYPICAL.design_effect * logarithms.x.exp(),
        gap_scale: MapNoise::TYPICAL.gap_scale * logarithms.y.exp(),
        pose_noise: MapNoise::TYPICAL.pose_noise * logarithms.z.exp(),
        relative_error: MapNoise::TYPICAL.relative_error * logarithms.w.exp(),
    };
    let [least, most] = RANGE.map(f64::ln);

    // Compass search: the likelihood is cheap and has few parameters.
    let mut at = Vector4::zeros();
    let mut cost = negative_log_likelihood(trials, &noise_at(at));
    let mut step = FIRST_FACTOR.ln();
    while step > LAST_FACTOR.ln() {
        let tried = (0..8).map(|direction| {
            let mut moved = at;
            let change = if direction % 2 == 0 { step } else { -step };
            moved[direction / 2] = (moved[direction / 2] + change).clamp(least, most);
            (negative_log_likelihood(trials, &noise_at(moved)), moved)
        });
        match tried.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((lower, moved)) if lower < cost => {
                cost = lower;
                at = moved;
            }
            _ => step /= 2.0,
        }
    }

    // Scale the noise by the tail of the trials' errors.
    let noise = noise_at(at);
    let squared: Vec<f64> = trials
        .iter()
        .map(|trial| squared_length(trial, &noise).unwrap_or(f64::INFINITY))
        .collect();
    let factor = quantile(&squared, HELD)? / CHI_SQUARED_95;

    Some(if factor.is_finite() && factor > 0.0 {
        noise.scaled(factor)
    } else {
        noise
    })
}

/// Negative logarithm of the likelihood of the errors, up to a constant.
fn negative_log_likelihood(trials: &[Trial], noise: &MapNoise) -> f64 {
    let nu = DEGREES_OF_FREEDOM;
    trials
        .iter()
        .map(|trial| {
            // Student's t with the given covariance.
            let shape = trial
                .information
                .covariance(noise)
                .and_then(|covariance| Cholesky::new(covariance * ((nu - 2.0) / nu)));
            shape.map_or(f64::INFINITY, |shape: Cholesky<f64, nalgebra::U6>| {
                let squared = trial.error.dot(&shape.solve(&trial.error));
                let log_determinant: f64 = 2.0 * shape.l_dirty().diagonal().map(f64::ln).sum();
                0.5 * log_determinant + 0.5 * (nu + 6.0) * (squared / nu).ln_1p()
            })
        })
        .sum()
}

/// Squared Mahalanobis length of a trial's error.
pub fn squared_length(trial: &Trial, noise: &MapNoise) -> Option<f64> {
    let covariance: Matrix6<f64> = trial.information.covariance(noise)?;
    Some(
        trial
            .error
            .dot(&Cholesky::new(covariance)?.solve(&trial.error)),
    )
}

impl KeypointMap {
    /// Replaces the noise by the one measured in trials; keeps it if there are too few trials. The
    /// map has the frames of `mapping`.
    pub fn measure_noise(&mut self, mapping: &Mapping<'_>) {
        if let Some(noise) = fitted_noise(&trials(self, mapping)) {
            self.noise = noise;
        }
    }
}

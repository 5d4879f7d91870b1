//! Measures the noise of a map: trials map a part of its frames, estimate the poses of the others,
//! and the noise under which the errors are most probable is found.

use nalgebra::{Cholesky, Matrix6, Vector4, Vector6};

use super::absolute_pose::{MapNoise, PoseInformation};
use super::keypoint_map::{KeypointMap, Mapping};
use super::matching::{Candidates, ViewKeypoints};
use super::parameters::{MappingParameters, MatchingParameters};
use super::retrieval::PlaceIndex;
use seese3_core::geometry::{CameraIntrinsics, Pose, log};
use seese3_core::keypoints::Keypoints;

/// Number of views of each trial.
const VIEWS: usize = 80;
/// Minimum number of trial views from which a noise is fitted.
const MIN_TRIALS: usize = 30;
/// Degrees of freedom of the Student's t distribution of the errors.
const DEGREES_OF_FREEDOM: f64 = 5.0;
/// The search multiplies or divides each number by this factor, which shrinks when no step helps.
const FIRST_FACTOR: f64 = 2.0;
const LAST_FACTOR: f64 = 1.02;
/// Range of each number, times that of [`MapNoise::TYPICAL`].
const RANGE: [f64; 2] = [0.03, 30.0];

/// A recording from which trials are made. All slices have one entry per frame.
#[derive(Debug, Clone, Copy)]
pub struct TrialRecording<'a> {
    /// `world_from_camera`.
    pub poses: &'a [Pose],
    /// Keypoints.
    pub keypoints: &'a [Keypoints],
    /// The camera.
    pub camera: CameraIntrinsics,
}

/// An estimated pose and its error.
#[derive(Debug, Clone)]
pub struct Trial {
    /// log(estimated⁻¹ · true), ordered (v, ω).
    pub error: Vector6<f64>,
    /// Information of the matches about the pose.
    pub information: PoseInformation,
}

/// Which frames a trial leaves out of its map, besides every second frame, and which views it asks
/// for.
///
/// Views within a gap have mapped frames on both sides. Beyond an end of the map they have them on one
/// side, like those of a robot that leaves the map, and their errors are larger.
#[derive(Debug, Clone, Copy)]
enum LeftOut {
    /// Nothing else; every second frame is asked for.
    Interleaved,
    /// Every fifth of this many blocks, from the given one on.
    Blocks { count: usize, first: usize },
    /// The last two fifths; the first half of them is asked for.
    End,
    /// The first two fifths; the last half of them is asked for.
    Beginning,
}

/// Trials with small and with large gaps in the map.
const PATTERNS: [LeftOut; 5] = [
    LeftOut::Interleaved,
    LeftOut::Blocks {
        count: 20,
        first: 0,
    },
    LeftOut::Blocks {
        count: 10,
        first: 3,
    },
    LeftOut::End,
    LeftOut::Beginning,
];

impl LeftOut {
    /// Whether a frame is in the map.
    fn maps(self, row: usize, frame_count: usize) -> bool {
        let fifth = row * 5 / frame_count;
        let is_kept = match self {
            Self::Interleaved => true,
            Self::Blocks { count, first } => row * count / frame_count % 5 != first,
            Self::End => fifth < 3,
            Self::Beginning => fifth >= 2,
        };
        is_kept && row.is_multiple_of(2)
    }

    /// Whether the trial asks for a frame.
    fn asks(self, row: usize, frame_count: usize) -> bool {
        let fifth = row * 5 / frame_count;
        match self {
            Self::Interleaved => row % 2 == 1,
            Self::Blocks { count, first } => row * count / frame_count % 5 == first,
            Self::End => fifth == 3,
            Self::Beginning => fifth == 1,
        }
    }
}

/// Trials of all patterns with the views whose inliers are enough and spread widely enough for an
/// accepted pose.
pub fn trials(recording: TrialRecording<'_>) -> Vec<Trial> {
    PATTERNS
        .iter()
        .flat_map(|&pattern| trials_of(recording, pattern))
        .collect()
}

fn trials_of(recording: TrialRecording<'_>, pattern: LeftOut) -> Vec<Trial> {
    let TrialRecording {
        poses,
        keypoints,
        camera,
    } = recording;
    let frame_count = poses.len();
    let rows = |keep: &dyn Fn(usize) -> bool| (0..frame_count).filter(|&row| keep(row)).collect();
    let mapped: Vec<usize> = rows(&|row| pattern.maps(row, frame_count));
    let asked: Vec<usize> = rows(&|row| pattern.asks(row, frame_count));

    let mapped_poses: Vec<Pose> = mapped.iter().map(|&row| poses[row]).collect();
    let mapped_keypoints: Vec<Keypoints> =
        mapped.iter().map(|&row| keypoints[row].clone()).collect();
    let Ok(mapping) = Mapping::new(
        &mapped_poses,
        &mapped_keypoints,
        camera,
        MappingParameters::default(),
    ) else {
        return Vec::new();
    };

    let map = mapping.map(&|| ());
    let places = PlaceIndex::of(&map);
    let parameters = MatchingParameters::default();
    let every = asked.len().div_ceil(VIEWS).max(1);
    asked
        .iter()
        .step_by(every)
        .filter_map(|&row| {
            let found = map.match_view(
                ViewKeypoints {
                    keypoints: &keypoints[row],
                    camera: &camera,
                },
                Candidates::Similar(&places),
                &mapped_poses,
                &parameters,
            )?;

            found.is_supported(&parameters).then(|| Trial {
                error: log(&found.pose.inv_mul(&poses[row])).to_vector(),
                information: found.information,
            })
        })
        .collect()
}

/// The noise under which the errors of the trials are most probable; `None` if there are too few
/// trials.
pub fn fitted_noise(trials: &[Trial]) -> Option<MapNoise> {
    if trials.len() < MIN_TRIALS {
        return None;
    }

    let noise_at = |logarithms: Vector4<f64>| MapNoise {
        design_effect: MapNoise::TYPICAL.design_effect * logarithms.x.exp(),
        gap_scale: MapNoise::TYPICAL.gap_scale * logarithms.y.exp(),
        pose_noise: MapNoise::TYPICAL.pose_noise * logarithms.z.exp(),
        pose_drift: MapNoise::TYPICAL.pose_drift * logarithms.w.exp(),
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

    Some(noise_at(at))
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
    /// Replaces the noise by the one measured in trials; keeps it if there are too few trials.
    pub fn measure_noise(&mut self, recording: TrialRecording<'_>) {
        if let Some(noise) = fitted_noise(&trials(recording)) {
            self.noise = noise;
        }
    }
}

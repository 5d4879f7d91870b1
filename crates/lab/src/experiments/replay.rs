//! A stream that was replayed: ground truth and answers.

use seese3_core::geometry::{Pose, PoseError, body_twist, log};
use seese3_core::room::{FrameId, Room};
use seese3_core::trajectory::Trajectory;
use seese3_robot::tracking::{ASSUMED_PERIOD_S, Status, Update, seconds_between};

/// Largest position error of a successful relocalization, meters.
const FOUND_WITHIN_M: f64 = 0.5;
/// Largest rotation error of a successful relocalization, degrees.
const FOUND_WITHIN_DEG: f64 = 15.0;

/// Initial pose of a replayed stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InitialPose {
    /// The true pose, with standard deviations of 1 mm and 1 mrad.
    Given,
    /// No initial pose.
    Unknown,
}

/// A replayed stream: ground truth and tracker output.
#[derive(Debug, Clone)]
pub struct Replay {
    /// Ground truth, one pose per update.
    pub truth: Trajectory,
    /// Sequence numbers of the frames, with gaps for rows that were left out.
    pub sequences: Vec<u64>,
    /// Tracker output, one update per accepted frame.
    pub updates: Vec<Update>,
    /// First row of each stream, in order; the first is 0.
    pub beginnings: Vec<usize>,
}

/// Joins several streams into one replay. Each comes with its mean frame period, nanoseconds.
pub fn joined(streams: impl Iterator<Item = (Replay, i64)>) -> Replay {
    let mut joined = Replay {
        truth: Trajectory::default(),
        sequences: Vec::new(),
        updates: Vec::new(),
        beginnings: Vec::new(),
    };

    for (replayed, period_ns) in streams {
        // Continue numbers and times from stream to stream, so that they are unique.
        let number = joined.sequences.last().map_or(0, |last| last + 1);
        let time = joined
            .truth
            .times_ns
            .last()
            .map_or(0, |last| last + period_ns);
        joined.beginnings.push(joined.updates.len());
        joined.truth.poses.extend(replayed.truth.poses);
        let times = replayed.truth.times_ns.into_iter();
        joined.truth.times_ns.extend(times.map(|at| at + time));
        let numbers = replayed.sequences.into_iter();
        joined.sequences.extend(numbers.map(|at| at + number));
        joined
            .updates
            .extend(replayed.updates.into_iter().map(|update| Update {
                keyframe_sequence: update.keyframe_sequence + number,
                ..update
            }));
    }

    joined
}

/// Mean time between successive rows of a recording, nanoseconds; [`ASSUMED_PERIOD_S`] if there are
/// no usable timestamps.
pub fn period_ns(room: &Room, frames: &[FrameId]) -> i64 {
    let assumed = (ASSUMED_PERIOD_S * 1e9).round() as i64;
    let (Some(&first), Some(&last)) = (frames.first(), frames.last()) else {
        return assumed;
    };

    let rows = f64::from(last.0 - first.0).max(1.0);
    let period = seconds_between(room, first, last) / rows * 1e9;
    if period >= 1.0 {
        period.round() as i64
    } else {
        assumed
    }
}

/// The map poses of a replay.
#[derive(Debug, Clone)]
pub struct MapPath {
    /// Reported `map_from_camera`, including frames with status LOST or RELOCALIZING.
    pub path: Trajectory,
    /// The rows of those frames in the replay.
    pub rows: Vec<usize>,
}

/// Error of one predicted motion, normalized by its reported covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionSurprise {
    /// Length of the predicted motion, ‖(v, ω)‖, meters and radians mixed.
    pub length: f64,
    /// Squared Mahalanobis length of the error.
    pub squared_error: f64,
}

impl Replay {
    /// Reported `map_from_camera`, including frames with status LOST or RELOCALIZING.
    pub fn map_path(&self) -> MapPath {
        let mut path = Trajectory::default();
        let mut rows = Vec::new();
        for (row, update) in self.updates.iter().enumerate() {
            if let Some(map_pose) = &update.map_pose {
                path.times_ns.push(self.truth.times_ns[row]);
                path.poses.push(map_pose.pose);
                rows.push(row);
            }
        }

        MapPath { path, rows }
    }

    /// `odom_from_camera`, transformed so that each stream starts at its true first pose.
    pub fn odom_path(&self) -> Trajectory {
        let updates = self.updates.iter().enumerate();
        let poses = updates.map(|(row, update)| self.first_pose(row) * update.odom.pose);

        Trajectory {
            times_ns: self.truth.times_ns.clone(),
            poses: poses.collect(),
        }
    }

    /// The true first pose of the stream that a row belongs to.
    pub fn first_pose(&self, row: usize) -> Pose {
        let streams = self
            .beginnings
            .partition_point(|&beginning| beginning <= row);
        let beginning = self.beginnings[streams.max(1) - 1];
        self.truth.poses[beginning]
    }

    /// Squared Mahalanobis lengths of the errors of the map poses in rows selected by `keep`.
    pub fn map_pose_surprises_where(&self, keep: impl Fn(usize) -> bool) -> Vec<f64> {
        let mut surprises = Vec::new();
        for (row, (update, truth)) in self.updates.iter().zip(&self.truth.poses).enumerate() {
            if keep(row)
                && let Some(map_pose) = &update.map_pose
            {
                let error = log(&map_pose.pose.inv_mul(truth)).to_vector();
                surprises.extend(squared_mahalanobis(&error, &map_pose.covariance));
            }
        }

        surprises
    }

    /// Errors of all motions from their keyframes, except motions of exactly zero.
    pub fn motion_surprises(&self) -> Vec<MotionSurprise> {
        let mut surprises = Vec::new();
        for (update, truth) in self.updates.iter().zip(&self.truth.poses) {
            let Ok(keyframe) = self.sequences.binary_search(&update.keyframe_sequence) else {
                continue;
            };

            // A motion of exactly zero is that of the keyframe itself.
            let length = update.motion.norm();
            if length > 0.0 {
                let true_motion = body_twist(&self.truth.poses[keyframe], truth);
                let error = true_motion.to_vector() - update.motion.to_vector();
                let squared_error = squared_mahalanobis(&error, &update.motion_covariance);
                surprises.extend(squared_error.map(|squared_error| MotionSurprise {
                    length,
                    squared_error,
                }));
            }
        }

        surprises
    }

    /// Fraction of frames with a status.
    pub fn share(&self, status: Status) -> f64 {
        let has_status = |update: &&Update| update.status == status;
        self.updates.iter().filter(has_status).count() as f64 / self.updates.len() as f64
    }

    /// Number of frames until the tracker was TRACKING within 0.5 m and 15° of the truth; `None` if
    /// it never was.
    pub fn frames_to_relocalize(&self) -> Option<usize> {
        let is_found = |(update, truth): (&Update, &Pose)| {
            let Some(map_pose) = &update.map_pose else {
                return false;
            };
            let error = PoseError::between(&map_pose.pose, truth);

            update.status == Status::Tracking
                && error.translation_m <= FOUND_WITHIN_M
                && error.rotation_rad <= FOUND_WITHIN_DEG.to_radians()
        };

        let mut answers = self.updates.iter().zip(&self.truth.poses);
        answers.position(is_found).map(|row| row + 1)
    }
}

/// eᵀ Σ⁻¹ e; `None` if Σ is not positive definite.
fn squared_mahalanobis(
    error: &nalgebra::Vector6<f64>,
    covariance: &nalgebra::Matrix6<f64>,
) -> Option<f64> {
    Some(error.dot(&covariance.cholesky()?.solve(error)))
}

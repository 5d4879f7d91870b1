//! The part of a stream's state that a resume token holds.

use nalgebra::Matrix6;

use super::state::LastView;
use super::{Belief, Contradicted, FilterState, PoseFilter};
use crate::tracking::PoseWithCovariance;
use seese3_core::geometry::{Pose, Twist};

/// Number of entries of the upper triangle of a 6 × 6 matrix.
const TRIANGLE: usize = 21;
/// Relative growth of saved variances: covariances stay positive definite in single precision.
const ROUNDING: f64 = 1e-5;

/// The pose and velocity of a stream with their covariances, and its status.
///
/// The pose is in double precision. Covariances are in single precision, without the correlation of
/// pose and velocity. Odometry frame, keyframe, candidates and sensor errors are not saved.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SavedState {
    /// The room of the pose, an index of the filter's rooms.
    pub room: Option<usize>,
    /// `world_from_camera`, with the covariance of δ in true = pose · exp(δ), if it is known.
    pose: Option<SavedPose>,
    last: Option<LastView>,
    located_ns: Option<i64>,
    contradicted: Contradicted,
    unchanged_frames: u32,
    is_carried: bool,
    gravity_ns: Option<i64>,
}

#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
struct SavedPose {
    pose: Pose,
    pose_covariance: SavedCovariance,
    velocity: Twist,
    velocity_covariance: SavedCovariance,
}

/// The upper triangle of a covariance, row by row.
type SavedCovariance = [f32; TRIANGLE];

impl FilterState {
    /// The part of the state that a resume token holds.
    pub fn saved(&self) -> SavedState {
        let belief = self.belief.filter(|_| self.is_placed);
        SavedState {
            room: self.room,
            pose: belief.map(|belief| SavedPose {
                pose: belief.pose,
                pose_covariance: triangle(&belief.place().covariance),
                velocity: belief.velocity,
                velocity_covariance: triangle(&belief.velocity_covariance()),
            }),
            last: self.last,
            located_ns: self.located_ns,
            contradicted: self.contradicted,
            unchanged_frames: self.unchanged_frames,
            is_carried: self.is_carried,
            gravity_ns: self.gravity_ns,
        }
    }
}

impl PoseFilter {
    /// The state of a stream that goes on elsewhere, in the same room. Its odometry begins anew.
    pub fn resumed(&self, saved: &SavedState) -> FilterState {
        let belief = saved.pose.as_ref().map(|saved_pose| {
            let place = PoseWithCovariance {
                pose: saved_pose.pose,
                covariance: matrix(&saved_pose.pose_covariance),
            };
            let prior = &self.rooms[saved.room.unwrap_or(0)].motion_prior;
            Belief::at(&place, prior, 0.0).with_velocity(
                saved_pose.velocity,
                &matrix(&saved_pose.velocity_covariance),
            )
        });
        FilterState {
            is_placed: belief.is_some(),
            belief,
            last: saved.last,
            located_ns: saved.located_ns,
            contradicted: saved.contradicted,
            unchanged_frames: saved.unchanged_frames,
            is_carried: saved.is_carried,
            gravity_ns: saved.gravity_ns,
            ..FilterState::in_room(saved.room)
        }
    }
}

fn entries() -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(|row| (row..6).map(move |column| (row, column)))
}

fn triangle(covariance: &Matrix6<f64>) -> SavedCovariance {
    let mut saved = [0.0; TRIANGLE];
    for (to, at) in saved.iter_mut().zip(entries()) {
        *to = covariance[at] as f32;
    }
    saved
}

fn matrix(saved: &SavedCovariance) -> Matrix6<f64> {
    let mut covariance = Matrix6::zeros();
    for (&value, (row, column)) in saved.iter().zip(entries()) {
        let growth = if row == column { 1.0 + ROUNDING } else { 1.0 };
        covariance[(row, column)] = f64::from(value) * growth;
        covariance[(column, row)] = covariance[(row, column)];
    }
    covariance
}

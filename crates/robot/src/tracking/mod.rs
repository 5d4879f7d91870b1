//! Poses with covariances, and the retrieval of a view's most similar mapped frames.
//!
//! - A [`PoseWithCovariance`] is a pose with the covariance of its error in its own body frame, on
//!   (v, ω).
//! - A [`Map`] estimates the pose of a view from the mapped frames that are most similar to it.
//! - [`relocalize`] finds the room that a few views show, and the pose in it.
//! - An [`Update`] is what a stream answers to a frame; [`crate::pose_filter`] makes it.

mod appearance;
mod blend;
mod clock;
mod map;
mod measured_pose;
mod motion_prior;
mod pose_with_covariance;
mod relocalize;
mod update;
mod view;

pub use clock::{ASSUMED_PERIOD_S, frame_period_s, seconds_between};
pub(crate) use map::extent_m;
pub use map::{FeatureTables, Map, MapMatch, MapQuery, MapTables, PoseReader};
pub use measured_pose::{Drift, MeasuredPose, OdometryDelta};
pub use motion_prior::MotionPrior;
pub(crate) use pose_with_covariance::PLACE_DEVIATION_M;
pub use pose_with_covariance::PoseWithCovariance;
pub use relocalize::{
    ROOM_RATIO, Relocalization, RoomMatch, joint_map_index, relocalize, relocalize_jointly,
};
pub use update::{BestMatch, Candidate, Refusal, Sensor, Status, Update};
pub use view::{View, motion};

use seese3_core::room::RoomId;

/// Why a room cannot be mapped or a camera cannot be relocalized.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No room was given.
    #[error("at least one room is needed")]
    NoMap,
    /// No view was given.
    #[error("at least one view is needed")]
    NoView,
    /// The caller cancelled the request.
    #[error("cancelled")]
    Cancelled,
    /// The maps have different adapters.
    #[error("the rooms have different adapters: their latents are not comparable")]
    Adapters,
    /// The adapter has no error model.
    #[error(
        "the adapter is not calibrated for tracking: its errors were not measured in two or more rooms outside its \
         training (train --calibrate-on)"
    )]
    NotCalibrated,
    /// No mapped frame has a distinct match outside its temporal neighborhood.
    #[error(
        "room '{room}' has {frames} mapped frames: too few distinct frames that are not neighbors in time"
    )]
    SmallMap {
        /// The room.
        room: RoomId,
        /// Number of mapped frames.
        frames: usize,
    },
}

//! Tracking: estimates a camera's motion, and its pose in a mapped room.
//!
//! - [`motion`] estimates the motion between two views.
//! - [`relocalize`] finds the room that a few views show, and the pose in it.
//! - A [`Tracker`] tracks a stream of frames; all state of a stream is in a [`State`].
//! - [`replay`] runs a recording through a tracker and compares its output with the ground truth.
//!
//! A [`PoseWithCovariance`] is a pose with the covariance of its error in its own body frame, on
//! (v, ω).

mod anchor_model;
mod anchoring;
mod appearance;
mod pose_with_covariance;
mod clock;
mod dead_reckoning;
mod gravity;
mod health;
mod map;
mod wheel_odometry;
mod motion_prior;
mod pose_velocity;
mod recent_matches;
mod relocalize;
mod replay;
mod rig;
mod room_errors;
mod sight;
mod state;
mod status;
mod step;
mod tracker;
mod view;

pub use anchor_model::MapAnchor;
pub use anchoring::ANCHORS_TO_AGREE;
pub use clock::{ASSUMED_PERIOD_S, frame_period_s, seconds_between};
pub use gravity::MeasuredGravity;
pub use health::{Continuity, FrameEvidence, TrackingHealth};
pub(crate) use map::extent_m;
pub use map::{Map, MapMatch, MapQuery, PoseReader};
pub use motion_prior::MotionPrior;
pub use pose_velocity::PoseVelocity;
pub(crate) use pose_with_covariance::PLACE_DEVIATION_M;
pub use pose_with_covariance::{Innovation, PoseWithCovariance};
pub use recent_matches::RecentMatches;
pub use relocalize::{ROOM_RATIO, Relocalization, RoomMatch, relocalize};
pub use replay::{
    InitialPose, MapPath, MotionSurprise, Played, Replay, Segment, joined, period_ns, replay,
    replay_frames, replay_streams,
};
pub use rig::{OtherCamera, OtherView};
pub use state::{
    Candidate, Keyframe, LastFrame, MatchedPose, Observation, Place, Refusal, State, Update,
};
pub use tracker::{Tracker, TrackerSettings};
pub use view::{View, motion};
pub use wheel_odometry::{Drift, LastMeasured, MeasuredPose, OdometryAccumulator, OdometryDelta};

use seese3_core::adapter;
use seese3_core::room::RoomId;

/// Localization status of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The map pose is known and confirmed by recent frames.
    Tracking,
    /// There is a map pose, but it is unconfirmed, contradicted or too uncertain.
    Degraded,
    /// The frames do not match the room, or the position is too uncertain to be useful.
    Lost,
    /// The frames match the room, but not enough anchors agree on a pose yet.
    Relocalizing,
}

/// Why a camera cannot be tracked or relocalized.
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
    /// The errors measured in a room give no valid error model.
    #[error("the adapter's errors in this room give no valid error model: {0}")]
    RoomErrors(#[source] adapter::Error),
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

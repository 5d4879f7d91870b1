//! From what a camera sees to how it moves, and where it is.
//!
//! - [`motion`] reads the motion between two views.
//! - [`relocalize`] names the room that a few views show, and the place in it.
//! - A [`Tracker`] follows a stream of frames; its whole memory of a stream is a [`State`].
//! - [`replay`] runs a recording through a tracker and compares the answers with the true path.
//!
//! A [`PoseWithCovariance`] is a pose with the covariance of its error in its own body frame, on (v, ω).

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
pub use map::{Map, MapMatch, MapQuery, PoseReader};
pub use motion_prior::MotionPrior;
pub use pose_velocity::PoseVelocity;
pub use pose_with_covariance::{Innovation, PoseWithCovariance};
pub use recent_matches::RecentMatches;
pub use relocalize::{ROOM_RATIO, Relocalization, RoomMatch, relocalize};
pub use replay::{
    InitialPose, MapPath, MotionSurprise, Played, Replay, Segment, joined, period_ns, replay,
    replay_frames, replay_streams,
};
pub use rig::{OtherCamera, OtherView};
pub use state::{Candidate, Keyframe, LastFrame, Observation, Place, Refusal, State, Update};
pub use tracker::{Tracker, TrackerSettings};
pub use view::{View, motion};
pub use wheel_odometry::{Drift, LastMeasured, MeasuredPose, OdometryAccumulator, OdometryDelta};

use seese3_core::adapter;
use seese3_core::room::RoomId;

/// Whether a stream's place in the room is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The place is known, and recent frames confirm it.
    Tracking,
    /// The place was known, but recent frames match no mapped frame, or speak for another place.
    Degraded,
    /// The frames do not match the room, or the place is known too badly to be of use.
    Lost,
    /// The frames match the room, but not enough of them agree on a place yet.
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
    /// Nobody waits for the answer any more.
    #[error("cancelled")]
    Cancelled,
    /// Latents of different adapters cannot be compared.
    #[error("rooms of several adapters cannot be looked in together: their latents do not compare")]
    Adapters,
    /// The adapter has no error model.
    #[error(
        "the adapter's errors were not measured in two or more rooms that it did not learn from (train --calibrate-on)"
    )]
    NotCalibrated,
    /// The errors that a room's frames show make no sound error model.
    #[error("the errors of the adapter in this room cannot be used: {0}")]
    RoomErrors(#[source] adapter::Error),
    /// No mapped frame has another one nearby in place but not in time.
    #[error(
        "room '{room}' has {frames} mapped frames, none with another that is not beside it in time: too few to tell it \
         from other places"
    )]
    SmallMap {
        /// The room.
        room: RoomId,
        /// How many frames of it are mapped.
        frames: usize,
    },
}

//! From what a camera sees to how it moves, and where it is.
//!
//! - [`motion`] reads one motion; a [`Tracker`] follows a stream.
//! - A [`Belief`] is a pose and the covariance of its error in its own body frame, (v, ω).

mod belief;
mod chain;
mod map;
mod own_errors;
mod relocalize;
mod state;
mod tracker;
mod verdict;
mod view;

pub use belief::{Belief, Innovation};
pub use chain::{Chain, Look};
pub use map::{Map, Sighting};
pub use relocalize::{ROOM_RATIO, Relocalized, RoomMatch, relocalize};
pub use state::{Candidate, Keyframe, Last, Observation, Refusal, State, Update};
pub use tracker::{AGREEING, Settings, Tracker};
pub use view::{View, motion};

use crate::room::RoomId;

/// Whether a stream's place is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The place is known and recent frames confirm it.
    Tracking,
    /// The place was known; recent frames look like no mapped place.
    Degraded,
    /// The frames do not look like the room, or the place is known too badly to be of use.
    Lost,
    /// The frames look like the room, but not enough agree on a place yet.
    Relocalizing,
}

/// Why a camera cannot be followed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("at least one room is needed")]
    NoMap,
    #[error("at least one view is needed")]
    NoView,
    #[error("cancelled")]
    Cancelled,
    #[error("rooms of several adapters cannot be looked in together: their latents do not compare")]
    Adapters,
    #[error(
        "the adapter's errors were not measured in two or more rooms that it did not learn from (train --calibrate-on)"
    )]
    NotCalibrated,
    #[error(
        "room '{room}' has {frames} mapped frames, none with another that is not beside it in time: too few to tell it \
         from other places"
    )]
    SmallMap { room: RoomId, frames: usize },
}

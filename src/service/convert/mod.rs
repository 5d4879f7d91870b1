//! Wire types to domain types and back: the one place that knows both.

mod incoming;
mod outgoing;

pub use incoming::{
    exclusion, mode_of, navigators, pose, prediction, query, source, split, thresholds,
};
pub use outgoing::*;

/// The child frame of every pose.
const CAMERA: &str = "camera";

/// The world frame of a room.
pub fn world_frame(room: &str) -> String {
    format!("rooms/{room}")
}

//! Conversion between wire types and domain types. Messages that only one service builds are built
//! beside it.

mod incoming;
mod outgoing;

pub use incoming::{
    exclusion, mode_of, navigators, pinhole, pose, prediction, query, source, split, thresholds,
};
pub use outgoing::*;

/// The child frame of every pose, unless a Track stream names its own.
const CAMERA: &str = "camera";

/// The name of a room's world frame, the parent frame of its poses.
pub fn world_frame(room: &str) -> String {
    format!("rooms/{room}")
}

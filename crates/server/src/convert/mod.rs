//! Conversion between wire types and domain types. Messages of a single service are converted in
//! that service's module.

mod incoming;
mod outgoing;

pub use incoming::{
    exclusion, mode_of, navigators, pinhole, pose, prediction, query, source, split, thresholds,
};
pub use outgoing::*;

/// Default child frame of poses; a Track stream may choose another name.
const CAMERA: &str = "camera";

/// The name of a room's world frame, the parent frame of its poses.
pub fn world_frame(room: &str) -> String {
    format!("rooms/{room}")
}

//! Export of trajectories and streams for other programs: TUM, KITTI, MCAP.

#[cfg(feature = "bags")]
mod recording;
mod trajectory;

#[cfg(feature = "bags")]
pub use recording::{McapRecording, RecordedOdometry};
pub use trajectory::{kitti_trajectory, tum_trajectory};

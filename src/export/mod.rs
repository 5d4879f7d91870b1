//! Paths and streams as other programs read them: TUM, KITTI, MCAP.

mod recording;
mod trajectory;

pub use recording::{McapRecording, RecordedOdometry};
pub use trajectory::{kitti_trajectory, tum_trajectory};

//! Dataset readers, the pose check and trajectories against files made by other libraries.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

#[cfg(feature = "bags")]
mod bags;
mod cameras;
mod datasets;
mod more_datasets;
mod pose_check;
mod trajectory;

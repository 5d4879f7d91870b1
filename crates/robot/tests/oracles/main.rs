//! Tracking, fitting and navigation with calibrated adapters, on made-up rooms.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

mod fitting;
mod front_end;
mod inertial;
mod localization;
mod matched_views;
mod multi_step;
mod pose_filter;
mod tracking;
mod visual_odometry;

//! The program as a user runs it: what it prints, what it writes, and how it says no.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

mod basics;
mod benchmark;
#[cfg(target_os = "linux")]
mod disks;
mod keypoints;
mod kills;
mod manners;
#[cfg(feature = "onnx")]
mod matched_views;
mod program;
mod relational;
mod research;
mod rooms;
mod schemas;
#[cfg(feature = "otlp")]
mod traces;

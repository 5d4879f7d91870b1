//! The service over a real server on a free port, asked through the real client.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

mod answers;
mod changes;
mod downloads;
mod extension;
mod fitted;
mod frames;
mod goals;
mod harness;
mod hostile;
mod http2;
mod images;
mod isolation;
mod keypoints_upload;
mod lifecycle;
mod memory;
mod navigators;
mod operations;
mod refusals;
mod relational;
mod reload;
mod revisions;
mod room_memory;
mod security;
mod sensors;
mod soak;
mod tracking;

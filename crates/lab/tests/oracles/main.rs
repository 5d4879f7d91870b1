//! Probes, formulations and planning against other libraries, and the real kitchen.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::too_many_lines,
    reason = "a failed step is a failed run here, and a case may be long"
)]

mod camera_fit;
mod formulations;
mod kitchen;
mod matched_localization;
mod planning;
mod probes;

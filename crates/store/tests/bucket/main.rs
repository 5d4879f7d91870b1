//! The store in a bucket of a real S3 server. The variable `SEESE3_WEED` names the program of
//! SeaweedFS; `SEESE3_TIMES` is the number of rounds of races and kills, 20 by default.
#![cfg(feature = "cloud")]
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a failed step is a failed run here"
)]

mod in_a_bucket;
mod seaweed;

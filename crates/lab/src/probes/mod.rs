//! The probes M1 to M3: the SE(3) information in a room's features, without a trained adapter. M4
//! is the score of a trained adapter; see [`seese3_core::training`].

mod intrinsic_dimension;
mod mutual_knn;
mod nearest_rows;
mod ridge_probe;

pub use intrinsic_dimension::{IntrinsicDimension, Mle, TwoNn, intrinsic_dimension};
pub use mutual_knn::{
    Counted, Limit, MutualKnn, PoseDistance, feature_neighbors, mutual_knn, pose_neighbors,
};
pub use ridge_probe::ridge_probe;

use seese3_core::{ridge, splits};

/// Why a probe failed.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("{frames} frames at stride {stride} need {needed} frames, the room has {have}")]
    TooFewFrames {
        frames: usize,
        stride: usize,
        needed: usize,
        have: usize,
    },
    #[error(
        "frame {frame} has fewer than {k} candidates that are more than {exclusion} frames away"
    )]
    TooFewCandidates {
        frame: usize,
        k: usize,
        exclusion: usize,
    },
    #[error("{what} must be at least {least}, got {given}")]
    TooSmall {
        what: &'static str,
        least: usize,
        given: usize,
    },
    #[error("row {row} of the features is zero; it has no direction")]
    NoDirection { row: usize },
    #[error("only {kept} of {rows} rows are left after removing duplicates; {needed} are required")]
    TooFewRows {
        kept: usize,
        rows: usize,
        needed: usize,
    },
    #[error(transparent)]
    Pairs(#[from] splits::Error),
    #[error(transparent)]
    Ridge(#[from] ridge::Error),
}

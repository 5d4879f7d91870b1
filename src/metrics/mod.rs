//! M1 to M4: how much of SE(3) a room's features hold.

mod intrinsic_dimension;
mod mutual_knn;
mod ridge_probe;

pub use intrinsic_dimension::{Duplicates, IntrinsicDimension, Mle, TwoNn, intrinsic_dimension};
pub use mutual_knn::{Bound, Counted, MutualKnn, feature_neighbours, mutual_knn, pose_neighbours};
pub use ridge_probe::ridge_probe;

use crate::{pairs, ridge};

/// Why a metric has no value.
#[derive(Debug, thiserror::Error, PartialEq)]
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
    #[error("{kept} of {rows} rows are left without duplicates; {needed} are needed")]
    TooFewRows {
        kept: usize,
        rows: usize,
        needed: usize,
    },
    #[error(transparent)]
    Pairs(#[from] pairs::Error),
    #[error(transparent)]
    Ridge(#[from] ridge::Error),
}

//! Paths of a camera against the true ones: which poses belong together, alignment, APE and RPE as
//! evo defines them.

mod align;
mod associate;
mod error;

pub use align::{Alignment, Similarity};
pub use associate::{Matches, associate};
pub use error::{Relation, RpePairs, Statistics, ape, rpe};

use crate::geometry::Pose;

/// Poses by time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trajectory {
    /// Nanoseconds, ascending.
    pub times_ns: Vec<i64>,
    /// `world_from_camera`, metres, one a time.
    pub poses: Vec<Pose>,
}

impl Trajectory {
    /// How many poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// The poses of these places, in their order. Every place must be there.
    #[must_use]
    pub fn select(&self, places: &[usize]) -> Self {
        Self {
            times_ns: places.iter().map(|&place| self.times_ns[place]).collect(),
            poses: places.iter().map(|&place| self.poses[place]).collect(),
        }
    }
}

/// Why two paths cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("the paths have {reference} and {estimate} poses; associate them first")]
    Unequal { reference: usize, estimate: usize },
    #[error("no pose of one path is within {} ms of one of the other", *max_difference_ns as f64 * 1e-6)]
    NothingMatches { max_difference_ns: u64 },
    #[error("the {have} poses cannot be aligned: their positions must span at least a plane")]
    Degenerate { have: usize },
    #[error("{have} poses have no pair {delta} apart")]
    NoPairs { have: usize, delta: usize },
}

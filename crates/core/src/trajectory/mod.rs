//! Trajectories of a camera and their errors against a reference, as evo defines them: association
//! by time, alignment, absolute (APE) and relative (RPE) pose errors.

mod align;
mod associate;
mod ape_rpe;

pub use align::{Alignment, Similarity};
pub use ape_rpe::{Relation, RpePairs, Statistics, ape, rpe};
pub use associate::{Matches, associate};

use crate::geometry::Pose;

/// Camera poses over time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trajectory {
    /// Nanoseconds, ascending.
    pub times_ns: Vec<i64>,
    /// `world_from_camera`, meters, one per time.
    pub poses: Vec<Pose>,
}

impl Trajectory {
    /// The number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether it has no pose.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// The poses at these indices, in the given order. Every index must be in range.
    #[must_use]
    pub fn select(&self, places: &[usize]) -> Self {
        Self {
            times_ns: places.iter().map(|&place| self.times_ns[place]).collect(),
            poses: places.iter().map(|&place| self.poses[place]).collect(),
        }
    }
}

/// Why two trajectories cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("the trajectories have {reference} and {estimate} poses; associate them first")]
    Unequal { reference: usize, estimate: usize },
    #[error("no two poses of the trajectories are within {} ms", *max_difference_ns as f64 * 1e-6)]
    NothingMatches { max_difference_ns: u64 },
    #[error("the {have} poses cannot be aligned: their positions must span at least a plane")]
    Degenerate { have: usize },
    #[error("{have} poses contain no pair {delta} apart")]
    NoPairs { have: usize, delta: usize },
}

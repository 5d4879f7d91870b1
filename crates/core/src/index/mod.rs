//! Nearest-neighbor search among the latents of a room's frames: exact by default, HNSW as an
//! option.
//!
//! Contract of every index (`tests/index_contract.rs`): results are ordered by L2 distance, then by
//! frame; excluded frames are never returned; fewer than `k` are returned only when fewer remain.

mod scores;
mod exact;
mod joint;
#[cfg(feature = "hnsw")]
mod hnsw;

pub use exact::ExactIndex;
#[cfg(feature = "hnsw")]
pub use hnsw::{HnswIndex, HnswParameters};
pub use joint::{JointIndex, PartNeighbor};

use crate::room::FrameId;

/// A frame and the distance of its latent from the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbor {
    /// The frame.
    pub frame: FrameId,
    /// L2 distance in latent units.
    pub distance: f64,
}

/// Recall of an approximate index against the exact scan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Audit {
    /// Points that are unreachable in the graph; they are scanned in every query.
    pub unreachable: usize,
    /// Number of points in the index.
    pub frame_count: usize,
    /// Fraction of the exact `k` nearest frames that the index returns, averaged over the queries.
    pub recall: f64,
    /// Number of neighbors per query.
    pub k: usize,
    /// Number of queries. Each is the midpoint of two latents half the room apart: off the frames'
    /// path, like predicted latents.
    pub queries: usize,
}

/// Frames that are excluded from retrieval: all within `radius` rows of `center`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exclusion {
    /// The center frame.
    pub center: FrameId,
    /// Number of rows excluded to each side; 0 excludes the center only.
    pub radius: u32,
}

impl Exclusion {
    /// Whether a frame is excluded.
    pub fn covers(&self, frame: FrameId) -> bool {
        frame.0.abs_diff(self.center.0) <= self.radius
    }

    /// Maximum number of excluded frames.
    #[cfg(feature = "hnsw")]
    fn most(&self) -> usize {
        (self.radius as usize).saturating_mul(2).saturating_add(1)
    }
}

/// Nearest-neighbor search among the latents of frames.
pub trait Index: Send + Sync {
    /// The `k` nearest frames to `query`, ordered by distance, then by frame.
    fn nearest(&self, query: &[f64], k: usize, exclusion: Option<Exclusion>) -> Vec<Neighbor>;

    /// The answers of [`Index::nearest`] to several queries, in their order.
    fn nearest_of_each(
        &self,
        queries: &[&[f64]],
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> Vec<Vec<Neighbor>> {
        let nearest = |query: &&[f64]| self.nearest(query, k, exclusion);
        queries.iter().map(nearest).collect()
    }

    /// Number of indexed frames.
    fn len(&self) -> usize;

    /// Approximate memory use, bytes; only the part that grows with the number of frames.
    fn memory_bytes(&self) -> usize;

    /// Whether there are no indexed frames.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl Neighbor {
    /// The order of results: by distance, then by frame.
    pub fn nearer(&self, other: &Self) -> std::cmp::Ordering {
        let by_distance = self.distance.total_cmp(&other.distance);
        by_distance.then(self.frame.cmp(&other.frame))
    }
}

/// L2 distance. Columns are summed in four SIMD lanes in a fixed order, so that equal rows have
/// equal distances.
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    let ((a_lanes, a_rest), (b_lanes, b_rest)) = (a.as_chunks::<4>(), b.as_chunks::<4>());

    let mut sums = [0.0; 4];
    for (a, b) in a_lanes.iter().zip(b_lanes) {
        for lane in 0..4 {
            sums[lane] += (a[lane] - b[lane]) * (a[lane] - b[lane]);
        }
    }

    let rest = a_rest.iter().zip(b_rest).map(|(a, b)| (a - b) * (a - b));
    let sum = sums.iter().sum::<f64>() + rest.sum::<f64>();
    sum.sqrt()
}

/// Collects the results of a search.
trait Collector {
    /// The number that is collected.
    fn count(&self) -> usize;

    /// The largest distance collected; `None` while there are fewer than the wanted number.
    fn worst(&self) -> Option<f64>;

    /// Adds a neighbor if it is among the nearest so far.
    fn offer(&mut self, found: Neighbor);
}

impl Collector for Nearest {
    fn count(&self) -> usize {
        self.count
    }

    fn worst(&self) -> Option<f64> {
        let is_full = self.best.len() == self.count;
        self.best
            .last()
            .filter(|_| is_full)
            .map(|worst| worst.distance)
    }

    #[inline]
    fn offer(&mut self, found: Neighbor) {
        Self::offer(self, found);
    }
}

/// Collects the `count` nearest neighbors, ordered by distance, then by frame.
#[derive(Debug)]
pub struct Nearest {
    count: usize,
    /// Always sorted, with at most `count` entries.
    best: Vec<Neighbor>,
}

impl Nearest {
    /// An empty collection of at most `count` neighbors.
    pub fn new(count: usize) -> Self {
        Self {
            count,
            best: Vec::new(),
        }
    }

    /// Adds a neighbor if it is among the nearest so far.
    #[inline]
    pub fn offer(&mut self, found: Neighbor) {
        // Fast path: most neighbors are farther than the worst so far.
        let is_full = self.best.len() == self.count;
        let worst = self.best.last();
        if is_full && worst.is_none_or(|worst| found.distance > worst.distance) {
            return;
        }
        self.insert(found);
    }

    fn insert(&mut self, found: Neighbor) {
        let is_before = |other: &Neighbor| other.nearer(&found).is_lt();
        let place = self.best.partition_point(is_before);
        self.best.insert(place, found);
        self.best.truncate(self.count);
    }

    /// The collected neighbors, sorted.
    pub fn found(self) -> Vec<Neighbor> {
        self.best
    }
}

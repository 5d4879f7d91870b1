//! Nearest neighbours of a latent among a room's frames: exact by default, HNSW as an option.
//!
//! Every index keeps one contract (`tests/index_contract.rs`): answers are ordered by L2 distance,
//! then by frame; an excluded frame is never returned; fewer than `k` are returned only when fewer
//! are left.

mod exact;
#[cfg(feature = "hnsw")]
mod hnsw;

pub use exact::ExactIndex;
#[cfg(feature = "hnsw")]
pub use hnsw::{HnswIndex, HnswParameters};

use crate::room::FrameId;

/// One frame and how far its latent is from the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// The frame.
    pub frame: FrameId,
    /// L2 distance in latent units.
    pub distance: f64,
}

/// How an approximate index compares with the exact scan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Audit {
    /// Points that no search of the graph reaches; they are scanned instead.
    pub unreachable: usize,
    /// Points in the index.
    pub frame_count: usize,
    /// Share of the exact `k` nearest frames that the index also returns, averaged over the
    /// queries.
    pub recall: f64,
    /// How many neighbours were asked for.
    pub k: usize,
    /// How many queries were asked. Each is the midpoint of two latents half the room apart, off
    /// the frames' path as wanted latents are.
    pub queries: usize,
}

/// Frames that must not be returned: all within `radius` rows of `centre`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exclusion {
    /// The frame in the middle.
    pub centre: FrameId,
    /// How many rows to each side are left out with it; 0 leaves out the centre alone.
    pub radius: u32,
}

impl Exclusion {
    /// Whether a frame is left out.
    pub fn covers(&self, frame: FrameId) -> bool {
        frame.0.abs_diff(self.centre.0) <= self.radius
    }

    /// The most frames that are left out.
    #[cfg(feature = "hnsw")]
    fn most(&self) -> usize {
        (self.radius as usize).saturating_mul(2).saturating_add(1)
    }
}

/// Finds the frames whose latents are nearest to a query.
pub trait Index: Send + Sync {
    /// The `k` nearest frames to `query`, by distance and then by frame.
    fn nearest(&self, query: &[f64], k: usize, exclusion: Option<Exclusion>) -> Vec<Neighbour>;

    /// How many frames can be found.
    fn len(&self) -> usize;

    /// About how much memory it holds, bytes: what grows with the number of frames.
    fn memory_bytes(&self) -> usize;

    /// Whether no frame can be found.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Orders neighbours as every answer is ordered.
fn by_distance_then_frame(a: &Neighbour, b: &Neighbour) -> std::cmp::Ordering {
    a.distance
        .total_cmp(&b.distance)
        .then(a.frame.cmp(&b.frame))
}

/// L2 distance. Columns are summed in four lanes, which a processor adds at the same time; the
/// order is always the same, so that equal rows have equal distances.
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

/// The nearest of all neighbours that are offered, by distance and then by frame.
#[derive(Debug)]
pub struct Nearest {
    count: usize,
    /// Always sorted and never longer than `count`, so that nothing has to be sorted at the end.
    best: Vec<Neighbour>,
}

impl Nearest {
    /// None yet, and never more than `count`.
    pub fn new(count: usize) -> Self {
        Self {
            count,
            best: Vec::new(),
        }
    }

    /// Takes a neighbor if it is among the nearest so far.
    #[inline]
    pub fn offer(&mut self, found: Neighbour) {
        // Most are no better than the worst so far and are dropped here.
        let is_full = self.best.len() == self.count;
        let worst = self.best.last();
        if is_full && worst.is_none_or(|worst| found.distance > worst.distance) {
            return;
        }
        self.insert(found);
    }

    fn insert(&mut self, found: Neighbour) {
        let is_before = |other: &Neighbour| by_distance_then_frame(other, &found).is_lt();
        let place = self.best.partition_point(is_before);
        self.best.insert(place, found);
        self.best.truncate(self.count);
    }

    /// The nearest that were offered, sorted.
    pub fn found(self) -> Vec<Neighbour> {
        self.best
    }
}

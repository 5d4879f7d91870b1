//! One exact index of several rooms' latents.

use ndarray::{Array2, ArrayView2, Axis};

use super::{Collector, ExactIndex, Index, Neighbor};
use crate::room::FrameId;

/// The latents of several parts, such as rooms, in one index. Faster than one index per part, with
/// the same results.
#[derive(Debug, Clone)]
pub struct JointIndex {
    /// The first row of each part, and the number of rows.
    starts: Vec<u32>,
    index: ExactIndex,
}

/// A row of a part and the distance of its latent from the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartNeighbor {
    /// Position of the part, counted from 0.
    pub part: usize,
    /// The row in the part, and the distance.
    pub neighbor: Neighbor,
}

impl JointIndex {
    /// Indexes the rows of each part, of shape (n, k) with the same k. `None` without a part, with
    /// parts of different widths, or with more than 2³² − 1 rows.
    pub fn of(parts: &[ArrayView2<'_, f64>]) -> Option<Self> {
        let mut starts = vec![0_u32];
        for part in parts {
            let rows = u32::try_from(part.nrows()).ok()?;
            starts.push(starts.last()?.checked_add(rows)?);
        }
        let columns = parts.first()?.ncols();
        let rows = *starts.last()?;

        let mut latents = Array2::zeros((0, columns));
        latents.reserve(Axis(0), rows as usize).ok()?;
        for part in parts {
            latents.append(Axis(0), *part).ok()?;
        }
        let frames: Vec<FrameId> = (0..rows).map(FrameId).collect();

        Some(Self {
            starts,
            index: ExactIndex::of_frames(latents.view(), &frames),
        })
    }

    /// The `k` nearest rows of all parts, ordered by distance, then by part, then by row.
    pub fn nearest(&self, query: &[f64], k: usize) -> Vec<PartNeighbor> {
        let nearest = self.index.nearest(query, k, None);
        nearest
            .into_iter()
            .map(|found| self.in_part(found))
            .collect()
    }

    /// The nearest row of each of the `count` nearest parts, ordered by distance, then by part.
    pub fn nearest_parts(&self, query: &[f64], count: usize) -> Vec<PartNeighbor> {
        if count == 0 {
            return Vec::new();
        }
        let parts = NearestParts {
            joint: self,
            count,
            best: Vec::new(),
        };
        self.index.collected(query, parts).best
    }

    /// Number of columns, k.
    pub fn width(&self) -> usize {
        self.index.width()
    }

    fn in_part(&self, found: Neighbor) -> PartNeighbor {
        let part = self.starts.partition_point(|start| *start <= found.frame.0) - 1;
        PartNeighbor {
            part,
            neighbor: Neighbor {
                frame: FrameId(found.frame.0 - self.starts[part]),
                ..found
            },
        }
    }
}

/// Collects the nearest row of each of the nearest parts.
struct NearestParts<'a> {
    joint: &'a JointIndex,
    count: usize,
    /// In order, with at most `count` entries.
    best: Vec<PartNeighbor>,
}

impl PartNeighbor {
    /// The order of results: by distance, then by part, then by row.
    fn nearer(&self, other: &Self) -> std::cmp::Ordering {
        let by_distance = self.neighbor.distance.total_cmp(&other.neighbor.distance);
        let by_part = by_distance.then(self.part.cmp(&other.part));
        by_part.then(self.neighbor.frame.cmp(&other.neighbor.frame))
    }
}

impl Collector for NearestParts<'_> {
    fn count(&self) -> usize {
        self.count
    }

    fn worst(&self) -> Option<f64> {
        let is_full = self.best.len() == self.count;
        let worst = self.best.last().filter(|_| is_full);
        worst.map(|worst| worst.neighbor.distance)
    }

    fn offer(&mut self, found: Neighbor) {
        if self.worst().is_some_and(|worst| found.distance > worst) {
            return;
        }
        let found = self.joint.in_part(found);
        if let Some(known) = self.best.iter().position(|known| known.part == found.part) {
            if self.best[known].nearer(&found).is_le() {
                return;
            }
            self.best.remove(known);
        }
        let place = self
            .best
            .partition_point(|known| known.nearer(&found).is_lt());
        self.best.insert(place, found);
        self.best.truncate(self.count);
    }
}

//! Approximate index based on the crate `hnsw_rs`, with the contract of the exact index.
//!
//! - The build is serial: a parallel build is not deterministic and loses points.
//! - Even a serial build leaves some points unreachable. They are detected after the build and
//!   scanned in every query.
//! - Distances are recomputed in f64 from the latents, so they do not depend on the kind of index.

use std::collections::BTreeSet;

use hnsw_rs::prelude::{DistL2, Hnsw};
use ndarray::ArrayView2;

use super::{Audit, ExactIndex, Exclusion, Index, Neighbor, distance};
use crate::room::FrameId;

const MOST_LAYERS: usize = 16;
/// Approximate memory of one link in the graph, bytes.
const LINK_BYTES: usize = 48;

/// Build and search parameters of an [`HnswIndex`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HnswParameters {
    /// M, links per point and layer, 2 to 255.
    pub links: u8,
    /// ef_construction, candidates kept during the build.
    pub build_effort: usize,
    /// ef_search, candidates kept during a search. Predicted latents lie off the path of the stored
    /// ones: with 64 candidates, 1 in 10 of the nearest frames found with 256 is missed (900
    /// synthetic latents, `tests/index_contract.rs`).
    pub search_effort: usize,
}

impl Default for HnswParameters {
    fn default() -> Self {
        Self {
            links: 16,
            build_effort: 200,
            search_effort: 256,
        }
    }
}

/// Latents in a hierarchical navigable small-world graph. Build and search are deterministic.
pub struct HnswIndex {
    graph: Hnsw<'static, f32, DistL2>,
    exact: ExactIndex,
    latents: Vec<Vec<f64>>,
    frames: Vec<FrameId>,
    unreachable: Vec<usize>,
    parameters: HnswParameters,
}

impl HnswIndex {
    /// Indexes the rows of `latents` (n, k) that belong to `frames`.
    pub fn new(
        latents: ArrayView2<'_, f64>,
        frames: &[FrameId],
        parameters: HnswParameters,
    ) -> Self {
        let graph = Hnsw::new(
            usize::from(parameters.links.max(2)),
            frames.len().max(1),
            MOST_LAYERS,
            parameters.build_effort.max(1),
            DistL2 {},
        );

        let rows: Vec<Vec<f64>> = frames
            .iter()
            .map(|frame| latents.row(frame.row()).to_vec())
            .collect();

        // Serial insertion, so that the same rows always give the same graph.
        for (position, row) in rows.iter().enumerate() {
            graph.insert((&single(row), position));
        }

        let mut index = Self {
            graph,
            exact: ExactIndex::new(latents, frames),
            latents: rows,
            frames: frames.to_vec(),
            unreachable: Vec::new(),
            parameters,
        };

        // A point is reachable if a search for its latent finds it.
        index.unreachable = (0..index.latents.len())
            .filter(|&position| !index.reaches(position))
            .collect();

        index
    }

    /// Measures the recall of the `k` nearest frames against the exact scan, with one query per
    /// `stride` latents; see [`Audit::queries`].
    pub fn audit(&self, k: usize, stride: usize) -> Audit {
        let count = self.latents.len();

        // Queries at stored latents would be too easy: predicted latents lie off the frames' path.
        let halfway = |position: usize| -> Vec<f64> {
            let far = &self.latents[(position + count / 2) % count];
            self.latents[position]
                .iter()
                .zip(far)
                .map(|(a, b)| 0.5 * (a + b))
                .collect()
        };

        let queries: Vec<Vec<f64>> = (0..count).step_by(stride.max(1)).map(halfway).collect();

        let share = |query: &Vec<f64>| {
            let truth = self.exact.nearest(query, k, None);

            // Ties count as found: any frame at most as far as the k-th nearest is correct.
            let limit = truth.last().map_or(0.0, |last| last.distance);
            let found = self
                .nearest(query, k, None)
                .iter()
                .filter(|hit| hit.distance <= limit)
                .count();

            found as f64 / truth.len().max(1) as f64
        };

        Audit {
            unreachable: self.unreachable.len(),
            frame_count: self.frames.len(),
            recall: queries.iter().map(share).sum::<f64>() / queries.len().max(1) as f64,
            k,
            queries: queries.len(),
        }
    }

    fn reaches(&self, position: usize) -> bool {
        let effort = self.parameters.search_effort;
        let found = self
            .graph
            .search(&single(&self.latents[position]), effort, effort);

        found.iter().any(|hit| hit.d_id == position)
    }
}

impl Index for HnswIndex {
    fn nearest(&self, query: &[f64], k: usize, exclusion: Option<Exclusion>) -> Vec<Neighbor> {
        // The graph does not support exclusions: search for as many more frames as can be excluded.
        let wanted = k
            .saturating_add(exclusion.map_or(0, |exclusion| exclusion.most()))
            .min(self.frames.len());
        let found = self.graph.search(
            &single(query),
            wanted,
            self.parameters.search_effort.max(wanted),
        );

        let positions: BTreeSet<usize> = found
            .iter()
            .map(|hit| hit.d_id)
            .chain(self.unreachable.iter().copied())
            .collect();

        // Replace the graph's f32 distances by f64 distances from the latents.
        let mut neighbors: Vec<Neighbor> = positions
            .into_iter()
            .filter(|&position| {
                !exclusion.is_some_and(|exclusion| exclusion.covers(self.frames[position]))
            })
            .map(|position| Neighbor {
                frame: self.frames[position],
                distance: distance(&self.latents[position], query),
            })
            .collect();

        neighbors.sort_by(Neighbor::nearer);
        neighbors.truncate(k);

        if neighbors.len() < k.min(self.frames.len()) {
            // Too few frames, for instance from a disconnected part of the graph. The contract
            // requires all remaining frames up to k: fall back to the exact scan.
            return self.exact.nearest(query, k, exclusion);
        }

        neighbors
    }

    fn memory_bytes(&self) -> usize {
        // The graph holds a copy of each row in f32, and in the lowest layer up to 2 · `links`
        // neighbors per point, each with its distance in an `Arc`.
        let links = 2 * usize::from(self.parameters.links) * LINK_BYTES;
        let row = self.latents.first().map_or(0, Vec::len) * (size_of::<f64>() + size_of::<f32>());

        self.exact.memory_bytes() + self.latents.len() * (row + links)
    }

    fn len(&self) -> usize {
        self.frames.len()
    }
}

fn single(row: &[f64]) -> Vec<f32> {
    row.iter().map(|&x| x as f32).collect()
}

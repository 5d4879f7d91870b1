//! The exact scan of all frames: the reference for any other index, and the fastest up to some
//! 10,000 frames.

use ndarray::ArrayView2;

use super::{Exclusion, Index, Neighbour, by_distance_then_frame, distance};
use crate::room::FrameId;

/// Latents, row by row, with the frame that each belongs to.
#[derive(Debug, Clone)]
pub struct ExactIndex {
    width: usize,
    values: Vec<f64>,
    frames: Vec<FrameId>,
}

impl ExactIndex {
    /// Indexes the rows of `latents` (n, k) that belong to `frames`; no other row can be found.
    pub fn new(latents: ArrayView2<'_, f64>, frames: &[FrameId]) -> Self {
        let values = frames
            .iter()
            .flat_map(|frame| latents.row(frame.row()).to_vec())
            .collect();
        Self {
            width: latents.ncols(),
            values,
            frames: frames.to_vec(),
        }
    }
}

impl Index for ExactIndex {
    fn nearest(&self, query: &[f64], k: usize, exclusion: Option<Exclusion>) -> Vec<Neighbour> {
        // `best` stays sorted and never grows beyond k, so that nothing has to be sorted at the
        // end.
        let mut best: Vec<Neighbour> = Vec::with_capacity(k.min(self.frames.len()) + 1);
        for (row, &frame) in self.values.chunks_exact(self.width).zip(&self.frames) {
            if exclusion.is_some_and(|exclusion| exclusion.covers(frame)) {
                continue;
            }

            let found = Neighbour {
                frame,
                distance: distance(row, query),
            };

            // Most frames are no better than the k-th best so far and are dropped here.
            let full = best.len() == k;
            if full
                && best
                    .last()
                    .is_none_or(|worst| by_distance_then_frame(&found, worst).is_ge())
            {
                continue;
            }

            let at = best.partition_point(|other| by_distance_then_frame(other, &found).is_lt());
            best.insert(at, found);
            best.truncate(k);
        }

        best
    }

    fn memory_bytes(&self) -> usize {
        size_of_val(self.values.as_slice()) + size_of_val(self.frames.as_slice())
    }

    fn len(&self) -> usize {
        self.frames.len()
    }
}

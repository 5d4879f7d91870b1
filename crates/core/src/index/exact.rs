//! Exact scan of all frames: the reference for other indexes, and the fastest index up to about
//! 10,000 frames.

use ndarray::ArrayView2;

use super::{Exclusion, Index, Nearest, Neighbor, distance};
use crate::room::FrameId;

/// Latents by row, and the frame of each row.
#[derive(Debug, Clone)]
pub struct ExactIndex {
    width: usize,
    values: Vec<f64>,
    frames: Vec<FrameId>,
}

impl ExactIndex {
    /// Indexes the rows of `latents` (n, k) that belong to `frames`.
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
    fn nearest(&self, query: &[f64], k: usize, exclusion: Option<Exclusion>) -> Vec<Neighbor> {
        let mut nearest = Nearest::new(k);
        for (row, &frame) in self.values.chunks_exact(self.width).zip(&self.frames) {
            if !exclusion.is_some_and(|exclusion| exclusion.covers(frame)) {
                let distance = distance(row, query);
                nearest.offer(Neighbor { frame, distance });
            }
        }

        nearest.found()
    }

    fn memory_bytes(&self) -> usize {
        size_of_val(self.values.as_slice()) + size_of_val(self.frames.as_slice())
    }

    fn len(&self) -> usize {
        self.frames.len()
    }
}

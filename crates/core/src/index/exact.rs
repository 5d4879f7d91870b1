//! Exact search: the reference for other indexes, and the fastest in the largest rooms measured, 20,000
//! frames.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, Axis};

use super::scores::{LANES, ScoredRows, Scores};
use super::{Exclusion, Index, Nearest, Neighbor, distance};
use crate::room::FrameId;

/// Queries that are compared with the frames in one pass.
const QUERIES: usize = 4;

/// Latents by row, and the frame of each row.
///
/// A query first computes scores of all rows in f32. The rows whose scores are low enough to be among the
/// nearest, in spite of the error of f32, are compared in f64. Answers and their order are those of a scan in
/// f64.
#[derive(Debug, Clone)]
pub struct ExactIndex {
    /// In ascending order.
    frames: Vec<FrameId>,
    width: usize,
    /// The latents, row by row.
    values: Vec<f64>,
    rows: ScoredRows,
}

impl ExactIndex {
    /// Indexes the rows of `latents` (n, k) that belong to `frames`.
    pub fn new(latents: ArrayView2<'_, f64>, frames: &[FrameId]) -> Self {
        let mut frames = frames.to_vec();
        frames.sort_unstable();
        let rows: Vec<usize> = frames.iter().map(|frame| frame.row()).collect();
        Self::of_frames(latents.select(Axis(0), &rows).view(), &frames)
    }

    /// Indexes the rows of `latents` (n, k), one for each of `frames`, which are in ascending order.
    pub fn of_frames(latents: ArrayView2<'_, f64>, frames: &[FrameId]) -> Self {
        Self {
            frames: frames.to_vec(),
            width: latents.ncols(),
            rows: ScoredRows::new(latents),
            values: latents.iter().copied().collect(),
        }
    }

    /// The indexed rows in the order of their frames, shape (n, k).
    pub fn rows(&self) -> Array2<f64> {
        let shape = (self.frames.len(), self.width);
        Array2::from_shape_fn(shape, |(row, column)| {
            self.values[row * self.width + column]
        })
    }

    /// The nearest of some queries that are compared with all rows in one pass.
    fn nearest_in_one_pass<const QUERIES: usize>(
        &self,
        queries: [&[f64]; QUERIES],
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> [Vec<Neighbor>; QUERIES] {
        let excluded = self.positions(exclusion);
        let mut scores = self.rows.scores(queries);
        for position in excluded.clone() {
            for scores in &mut scores[position / LANES] {
                scores[position % LANES] = f32::INFINITY;
            }
        }

        std::array::from_fn(|which| {
            let mut nearest = Nearest::new(k);
            for position in self.candidates(&scores, which, k, queries[which]) {
                if !excluded.contains(&position) {
                    nearest.offer(self.neighbor(position, queries[which]));
                }
            }
            nearest.found()
        })
    }

    /// Positions that include those of the `k` nearest rows.
    fn candidates<const QUERIES: usize>(
        &self,
        scores: &Scores<QUERIES>,
        which: usize,
        k: usize,
        query: &[f64],
    ) -> Vec<usize> {
        let error = self.rows.error(query);
        let kth = kth_score_at_most(scores, which, k).filter(|_| error.is_finite());
        let Some(kth) = kth else {
            return (0..self.frames.len()).collect();
        };

        // Both scores of a comparison may be wrong.
        let bound = ((f64::from(kth) + 2.0 * error) as f32).next_up();
        let mut found = Vec::new();
        for (block, scores) in scores.iter().enumerate() {
            let scores = scores[which];
            // Without branches, so that the rows are compared together.
            if scores
                .iter()
                .fold(false, |is_any, &score| is_any | (score <= bound))
            {
                let near = (0..LANES).filter(|&lane| scores[lane] <= bound);
                found.extend(near.map(|lane| block * LANES + lane));
            }
        }
        found
    }

    fn neighbor(&self, position: usize, query: &[f64]) -> Neighbor {
        let row = &self.values[position * self.width..][..self.width];
        Neighbor {
            frame: self.frames[position],
            distance: distance(row, query),
        }
    }

    /// The indexed row of a frame, shape (k,); `None` if the frame is not indexed.
    pub fn row(&self, frame: FrameId) -> Option<&[f64]> {
        let position = self.frames.binary_search(&frame).ok()?;
        self.values.get(position * self.width..)?.get(..self.width)
    }

    /// The positions of the excluded frames.
    fn positions(&self, exclusion: Option<Exclusion>) -> Range<usize> {
        let Some(exclusion) = exclusion else {
            return 0..0;
        };
        let Exclusion { center, radius } = exclusion;
        let before = |row: u32| self.frames.partition_point(|frame| frame.0 < row);
        let end = center.0.saturating_add(radius).saturating_add(1);
        before(center.0.saturating_sub(radius))..before(end)
    }
}

/// An upper bound of the `k`-th least score of a query; `None` if it cannot be told, as for few rows.
fn kth_score_at_most<const QUERIES: usize>(
    scores: &Scores<QUERIES>,
    which: usize,
    k: usize,
) -> Option<f32> {
    // At least k rows have scores up to the k-th of the least scores of parts of the rows. Each lane of some
    // blocks is a part; with 2k times as many parts as lanes, the bound is low.
    let blocks = scores.len() / k.saturating_mul(2).max(1);
    let mut least: Vec<f32> = scores
        .chunks(blocks.max(1))
        .flat_map(|blocks| {
            let mut least = [f32::INFINITY; LANES];
            for block in blocks {
                for (least, &score) in least.iter_mut().zip(&block[which]) {
                    *least = least.min(score);
                }
            }
            least
        })
        .collect();

    let place = k.checked_sub(1).filter(|&place| place < least.len())?;
    let (_, &mut kth, _) = least.select_nth_unstable_by(place, f32::total_cmp);
    kth.is_finite().then_some(kth)
}

impl Index for ExactIndex {
    fn nearest(&self, query: &[f64], k: usize, exclusion: Option<Exclusion>) -> Vec<Neighbor> {
        let [nearest] = self.nearest_in_one_pass([query], k, exclusion);
        nearest
    }

    fn nearest_of_each(
        &self,
        queries: &[&[f64]],
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> Vec<Vec<Neighbor>> {
        let (fours, rest) = queries.as_chunks::<QUERIES>();
        let found = fours
            .iter()
            .flat_map(|&four| self.nearest_in_one_pass(four, k, exclusion));
        let rest = rest.iter().map(|query| self.nearest(query, k, exclusion));
        found.chain(rest).collect()
    }

    fn memory_bytes(&self) -> usize {
        size_of_val(self.values.as_slice())
            + size_of_val(self.frames.as_slice())
            + self.rows.memory_bytes()
    }

    fn len(&self) -> usize {
        self.frames.len()
    }
}

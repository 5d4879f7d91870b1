//! Exact search: the reference for other indexes.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, Axis};

use super::scores::{LANES, ScoredQuery, ScoredRows};
use super::{Collector, Exclusion, Index, Nearest, Neighbor, distance};
use crate::room::FrameId;

/// Queries that are compared with the frames in one pass.
const QUERIES: usize = 4;
/// Growth factor of the number of blocks searched until a first limit is known.
const MORE_BLOCKS: usize = 8;

/// Latents by row, and the frame of each row.
///
/// A query first computes a lower bound for each block of rows, in f32. The blocks are searched in
/// the order of their bounds, until none can hold a row that is nearer than those found: first in
/// f32, then, for the rows that are near enough in spite of the error of f32, in f64. Answers and
/// their order are those of a scan in f64.
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

    /// Indexes the rows of `latents` (n, k), one for each of `frames`, which are in ascending
    /// order.
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

    /// The nearest of some queries whose bounds are computed in one pass over the rows.
    fn nearest_in_one_pass<const QUERIES: usize>(
        &self,
        queries: [&[f64]; QUERIES],
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> [Vec<Neighbor>; QUERIES] {
        let excluded = self.positions(exclusion);
        let scored = queries.map(|query| self.rows.query(query));
        let bounds = self.rows.least_bounds(scored.each_ref());

        std::array::from_fn(|which| {
            let search = Search {
                index: self,
                query: queries[which],
                scored: &scored[which],
                excluded: excluded.clone(),
                nearest: Nearest::new(k),
            };
            let bounds: Vec<f32> = bounds.iter().map(|bounds| bounds[which]).collect();
            search.found(&bounds).found()
        })
    }

    /// Number of columns.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// Searches for what `nearest` collects.
    pub(super) fn collected<C: Collector>(&self, query: &[f64], nearest: C) -> C {
        let scored = self.rows.query(query);
        let bounds = self.rows.least_bounds([&scored]);
        let search = Search {
            index: self,
            query,
            scored: &scored,
            excluded: 0..0,
            nearest,
        };
        let bounds: Vec<f32> = bounds.iter().map(|[bound]| *bound).collect();
        search.found(&bounds)
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

/// The search for one query's nearest rows.
struct Search<'a, C> {
    index: &'a ExactIndex,
    query: &'a [f64],
    scored: &'a ScoredQuery,
    /// Positions that are not answers.
    excluded: Range<usize>,
    nearest: C,
}

impl<C: Collector> Search<'_, C> {
    /// The nearest rows, given the least lower bound of each block's scores.
    fn found(mut self, bounds: &[f32]) -> C {
        if !self.scored.has_scores() {
            (0..bounds.len()).for_each(|block| self.search_block(block));
            return self.nearest;
        }

        // First the most promising blocks, with enough rows for an answer. They give the limit for
        // the others. If their rows belong to too few parts, search more blocks.
        let wanted = self.nearest.count().saturating_add(self.excluded.len());
        let mut blocks = wanted.div_ceil(LANES).max(1);
        let mut searched = f32::NEG_INFINITY;
        loop {
            let least = nth_least(bounds, blocks);
            self.search_each(bounds, |bound| bound > searched && bound <= least);
            searched = least;
            if self.nearest.worst().is_some() || blocks >= bounds.len() {
                break;
            }
            blocks = blocks.saturating_mul(MORE_BLOCKS);
        }
        let limit = self.limit();
        self.search_each(bounds, |bound| bound > searched && bound <= limit);
        self.nearest
    }

    /// Searches some blocks, the most promising first, as long as they can hold an answer.
    fn search_each(&mut self, bounds: &[f32], is_among: impl Fn(f32) -> bool) {
        let blocks = bounds.iter().copied().zip(0..);
        let mut blocks: Vec<(f32, usize)> = blocks.filter(|&(bound, _)| is_among(bound)).collect();
        blocks.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        for (bound, block) in blocks {
            if bound > self.limit() {
                break;
            }
            self.search_block(block);
        }
    }

    /// Compares the rows of a block that can be answers.
    fn search_block(&mut self, block: usize) {
        let limit = self.limit();
        let scores = self.index.rows.scores(block, self.scored);
        // Without branches, so that the rows are compared together.
        let is_any_near = scores
            .iter()
            .fold(false, |any, &score| any | (score <= limit));
        if !is_any_near && self.scored.has_scores() {
            return;
        }
        let positions = block * LANES..self.index.frames.len().min((block + 1) * LANES);
        for (position, score) in positions.zip(scores) {
            let can_be_near = score <= limit || !self.scored.has_scores();
            if can_be_near && !self.excluded.contains(&position) {
                self.nearest
                    .offer(self.index.neighbor(position, self.query));
            }
        }
    }

    /// The most that the score of an answer can be.
    fn limit(&self) -> f32 {
        let worst = self.nearest.worst();
        worst.map_or(f32::INFINITY, |worst| self.scored.score_at(worst))
    }
}

/// The `n`-th least of some numbers; the largest if there are fewer.
fn nth_least(numbers: &[f32], n: usize) -> f32 {
    if n <= 1 || numbers.is_empty() {
        return numbers.iter().copied().fold(f32::INFINITY, f32::min);
    }

    let mut numbers = numbers.to_vec();
    let place = n.min(numbers.len()) - 1;
    *numbers.select_nth_unstable_by(place, f32::total_cmp).1
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

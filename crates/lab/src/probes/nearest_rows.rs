//! The nearest rows of every row.
//!
//! Scores of all pairs come from matrix products in f32. The rows whose scores are low enough to be
//! among the nearest, in spite of the error of f32, are compared in f64: the expansion ‖x‖² − 2xy +
//! ‖y‖² would cancel for near duplicates. So the answer is that of comparing all pairs in f64.

use std::ops::Range;

use ndarray::{Array2, ArrayView1, ArrayView2, Axis, s};
use rayon::prelude::*;
use seese3_core::index::distance;

/// Rows whose products with all rows are computed together.
const ROWS_AT_A_TIME: usize = 256;
/// Least number of parts of the rows whose least scores bound the k-th least score.
const PARTS: usize = 64;

/// A row that has too few candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooFewCandidates {
    /// The row.
    pub row: usize,
}

/// The `k` nearest rows of each row with their distances, nearest first; ties go to the smaller
/// row. `excluded` gives the rows that are no candidates of a row; it has to contain the row
/// itself, and end within the rows.
///
/// # Errors
/// [`TooFewCandidates`] for the first row with fewer than `k`.
pub fn nearest_rows(
    rows: ArrayView2<'_, f64>,
    k: usize,
    excluded: impl Fn(usize) -> Range<usize> + Sync,
) -> Result<Vec<Vec<(f64, usize)>>, TooFewCandidates> {
    let scores = Scores::new(rows);
    let starts: Vec<usize> = (0..rows.nrows()).step_by(ROWS_AT_A_TIME).collect();
    let rows = rows.as_standard_layout();
    let of_chunk = |&start: &usize| -> Result<Vec<Vec<(f64, usize)>>, TooFewCandidates> {
        let products = scores.products(start);
        let of_row = |(products, row): (ArrayView1<'_, f32>, usize)| {
            let near = scores.near(products, excluded(row), k);
            let near = near.ok_or(TooFewCandidates { row })?;

            let slice = |row: usize| rows.row(row).to_slice();
            let exact = |other: usize| Some((distance(slice(row)?, slice(other)?), other));
            let mut found: Vec<(f64, usize)> = near.into_iter().filter_map(exact).collect();
            found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            found.truncate(k);
            Ok(found)
        };
        products.outer_iter().zip(start..).map(of_row).collect()
    };

    let chunks: Vec<_> = starts.par_iter().map(of_chunk).collect();
    let chunks: Vec<_> = chunks.into_iter().collect::<Result<_, _>>()?;
    Ok(chunks.into_iter().flatten().collect())
}

/// Rows less their mean, scaled to lengths of at most 1.
struct Scores {
    rows: Array2<f32>,
    /// ‖x‖²/2.
    half_squares: Vec<f32>,
}

impl Scores {
    fn new(rows: ArrayView2<'_, f64>) -> Self {
        let mut centered = rows.to_owned();
        if let Some(mean) = rows.mean_axis(Axis(0)) {
            centered -= &mean;
        }
        let norm = |row: ArrayView1<'_, f64>| row.dot(&row).sqrt();
        let largest = centered.outer_iter().map(norm).fold(0.0, f64::max);
        if largest > 0.0 {
            centered /= largest;
        }

        let half_square = |row: ArrayView1<'_, f64>| (0.5 * row.dot(&row)) as f32;
        Self {
            half_squares: centered.outer_iter().map(half_square).collect(),
            rows: centered.mapv(|x| x as f32),
        }
    }

    /// The products of [`ROWS_AT_A_TIME`] rows, from `start` on, with all rows.
    fn products(&self, start: usize) -> Array2<f32> {
        let end = (start + ROWS_AT_A_TIME).min(self.rows.nrows());
        self.rows.slice(s![start..end, ..]).dot(&self.rows.t())
    }

    /// Rows that include the `k` nearest; `None` if there are fewer candidates than `k`.
    fn near(
        &self,
        products: ArrayView1<'_, f32>,
        excluded: Range<usize>,
        k: usize,
    ) -> Option<Vec<usize>> {
        let rows = 0..self.half_squares.len();
        if rows.len() - excluded.len() < k {
            return None;
        }
        let scores = self.half_squares.iter().zip(products);
        let mut scores: Vec<f32> = scores.map(|(half, product)| half - product).collect();
        scores[excluded.clone()].fill(f32::INFINITY);

        // A score of w columns is a sum of w + 1 terms, which are at most 1 together; operands and
        // partial sums are rounded. Both scores of a comparison may be wrong.
        let roundings = 2.0 * (self.rows.ncols() + 2) as f32;
        let limit = kth_at_most(&scores, k) + 2.0 * roundings * f32::EPSILON;
        let is_near = |&row: &usize| scores[row] <= limit || !scores[row].is_finite();
        let is_candidate = |row: &usize| !excluded.contains(row);
        Some(rows.filter(is_near).filter(is_candidate).collect())
    }
}

/// An upper bound of the `k`-th least number: at least `k` numbers are at most the `k`-th of the
/// least ones of parts. Neighboring numbers are in different parts, because neighboring rows are
/// alike.
fn kth_at_most(numbers: &[f32], k: usize) -> f32 {
    let parts = PARTS.max(4 * k);
    let mut least = vec![f32::INFINITY; parts];
    for numbers in numbers.chunks(parts) {
        for (least, &number) in least.iter_mut().zip(numbers) {
            *least = if number < *least { number } else { *least };
        }
    }

    let place = k.saturating_sub(1);
    *least.select_nth_unstable_by(place, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: comparing all pairs in f64, among duplicates, near ties, and far from zero and from
    /// one.
    #[test]
    fn the_nearest_rows_are_those_of_all_pairs() {
        for (columns, scale, offset, noise) in [
            (3, 1.0, 0.0, 1e-15),
            (40, 1e-150, 0.0, 0.0),
            (40, 1e150, 1.0, 1e-9),
            (768, 1e3, 1e4, 1e-6),
            (9, 0.0, 0.0, 0.0),
        ] {
            let place =
                |row: usize, column: usize| ((row / 5 * 7 + column * 3) as f64 * 0.61).sin();
            let shake = |row: usize, column: usize| ((row * 13 + column) as f64).cos();
            let rows = Array2::from_shape_fn((300, columns), |(row, column)| {
                scale * (offset + place(row, column) + noise * shake(row, column))
            });
            let excluded = |row: usize| row.saturating_sub(2)..(row + 3).min(300);

            let found = nearest_rows(rows.view(), 7, excluded).unwrap();
            for (row, found) in found.iter().enumerate() {
                let far =
                    |other: usize| distance(&rows.row(row).to_vec(), &rows.row(other).to_vec());
                let others = (0..300).filter(|&other| row.abs_diff(other) > 2);
                let mut expected: Vec<(f64, usize)> =
                    others.map(|other| (far(other), other)).collect();
                expected.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                assert_eq!(*found, expected[..7], "{columns} columns, row {row}");
            }
        }
    }

    /// Oracle: by hand: of six rows, row 2 may have rows 0 and 5 as neighbors, the others all but
    /// themselves.
    #[test]
    fn a_row_with_too_few_candidates_is_named() {
        let rows = Array2::from_shape_fn((6, 1), |(row, _)| row as f64);
        let excluded = |row: usize| if row == 2 { 1..5 } else { row..row + 1 };
        let found = nearest_rows(rows.view(), 2, excluded).unwrap();
        assert_eq!(found[2], [(2.0, 0), (3.0, 5)]);
        let found = nearest_rows(rows.view(), 3, excluded);
        assert_eq!(found, Err(TooFewCandidates { row: 2 }));
    }
}

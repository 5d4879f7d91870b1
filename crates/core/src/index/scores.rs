//! Approximate distances of all rows from several queries at once, in f32.

use multiversion::multiversion;
use ndarray::{ArrayView2, Axis};

/// Rows of a block: their scores are computed together, by SIMD instructions where there are any.
pub const LANES: usize = 16;

/// Half of the distance between 1 and the next number.
const ROUNDING: [f64; 2] = [f32::EPSILON as f64 / 2.0, f64::EPSILON / 2.0];

/// The most that a sum of squares may be: above it, f32 could overflow.
const LARGEST_SQUARE: f64 = 1e37;

/// Rows that are ordered by score: ‖x‖²/2 − x·q for row x and query q. As ‖x − q‖²/2 is the score plus
/// ‖q‖²/2, the order is that of the distances.
#[derive(Debug, Clone)]
pub struct ScoredRows {
    /// Subtracted from rows and queries: errors of rounding grow with the numbers.
    mean: Vec<f64>,
    /// The rows in blocks of [`LANES`]; for each column, its values in the block's rows. Zeros fill the last
    /// block.
    columns: Vec<[f32; LANES]>,
    /// ‖x‖²/2 of each row, by block; infinity fills the last block.
    half_squares: Vec<[f32; LANES]>,
    /// The largest norm of a row, less the mean.
    largest_norm: f64,
    /// The largest norm of a row plus twice that of the mean.
    largest_operand: f64,
}

/// A query's scores: those of `LANES` rows for each block.
pub type Scores<const QUERIES: usize> = Vec<[[f32; LANES]; QUERIES]>;

impl ScoredRows {
    /// Prepares the rows of `rows` (n, k).
    pub fn new(rows: ArrayView2<'_, f64>) -> Self {
        let width = rows.ncols();
        let mean = rows
            .mean_axis(Axis(0))
            .map_or(vec![0.0; width], |mean| mean.to_vec());
        let blocks = rows.nrows().div_ceil(LANES);
        let mut columns = vec![[0.0; LANES]; blocks * width];
        let mut half_squares = vec![[f32::INFINITY; LANES]; blocks];

        let [mut largest_norm, mut largest_row] = [0.0_f64; 2];
        for (position, row) in rows.outer_iter().enumerate() {
            let (block, lane) = (position / LANES, position % LANES);
            let centered: Vec<f64> = row.iter().zip(&mean).map(|(x, mean)| x - mean).collect();
            for (column, &x) in columns[block * width..].iter_mut().zip(&centered) {
                column[lane] = x as f32;
            }
            let square = norm(&centered).powi(2);
            half_squares[block][lane] = (0.5 * square) as f32;
            largest_norm = largest_norm.max(square.sqrt());
            largest_row = largest_row.max(norm(row.iter()));
        }

        Self {
            largest_operand: largest_row + 2.0 * norm(&mean),
            mean,
            columns,
            half_squares,
            largest_norm,
        }
    }

    /// The scores of all rows for each of the queries.
    pub fn scores<const QUERIES: usize>(&self, queries: [&[f64]; QUERIES]) -> Scores<QUERIES> {
        let negated =
            |column: usize| queries.map(|query| (self.mean[column] - query[column]) as f32);
        let negated: Vec<[f32; QUERIES]> = (0..self.mean.len()).map(negated).collect();
        scores(&self.columns, &self.half_squares, &negated)
    }

    /// Upper bound of the error of a score for this query; infinity where f32 could overflow.
    ///
    /// With w columns and lengths up to s, a score is a sum of w + 1 terms of at most s². Each operand and each
    /// partial sum is rounded to f32, and before that the difference from the mean to f64.
    pub fn error(&self, query: &[f64]) -> f64 {
        let centered = query.iter().zip(&self.mean).map(|(x, mean)| x - mean);
        let spread = self.largest_norm + centered.map(|x| x * x).sum::<f64>().sqrt();
        let operand = self.largest_operand + norm(query);
        let square = spread * spread;
        if square.is_nan() || square >= LARGEST_SQUARE {
            return f64::INFINITY;
        }

        let roundings = 2.0 * (self.mean.len() + 2) as f64;
        let [single, double] = ROUNDING;
        // The last term is the error of products that underflow.
        roundings
            * (spread * (single * spread + 2.0 * double * operand) + f64::from(f32::MIN_POSITIVE))
    }

    /// Memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        size_of_val(self.columns.as_slice()) + size_of_val(self.half_squares.as_slice())
    }
}

fn norm<'a>(row: impl IntoIterator<Item = &'a f64>) -> f64 {
    row.into_iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// The scores of all blocks, by the widest instructions of this processor. Loops over indexes: closures would be
/// compiled without those instructions.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn scores<const QUERIES: usize>(
    columns: &[[f32; LANES]],
    half_squares: &[[f32; LANES]],
    negated: &[[f32; QUERIES]],
) -> Scores<QUERIES> {
    let mut scores = vec![[[0.0; LANES]; QUERIES]; half_squares.len()];
    let blocks = columns.chunks_exact(negated.len()).zip(half_squares);
    for ((block, half_squares), scores) in blocks.zip(&mut scores) {
        // A copy on the stack stays in registers.
        let mut sums = [*half_squares; QUERIES];
        for (column, negated) in block.iter().zip(negated) {
            for query in 0..QUERIES {
                for lane in 0..LANES {
                    sums[query][lane] += column[lane] * negated[query];
                }
            }
        }
        *scores = sums;
    }

    scores
}

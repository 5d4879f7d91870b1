//! Approximate distances of all rows from a query in f32, and lower bounds of them that read a few
//! columns only.

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2, Axis};

use crate::matrices::{to_nalgebra, to_ndarray};

/// Rows of a block: they are compared together, by SIMD instructions where there are any.
pub const LANES: usize = 16;

/// Directions whose coordinates a lower bound reads. Latents of an adapter vary in about six
/// directions, as motions do.
const DIRECTIONS: usize = 7;
/// The coordinates along the directions and the length of the rest.
const BOUND_COLUMNS: usize = DIRECTIONS + 1;
/// Blocks whose bounds are computed before the least of each is taken: in one loop, the compiler
/// would not use whole registers.
const BLOCKS_AT_A_TIME: usize = 16;
/// Approximate number of rows that the directions are chosen by.
const CHOOSING_ROWS: usize = 1_024;
/// Steps of the subspace iteration that chooses them.
const ITERATIONS: usize = 4;

/// Half of the distance between 1 and the next number.
const ROUNDING: [f64; 2] = [f32::EPSILON as f64 / 2.0, f64::EPSILON / 2.0];

/// The largest sum of squares that is computed in f32: above it, f32 could overflow.
const LARGEST_SQUARE: f64 = 1e37;

/// Rows that are ordered by score: ‖x‖²/2 − x·q for row x and query q. As ‖x − q‖²/2 is the score
/// plus ‖q‖²/2, the order is that of the distances.
///
/// With orthonormal directions D, x·q is at most Dx·Dq plus the product of the lengths of what the
/// directions leave of x and q (Cauchy and Schwarz). So a lower bound of the score reads
/// [`BOUND_COLUMNS`] numbers of a row, however wide it is. It is close if the directions carry most
/// of the rows' variance.
#[derive(Debug, Clone)]
pub struct ScoredRows {
    /// Subtracted from rows and queries: errors of rounding grow with the numbers.
    mean: Vec<f64>,
    /// D, shape (at most [`DIRECTIONS`], k).
    directions: Array2<f64>,
    /// The rows in blocks of [`LANES`]; for each column, its values in the block's rows. Zeros fill
    /// the last block.
    columns: Vec<[f32; LANES]>,
    /// The same for Dx and the length of the rest.
    bound_columns: Vec<[[f32; LANES]; BOUND_COLUMNS]>,
    /// ‖x‖²/2 of each row, by block; infinity fills the last block.
    half_squares: Vec<[f32; LANES]>,
    /// The largest norm of a row, less the mean.
    largest_norm: f64,
    /// The largest norm of a row plus twice that of the mean.
    largest_operand: f64,
}

/// A query, as it is compared with the rows.
#[derive(Debug, Clone)]
pub struct ScoredQuery {
    /// The query less the mean, times −1.
    negated: Vec<f32>,
    /// Its coordinates along the directions and the length of its rest, times −1.
    negated_bound: [f32; BOUND_COLUMNS],
    /// Half the square of its length.
    half_square: f64,
    /// Upper bound of the error of a score and of a lower bound; infinity where f32 could overflow.
    error: f64,
}

impl ScoredQuery {
    /// Whether scores in f32 can be used for this query.
    pub fn has_scores(&self) -> bool {
        self.error.is_finite()
    }

    /// The most that the computed score, or its computed lower bound, of a row at most this far
    /// away can be.
    pub fn score_at(&self, distance: f64) -> f32 {
        let score = 0.5 * distance * distance - self.half_square;
        // Twice the error: the distance is rounded too.
        ((score + 2.0 * self.error) as f32).next_up()
    }
}

impl ScoredRows {
    /// Prepares the rows of `rows` (n, k).
    pub fn new(rows: ArrayView2<'_, f64>) -> Self {
        let width = rows.ncols();
        let mean = rows
            .mean_axis(Axis(0))
            .map_or(vec![0.0; width], |mean| mean.to_vec());
        let centered = |row: usize| -> Vec<f64> {
            let values = rows.row(row);
            values.iter().zip(&mean).map(|(x, mean)| x - mean).collect()
        };

        let largest_row = rows.outer_iter().map(norm).fold(0.0, f64::max);
        let norms: Vec<f64> = (0..rows.nrows()).map(|row| norm(&centered(row))).collect();
        let largest_norm = norms.iter().copied().fold(0.0, f64::max);
        let choosing = rows.nrows().div_ceil(CHOOSING_ROWS).max(1);
        let chosen: Vec<f64> = (0..rows.nrows())
            .step_by(choosing)
            .flat_map(centered)
            .map(|x| x / largest_norm)
            .collect();
        let directions = directions(&chosen, width);

        let blocks = rows.nrows().div_ceil(LANES);
        let mut columns = vec![[0.0; LANES]; blocks * width];
        let mut bound_columns = vec![[[0.0; LANES]; BOUND_COLUMNS]; blocks];
        let mut half_squares = vec![[f32::INFINITY; LANES]; blocks];
        for (position, norm) in norms.iter().enumerate() {
            let (block, lane) = (position / LANES, position % LANES);
            let row = centered(position);
            for (column, &x) in columns[block * width..].iter_mut().zip(&row) {
                column[lane] = x as f32;
            }
            let bound = of_bound(&directions, row);
            for (column, x) in bound_columns[block].iter_mut().zip(bound) {
                column[lane] = x as f32;
            }
            half_squares[block][lane] = (0.5 * norm * norm) as f32;
        }

        Self {
            largest_operand: largest_row + 2.0 * norm(&mean),
            mean,
            directions,
            columns,
            bound_columns,
            half_squares,
            largest_norm,
        }
    }

    /// Prepares a query of k numbers.
    pub fn query(&self, query: &[f64]) -> ScoredQuery {
        let centered: Vec<f64> = query.iter().zip(&self.mean).map(|(x, m)| x - m).collect();
        let length = norm(&centered);

        ScoredQuery {
            negated: centered.iter().map(|&x| -x as f32).collect(),
            error: self.error(length, norm(query)),
            negated_bound: of_bound(&self.directions, centered).map(|x| -x as f32),
            half_square: 0.5 * length * length,
        }
    }

    /// Upper bound of the error of a score and of a lower bound for a query of this length without
    /// the mean, and with it.
    ///
    /// With w columns and lengths up to s, either is a sum of w + 1 terms of at most s². Each
    /// operand and each partial sum is rounded to f32, and before that the difference from the
    /// mean, the coordinates and the directions to f64.
    fn error(&self, centered: f64, query: f64) -> f64 {
        let spread = self.largest_norm + centered;
        let operand = self.largest_operand + query;
        let square = spread * spread;
        if square.is_nan() || square >= LARGEST_SQUARE {
            return f64::INFINITY;
        }

        let roundings = 2.0 * (self.mean.len().max(BOUND_COLUMNS) + 2) as f64;
        let [single, double] = ROUNDING;
        let rounded = single * spread + double * (2.0 * operand + 8.0 * spread);
        // The last term is the error of products that underflow.
        roundings * (spread * rounded + f64::from(f32::MIN_POSITIVE))
    }

    /// The least lower bound of each block's scores, for each of the queries.
    pub fn least_bounds<const QUERIES: usize>(
        &self,
        queries: [&ScoredQuery; QUERIES],
    ) -> Vec<[f32; QUERIES]> {
        let negated = std::array::from_fn(|column| queries.map(|q| q.negated_bound[column]));
        least_bounds(&self.bound_columns, &self.half_squares, &negated)
    }

    /// The scores of a block's rows.
    pub fn scores(&self, block: usize, query: &ScoredQuery) -> [f32; LANES] {
        let width = self.mean.len();
        let columns = &self.columns[block * width..][..width];
        scores(columns, self.half_squares[block], &query.negated)
    }

    /// Memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        size_of_val(self.columns.as_slice())
            + size_of_val(self.bound_columns.as_slice())
            + size_of_val(self.half_squares.as_slice())
    }
}

fn norm<'a>(row: impl IntoIterator<Item = &'a f64>) -> f64 {
    row.into_iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Orthonormal directions of about the most variance of rows of `width` numbers, shape (at most
/// [`DIRECTIONS`], k), by subspace iteration. Bounds hold for any orthonormal directions.
fn directions(rows: &[f64], width: usize) -> Array2<f64> {
    let count = DIRECTIONS.min(width);
    // The columns of the largest squares come first: the iteration needs a start that is not
    // constant.
    let mut squares = vec![0.0; width];
    for row in rows.chunks_exact(width.max(1)) {
        for (sum, x) in squares.iter_mut().zip(row) {
            *sum += x * x;
        }
    }
    let mut columns: Vec<usize> = (0..width).collect();
    columns.sort_by(|&a, &b| f64::total_cmp(&squares[b], &squares[a]));
    let unit = Array2::from_shape_fn((width, count), |(row, column)| {
        f64::from(row == columns[column])
    });
    let shape = (rows.len() / width.max(1), width);
    let finite = rows.iter().all(|x| x.is_finite());
    let usable = finite && !rows.is_empty();
    let Some(rows) = ArrayView2::from_shape(shape, rows).ok().filter(|_| usable) else {
        return unit.t().as_standard_layout().into_owned();
    };

    let step = |directions: Array2<f64>, _| {
        let scattered = rows.t().dot(&rows.dot(&directions));
        to_ndarray(&to_nalgebra(scattered.view()).qr().q())
    };
    let found = (0..ITERATIONS).fold(unit, step);
    found.t().as_standard_layout().into_owned()
}

/// Coordinates along the directions, padded with zeros, and the length of the rest.
fn of_bound(directions: &Array2<f64>, mut row: Vec<f64>) -> [f64; BOUND_COLUMNS] {
    let mut found = [0.0; BOUND_COLUMNS];
    let directions = directions.as_slice().unwrap_or_default();
    let directions = directions.chunks_exact(row.len().max(1));
    for (direction, found) in directions.zip(&mut found) {
        let products = direction.iter().zip(&row).map(|(d, x)| d * x);
        let along = products.sum::<f64>();
        for (x, d) in row.iter_mut().zip(direction) {
            *x -= along * d;
        }
        *found = along;
    }

    found[DIRECTIONS] = norm(&row);
    found
}

/// [`ScoredRows::least_bounds`] by the widest instructions of this processor. Loops over indexes:
/// closures would be compiled without those instructions.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn least_bounds<const QUERIES: usize>(
    columns: &[[[f32; LANES]; BOUND_COLUMNS]],
    half_squares: &[[f32; LANES]],
    negated: &[[f32; QUERIES]; BOUND_COLUMNS],
) -> Vec<[f32; QUERIES]> {
    let mut least = vec![[0.0; QUERIES]; half_squares.len()];
    let blocks = columns
        .chunks(BLOCKS_AT_A_TIME)
        .zip(half_squares.chunks(BLOCKS_AT_A_TIME));
    for ((blocks, half_squares), least) in blocks.zip(least.chunks_mut(BLOCKS_AT_A_TIME)) {
        let mut bounds = [[[0.0; LANES]; QUERIES]; BLOCKS_AT_A_TIME];
        for ((block, half_squares), bounds) in blocks.iter().zip(half_squares).zip(&mut bounds) {
            // A copy on the stack stays in registers.
            let mut sums = [*half_squares; QUERIES];
            for column in 0..BOUND_COLUMNS {
                for query in 0..QUERIES {
                    for lane in 0..LANES {
                        sums[query][lane] += block[column][lane] * negated[column][query];
                    }
                }
            }
            *bounds = sums;
        }

        for (least, bounds) in least.iter_mut().zip(&mut bounds) {
            for query in 0..QUERIES {
                least[query] = least_of(&mut bounds[query]);
            }
        }
    }

    least
}

/// The least of a block's numbers.
#[inline(always)]
fn least_of(numbers: &mut [f32; LANES]) -> f32 {
    let mut half = LANES / 2;
    while half > 0 {
        for lane in 0..half {
            let [a, b] = [numbers[lane], numbers[lane + half]];
            // Not f32::min, which takes more instructions because of NaN.
            numbers[lane] = if b < a { b } else { a };
        }
        half /= 2;
    }
    numbers[0]
}

/// The scores of a block, by the widest instructions of this processor.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn scores(columns: &[[f32; LANES]], half_squares: [f32; LANES], negated: &[f32]) -> [f32; LANES] {
    let mut sums = half_squares;
    for (column, &negated) in columns.iter().zip(negated) {
        for lane in 0..LANES {
            sums[lane] += column[lane] * negated;
        }
    }

    sums
}

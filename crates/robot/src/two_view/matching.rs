//! Subcell matches between two feature maps.

use nalgebra::Vector2;
use ndarray::{Array2, ArrayView3, Axis};

use super::Match;
use seese3_core::geometry::CameraIntrinsics;

/// Standard deviation of a match with reference margin and curvature, in image widths: 0.8 of 320
/// pixels.
const DEVIATION: f64 = 0.8 / 320.0;

/// Reference values and exponents of the margin and the curvature of a match. Its deviation is
/// [`DEVIATION`] · (margin / 0.1)^−0.7 · (curvature / 0.05)^−0.5.
const MARGIN: (f64, f64) = (0.1, 0.7);
const CURVATURE: (f64, f64) = (0.05, 0.5);

/// Minimum and maximum of the factor on [`DEVIATION`].
const FACTORS: (f64, f64) = (0.4, 8.0);

/// Largest factor on [`DEVIATION`] of a sharp match.
const SHARP: f64 = 2.0;

/// The shape of a feature map.
#[derive(Clone, Copy)]
struct Cells {
    rows: usize,
    columns: usize,
}

/// Mutual nearest-neighbor matches of the cells, refined to subcell accuracy.
pub(super) fn matches(
    first: ArrayView3<'_, f32>,
    second: ArrayView3<'_, f32>,
    camera: &CameraIntrinsics,
) -> Vec<Match> {
    let cells = Cells {
        rows: first.shape()[1],
        columns: first.shape()[2],
    };
    let similar = similarity(first, second, cells);
    let nearest_second: Vec<usize> = similar.outer_iter().map(|row| argmax(row.iter())).collect();
    let nearest_first: Vec<usize> = similar
        .axis_iter(Axis(1))
        .map(|column| argmax(column.iter()))
        .collect();

    let mutual = nearest_second
        .iter()
        .enumerate()
        .filter(|&(from, &to)| nearest_first[to] == from);

    mutual
        .filter_map(|(from, &to)| {
            let row = similar.row(from);
            let peak = Peak::of(row.as_slice()?, to, cells)?;
            let middle = |column: f64, row: f64| {
                Vector2::new(
                    (column + 0.5) / cells.columns as f64,
                    (row + 0.5) / cells.rows as f64 * camera.height(),
                )
            };

            let at = middle((from % cells.columns) as f64, (from / cells.columns) as f64);
            Some(Match {
                direction: camera.to_image_plane(at).push(1.0),
                point: camera.to_image_plane(middle(peak.column, peak.row)),
                deviation: DEVIATION * peak.factor() / camera.focal().x,
                is_sharp: peak.factor() <= SHARP,
            })
        })
        .collect()
}

/// Index of the largest value; of the first one if there are several.
fn argmax<'a>(values: impl Iterator<Item = &'a f32>) -> usize {
    let mut best = (0, f32::NEG_INFINITY);
    for (place, &value) in values.enumerate() {
        if value > best.1 {
            best = (place, value);
        }
    }

    best.0
}

/// Cosine similarity between every cell of the first map and every cell of the second, averaged
/// over the 3 × 3 cells around both: shape (cells of the first, cells of the second).
///
/// Neighbors beyond the edge of a map count as 0.
fn similarity(
    first: ArrayView3<'_, f32>,
    second: ArrayView3<'_, f32>,
    cells: Cells,
) -> Array2<f32> {
    let single = unit_columns(first).t().dot(&unit_columns(second));
    let Cells { rows, columns } = cells;
    let count = rows * columns;

    // Sum over vertical neighbors: one row up and one row down in both maps.
    let mut down = single.clone();
    for from in 0..count {
        let mut sums = down.row_mut(from);
        if let Some(above) = from.checked_sub(columns) {
            let other = single.row(above);
            let mut part = sums.slice_mut(ndarray::s![columns..]);
            part += &other.slice(ndarray::s![..count - columns]);
        }
        if from + columns < count {
            let other = single.row(from + columns);
            let mut part = sums.slice_mut(ndarray::s![..count - columns]);
            part += &other.slice(ndarray::s![columns..]);
        }
    }

    // Sum over horizontal neighbors: one column left and right in both maps, within a row.
    let mut all = down.clone();
    for from in 0..count {
        for row in 0..rows {
            let begin = row * columns;
            let end = begin + columns;
            let mut sums = all.row_mut(from);
            if from % columns > 0 {
                let other = down.row(from - 1);
                let mut part = sums.slice_mut(ndarray::s![begin + 1..end]);
                part += &other.slice(ndarray::s![begin..end - 1]);
            }
            if from % columns + 1 < columns {
                let other = down.row(from + 1);
                let mut part = sums.slice_mut(ndarray::s![begin..end - 1]);
                part += &other.slice(ndarray::s![begin + 1..end]);
            }
        }
    }

    all / 9.0
}

/// Cells of a map as unit-length columns, shape (channels, cells).
fn unit_columns(map: ArrayView3<'_, f32>) -> Array2<f32> {
    let channels = map.shape()[0];
    let cells = map.shape()[1] * map.shape()[2];
    let mut columns = Array2::from_shape_fn((channels, cells), |(channel, cell)| {
        map[(channel, cell / map.shape()[2], cell % map.shape()[2])]
    });

    for mut column in columns.axis_iter_mut(Axis(1)) {
        let length = column.iter().map(|value| value * value).sum::<f32>().sqrt();
        column /= length + 1e-9;
    }

    columns
}

/// Peak of a cell's similarity in the second map.
struct Peak {
    /// Position in cells; the center of cell 0 is at 0.
    column: f64,
    row: f64,
    /// Similarity of the best cell minus that of the best cell elsewhere.
    margin: f64,
    /// Smaller of the two principal curvatures at the peak, per cell².
    curvature: f64,
}

impl Peak {
    /// Refines the peak near cell `best` with a least-squares quadratic over nine cells. `None` at
    /// the edge of the map, where the true peak may lie outside.
    fn of(similar: &[f32], best: usize, cells: Cells) -> Option<Self> {
        let Cells { rows, columns } = cells;
        let best_row = best / columns;
        let best_column = best % columns;
        let row = best_row.clamp(1, rows - 2);
        let column = best_column.clamp(1, columns - 2);

        // Least squares on nine cells: the coefficients are independent weighted sums.
        let mut slope = Vector2::zeros();
        let [mut second_xx, mut second_xy, mut second_yy] = [0.0; 3];
        for (dy, dx) in (-1i32..=1).flat_map(|dy| (-1i32..=1).map(move |dx| (dy, dx))) {
            let y = row.saturating_add_signed(dy as isize);
            let x = column.saturating_add_signed(dx as isize);
            let value = f64::from(similar[y * columns + x]);
            let [dx, dy] = [f64::from(dx), f64::from(dy)];

            slope += Vector2::new(dx, dy) * value / 6.0;
            second_xx += (dx * dx - 2.0 / 3.0) * value;
            second_yy += (dy * dy - 2.0 / 3.0) * value;
            second_xy += dx * dy * value / 4.0;
        }

        let determinant = second_xx * second_yy - second_xy * second_xy;
        let (right, below) = if second_xx < 0.0 && determinant > 1e-9 {
            let right = (second_xy * slope.y - second_yy * slope.x) / determinant;
            let below = (second_xy * slope.x - second_xx * slope.y) / determinant;
            (right.clamp(-1.0, 1.0), below.clamp(-1.0, 1.0))
        } else {
            (
                best_column as f64 - column as f64,
                best_row as f64 - row as f64,
            )
        };

        let peak = Self {
            column: column as f64 + right,
            row: row as f64 + below,
            margin: f64::from(similar[best] - elsewhere(similar, best, cells)),
            curvature: -f64::midpoint(second_xx, second_yy)
                - ((second_xx - second_yy) / 2.0).hypot(second_xy),
        };
        let inside = |at: f64, count: usize| at > 0.2 && at < count as f64 - 1.2;

        (inside(peak.column, columns) && inside(peak.row, rows)).then_some(peak)
    }

    /// Factor on [`DEVIATION`]: larger for a flat peak, or one with a second peak of similar
    /// height.
    fn factor(&self) -> f64 {
        let less = |value: f64, (usual, power): (f64, f64)| (value.max(0.003) / usual).powf(-power);
        let (least, most) = FACTORS;

        (less(self.margin, MARGIN) * less(self.curvature, CURVATURE)).clamp(least, most)
    }
}

/// Largest similarity of a cell more than two rows or columns away from `best`.
fn elsewhere(similar: &[f32], best: usize, cells: Cells) -> f32 {
    let Cells { rows, columns } = cells;
    let best_row = best / columns;
    let best_column = best % columns;
    let mut largest = f32::NEG_INFINITY;

    for row in 0..rows {
        let begin = row * columns;
        let line = &similar[begin..begin + columns];
        if row.abs_diff(best_row) > 2 {
            largest = line.iter().copied().fold(largest, f32::max);
            continue;
        }

        let left = &line[..best_column.saturating_sub(2)];
        let right = &line[(best_column + 3).min(columns)..];
        largest = left.iter().chain(right).copied().fold(largest, f32::max);
    }

    largest
}

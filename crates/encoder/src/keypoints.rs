//! Detects keypoints in the outputs of a network with keypoint heads, as XFeat has them.
//!
//! - `positions` (65, h, w): for each cell of 8 × 8 pixels, the probability of a keypoint at each
//!   of its pixels, and of none.
//! - `reliability` (1, h, w): how well the descriptor of a cell can be matched, 0 to 1.
//! - `descriptors` (c, h, w): one descriptor per cell.
//!
//! A keypoint is a local maximum of the probability. Its position is refined by a parabola through
//! the logarithms, its score is probability times reliability, and its descriptor is interpolated
//! between cells.

use nalgebra::Vector2;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayViewD, Ix3};
use serde::Deserialize;

use seese3_core::keypoints::{Keypoints, MAX_KEYPOINTS};
use seese3_core::nalgebra;

/// Side of a cell, pixels.
const CELL: usize = 8;
/// Minimum probability of a keypoint.
const MIN_PROBABILITY: f32 = 0.02;
/// A keypoint is the maximum of the pixels up to this far away, along each axis.
const REACH: usize = 2;
/// Added to probabilities before their logarithm.
const FLOOR: f32 = 1e-4;

/// The outputs of a model from which keypoints are detected, by name.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeypointOutputs {
    /// Probabilities of keypoints, (65, h, w), after the softmax.
    pub positions: String,
    /// Reliability of the descriptors, (1, h, w), after the sigmoid.
    pub reliability: String,
    /// Descriptors, (c, h, w).
    pub descriptors: String,
}

impl KeypointOutputs {
    /// The names of the three outputs.
    pub fn names(&self) -> [&String; 3] {
        [&self.positions, &self.reliability, &self.descriptors]
    }
}

/// The three outputs of the network for one image.
pub(super) struct KeypointMaps<'a> {
    positions: ArrayView3<'a, f32>,
    reliability: ArrayView3<'a, f32>,
    descriptors: ArrayView3<'a, f32>,
}

impl<'a> KeypointMaps<'a> {
    /// Checks the shapes of the outputs of one image.
    pub fn new(
        positions: ArrayViewD<'a, f32>,
        reliability: ArrayViewD<'a, f32>,
        descriptors: ArrayViewD<'a, f32>,
    ) -> Result<Self, String> {
        let shapes = [&positions, &reliability, &descriptors].map(|map| map.shape().to_vec());
        let wrong = || {
            format!(
                "the keypoint outputs have the shapes {shapes:?}; expected positions (65, h, w), reliability \
                 (1, h, w) and descriptors (c, h, w)"
            )
        };

        let map =
            |output: ArrayViewD<'a, f32>| output.into_dimensionality::<Ix3>().map_err(|_| wrong());
        let maps = Self {
            positions: map(positions)?,
            reliability: map(reliability)?,
            descriptors: map(descriptors)?,
        };

        let (channels, rows, columns) = maps.positions.dim();
        let is_right = channels == CELL * CELL + 1
            && maps.reliability.dim() == (1, rows, columns)
            && maps.descriptors.dim().0 > 0
            && maps.descriptors.dim().1 == rows
            && maps.descriptors.dim().2 == columns
            && rows.min(columns) >= 2;
        if is_right { Ok(maps) } else { Err(wrong()) }
    }

    /// The keypoints with the highest scores, at most [`MAX_KEYPOINTS`].
    pub fn detect(&self) -> Keypoints {
        let probabilities = self.probabilities();
        let reliability = self.reliability.index_axis(ndarray::Axis(0), 0);

        let mut found: Vec<(f32, usize, usize)> = local_maxima(probabilities.view())
            .into_iter()
            .map(|(x, y)| {
                let score = probabilities[(y, x)]
                    * CellWeights::at(x, y, reliability.dim()).mean(reliability);
                (score, x, y)
            })
            .collect();
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(MAX_KEYPOINTS);

        let (height, width) = probabilities.dim();
        let points: Vec<Vector2<f32>> = found
            .iter()
            .map(|&(_, x, y)| {
                let refined = refined(probabilities.view(), x, y);
                Vector2::new(refined.x / width as f32, refined.y / height as f32)
            })
            .collect();

        let unit = self.unit_descriptors();
        let channels = self.descriptors.dim().0;
        let mut descriptors = Array2::zeros((found.len(), channels));
        for (mut row, &(_, x, y)) in descriptors.outer_iter_mut().zip(&found) {
            let weights = CellWeights::at(x, y, reliability.dim());
            for (cell, weight) in weights.cells() {
                row.scaled_add(weight, &unit.slice(ndarray::s![cell.0, cell.1, ..]));
            }
            let length = row.dot(&row).sqrt();
            row /= length.max(1e-9);
        }

        let scores: Vec<f32> = found.iter().map(|&(score, ..)| score).collect();
        Keypoints::new(&points, &scores, descriptors.view())
    }

    /// The probability of a keypoint at each pixel, shape (8h, 8w).
    fn probabilities(&self) -> Array2<f32> {
        let (_, rows, columns) = self.positions.dim();
        let mut probabilities = Array2::zeros((rows * CELL, columns * CELL));
        for (pixel, of_cells) in self.positions.outer_iter().take(CELL * CELL).enumerate() {
            let (y, x) = (pixel / CELL, pixel % CELL);
            let mut to = probabilities.slice_mut(ndarray::s![y..;CELL, x..;CELL]);
            to.assign(&of_cells);
        }
        probabilities
    }

    /// The descriptors of the cells with unit length, shape (h, w, c).
    fn unit_descriptors(&self) -> Array3<f32> {
        let (channels, rows, columns) = self.descriptors.dim();
        let mut unit = Array3::zeros((rows, columns, channels));
        unit.assign(&self.descriptors.view().permuted_axes([1, 2, 0]));
        for mut cell in unit.rows_mut() {
            let length = cell.dot(&cell).sqrt();
            cell /= length.max(1e-9);
        }

        unit
    }
}

/// The pixels (x, y) that are maxima of their neighborhood and probable enough. Pixels near the
/// border are left out: a maximum there may lie outside the image.
fn local_maxima(probabilities: ArrayView2<'_, f32>) -> Vec<(usize, usize)> {
    let (height, width) = probabilities.dim();
    let mut maxima = Vec::new();

    for y in REACH..height - REACH {
        for x in REACH..width - REACH {
            let value = probabilities[(y, x)];
            if value <= MIN_PROBABILITY {
                continue;
            }

            let around =
                probabilities.slice(ndarray::s![y - REACH..=y + REACH, x - REACH..=x + REACH]);
            if around.iter().all(|&other| other <= value) {
                maxima.push((x, y));
            }
        }
    }

    maxima
}

/// The position of a maximum, pixels from the top left corner of the image, refined by a parabola
/// along each axis through the logarithms of the probabilities.
fn refined(probabilities: ArrayView2<'_, f32>, x: usize, y: usize) -> Vector2<f32> {
    let log = |x: usize, y: usize| (probabilities[(y, x)] + FLOOR).ln();
    let peak = |before: f32, at: f32, after: f32| {
        let curvature = before - 2.0 * at + after;
        if curvature.abs() > 1e-6 {
            (0.5 * (before - after) / curvature).clamp(-0.5, 0.5)
        } else {
            0.0
        }
    };

    let at = log(x, y);
    let dx = peak(log(x - 1, y), at, log(x + 1, y));
    let dy = peak(log(x, y - 1), at, log(x, y + 1));
    Vector2::new(x as f32 + 0.5 + dx, y as f32 + 0.5 + dy)
}

/// Bilinear weights of the four cells around a pixel.
struct CellWeights {
    row: usize,
    column: usize,
    down: f32,
    right: f32,
}

impl CellWeights {
    /// For the pixel (x, y), in a map of (rows, columns) cells.
    fn at(x: usize, y: usize, (rows, columns): (usize, usize)) -> Self {
        let along = |pixel: usize, cells: usize| {
            let position = (pixel as f32 + 0.5) / CELL as f32 - 0.5;
            let cell = (position.max(0.0) as usize).min(cells - 2);
            (cell, (position - cell as f32).clamp(0.0, 1.0))
        };
        let (row, down) = along(y, rows);
        let (column, right) = along(x, columns);

        Self {
            row,
            column,
            down,
            right,
        }
    }

    /// The cells (row, column) with their weights.
    fn cells(&self) -> [((usize, usize), f32); 4] {
        let Self {
            row,
            column,
            down,
            right,
        } = *self;

        [
            ((row, column), (1.0 - down) * (1.0 - right)),
            ((row, column + 1), (1.0 - down) * right),
            ((row + 1, column), down * (1.0 - right)),
            ((row + 1, column + 1), down * right),
        ]
    }

    fn mean(&self, map: ArrayView2<'_, f32>) -> f32 {
        self.cells()
            .into_iter()
            .map(|(cell, weight)| map[cell] * weight)
            .sum()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use ndarray::ArrayD;
    use seese3_testing::{golden, json, near, npy, number};

    use super::*;

    fn outputs() -> [ArrayD<f32>; 3] {
        ["positions", "reliability", "descriptors"]
            .map(|name| npy(&golden().join(format!("keypoints/{name}.npy"))))
    }

    fn detected(outputs: &[ArrayD<f32>; 3]) -> Result<Keypoints, String> {
        let [positions, reliability, descriptors] = outputs.each_ref().map(|map| map.view());
        Ok(KeypointMaps::new(positions, reliability, descriptors)?.detect())
    }

    /// Oracle: the definition in NumPy and SciPy (`tests/golden/keypoints`). A descriptor has 8
    /// bits with steps of 1/254, and numbers beyond ±0.5 are clamped.
    #[test]
    fn keypoints_are_those_of_the_definition() {
        let found = detected(&outputs()).unwrap();
        let expected = json(&golden().join("keypoints/expected.json"));
        let rows = |name: &str| expected[name].as_array().unwrap();
        assert_eq!(found.len(), rows("scores").len());

        for (place, point) in found.points().iter().enumerate() {
            let expected = &rows("points")[place];
            near("x", f64::from(point.x) * 64.0, number(&expected[0]), 1e-3);
            near("y", f64::from(point.y) * 48.0, number(&expected[1]), 1e-3);

            let score = f64::from(found.scores()[place]);
            near("score", score, number(&rows("scores")[place]), 1e-6);

            let numbers = rows("descriptors")[place].as_array().unwrap();
            for (&value, expected) in found.descriptor(place).iter().zip(numbers) {
                let expected = number(expected).clamp(-0.5, 0.5);
                near(
                    "descriptor",
                    f64::from(value) / 254.0,
                    expected,
                    0.501 / 254.0,
                );
            }
        }
    }

    /// Oracle: the definition. A keypoint needs a probability above 0.02, so none is found where
    /// all pixels are less probable, where the probabilities are not numbers, or in too small a
    /// map.
    #[test]
    fn blank_and_broken_outputs_give_no_keypoints() {
        for value in [0.0, 1.0 / 65.0, f32::NAN] {
            let mut outputs = outputs();
            outputs[0].fill(value);
            assert!(detected(&outputs).unwrap().is_empty(), "{value}");
        }

        // One probable pixel is one keypoint at its center.
        let mut one = outputs();
        one[0].fill(1e-3);
        one[0][[8 * 3 + 5, 2, 4]] = 0.5;
        let found = detected(&one).unwrap();
        assert_eq!(found.len(), 1);
        near("x", f64::from(found.points()[0].x), 37.5 / 64.0, 1e-6);
        near("y", f64::from(found.points()[0].y), 19.5 / 48.0, 1e-6);

        // Descriptors of length 0 stay finite.
        one[2].fill(0.0);
        assert!(
            detected(&one)
                .unwrap()
                .descriptor(0)
                .iter()
                .all(|&x| x == 0)
        );
    }

    /// Oracle: the shapes that the module states.
    #[test]
    fn outputs_of_other_shapes_are_refused() {
        let wrong = |change: &dyn Fn(&mut [ArrayD<f32>; 3])| {
            let mut outputs = outputs();
            change(&mut outputs);
            let message = detected(&outputs).unwrap_err();
            assert!(
                message.contains("expected positions (65, h, w)"),
                "{message}"
            );
        };
        wrong(&|[positions, ..]| *positions = ArrayD::zeros(vec![64, 6, 8]));
        wrong(&|[positions, ..]| *positions = ArrayD::zeros(vec![65, 6, 7]));
        wrong(&|[positions, ..]| *positions = ArrayD::zeros(vec![65, 48]));
        wrong(&|[_, reliability, _]| *reliability = ArrayD::zeros(vec![2, 6, 8]));
        wrong(&|[.., descriptors]| *descriptors = ArrayD::zeros(vec![0, 6, 8]));
        wrong(&|[.., descriptors]| *descriptors = ArrayD::zeros(vec![8, 8, 6]));
        wrong(&|outputs| {
            *outputs = [65, 1, 8].map(|channels| ArrayD::zeros(vec![channels, 1, 1]));
        });
    }
}

//! Inputs of the relational network: the similarities of all cells of two images, and where each
//! cell of one image finds its match in the other.

use ndarray::{ArrayView2, Axis, s};

use super::cells::CellLayout;
use crate::features::Grid;

/// Inverse temperatures of the softmax over similarities. The low one averages over many cells, the
/// high one selects the most similar ones.
pub const INVERSE_TEMPERATURES: [f32; 2] = [8.0, 30.0];

/// Numbers per cell, direction and temperature: displacement across and down, and variance.
const PER_TEMPERATURE: usize = 3;

/// Layout of the inputs of one pair of images.
///
/// For each part: all similarities, cells of the first image by cells of the second; then the
/// matches of the first image's cells in the second image, and those of the second's in the first.
/// The matches of a cell are the largest similarity and, for each temperature, the mean
/// displacement across and down and its variance under the softmax of the similarities. The image
/// spans −1 to 1 across and down.
#[derive(Debug, Clone, PartialEq)]
pub struct InputLayout {
    parts: Vec<PartLayout>,
}

#[derive(Debug, Clone, PartialEq)]
struct PartLayout {
    grid: Grid,
    /// Center of each cell, across and down.
    centers: Vec<[f32; 2]>,
}

impl InputLayout {
    /// The layout for cells of a feature.
    pub fn of(cells: &CellLayout) -> Self {
        let parts = cells.grids().iter().map(|&grid| PartLayout {
            grid,
            centers: centers(grid),
        });

        Self {
            parts: parts.collect(),
        }
    }

    /// Number of inputs.
    pub fn width(&self) -> usize {
        self.parts.iter().map(PartLayout::width).sum()
    }

    /// Writes the inputs of one pair to `out`, which has [`InputLayout::width`] numbers.
    /// `similarities` has one array (cells, cells) per part.
    pub fn write<'a>(
        &self,
        similarities: impl IntoIterator<Item = ArrayView2<'a, f32>>,
        out: &mut [f32],
    ) {
        let mut rest = out;
        for (part, similarities) in self.parts.iter().zip(similarities) {
            let (own, after) = rest.split_at_mut(part.width());
            part.write(similarities, own);
            rest = after;
        }
    }

    /// Writes the inputs of a pair in reverse order, second image first, from those in order.
    pub fn write_reversed(&self, inputs: &[f32], out: &mut [f32]) {
        let mut first = 0;
        for part in &self.parts {
            let range = first..first + part.width();
            part.write_reversed(&inputs[range.clone()], &mut out[range]);
            first += part.width();
        }
    }
}

impl PartLayout {
    fn write_reversed(&self, inputs: &[f32], out: &mut [f32]) {
        let cells = self.grid.cells();
        let (raw, matches) = inputs.split_at(cells * cells);
        let (raw_out, matches_out) = out.split_at_mut(cells * cells);
        for (a, row) in raw.chunks_exact(cells).enumerate() {
            for (b, &value) in row.iter().enumerate() {
                raw_out[b * cells + a] = value;
            }
        }

        let (there, back) = matches.split_at(self.matches());
        matches_out[..back.len()].copy_from_slice(back);
        matches_out[back.len()..].copy_from_slice(there);
    }

    /// Numbers of the matches in one direction.
    fn matches(&self) -> usize {
        self.grid.cells() * (1 + PER_TEMPERATURE * INVERSE_TEMPERATURES.len())
    }

    fn width(&self) -> usize {
        self.grid.cells() * self.grid.cells() + 2 * self.matches()
    }

    fn write(&self, similarities: ArrayView2<'_, f32>, out: &mut [f32]) {
        let cells = self.grid.cells();
        let (raw, matches) = out.split_at_mut(cells * cells);
        raw.iter_mut()
            .zip(similarities)
            .for_each(|(out, &value)| *out = value);

        let (there, back) = matches.split_at_mut(self.matches());
        self.write_matches(similarities, there);
        self.write_matches(similarities.reversed_axes(), back);
    }

    fn write_matches(&self, similarities: ArrayView2<'_, f32>, out: &mut [f32]) {
        let per_cell = self.matches() / self.grid.cells();
        let cells = similarities
            .outer_iter()
            .zip(out.chunks_exact_mut(per_cell));
        for (cell, (row, of_cell)) in cells.enumerate() {
            let largest = row.fold(f32::NEG_INFINITY, |a, &b| a.max(b));
            of_cell[0] = largest;

            let [own_x, own_y] = self.centers[cell];
            let moments = of_cell[1..].chunks_exact_mut(PER_TEMPERATURE);
            for (moments, inverse_temperature) in moments.zip(INVERSE_TEMPERATURES) {
                let [mut weight, mut x, mut y, mut square] = [0.0f32; 4];
                for (&similarity, &[cx, cy]) in row.iter().zip(&self.centers) {
                    let w = (inverse_temperature * (similarity - largest)).exp();
                    weight += w;
                    x += w * cx;
                    y += w * cy;
                    square += w * (cx * cx + cy * cy);
                }

                let (x, y) = (x / weight, y / weight);
                moments[0] = x - own_x;
                moments[1] = y - own_y;
                moments[2] = square / weight - x * x - y * y;
            }
        }
    }
}

/// Centers of a grid's cells, row by row; the first and last are at −1 and 1.
fn centers(grid: Grid) -> Vec<[f32; 2]> {
    let along = |place: usize, count: usize| match count {
        1 => 0.0,
        _ => 2.0 * place as f32 / (count - 1) as f32 - 1.0,
    };

    (0..grid.cells())
        .map(|cell| {
            [
                along(cell % grid.columns, grid.columns),
                along(cell / grid.columns, grid.rows),
            ]
        })
        .collect()
}

/// Mirrors similarities (cells, cells) of a grid left to right, in both images.
pub fn mirrored(similarities: &mut ndarray::Array2<f32>, grid: Grid) {
    let other = |cell: usize| {
        let (row, column) = (cell / grid.columns, cell % grid.columns);
        row * grid.columns + grid.columns - 1 - column
    };
    let order: Vec<usize> = (0..grid.cells()).map(other).collect();
    *similarities = similarities.select(Axis(0), &order).select(Axis(1), &order);
}

/// The similarities of image `image` in every part of `all`, arrays (n, cells, cells).
pub fn of_image(
    all: &[ndarray::Array3<f32>],
    image: usize,
) -> impl Iterator<Item = ArrayView2<'_, f32>> {
    all.iter().map(move |part| part.slice(s![image, .., ..]))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;
    use crate::features::FeatureSource;

    fn layout(pooling: &str, dim: usize) -> InputLayout {
        let source = FeatureSource {
            pooling: pooling.to_owned(),
            ..FeatureSource::imported("f", dim)
        };
        InputLayout::of(&CellLayout::of(&source).unwrap())
    }

    /// Oracle: by hand. Every cell of the first image is most similar to its right neighbor in the
    /// second one, by so much that the softmax selects it: on three columns the displacement is one
    /// of two steps across the image, which is 1, and back it is −1.
    #[test]
    fn a_shift_by_one_cell_is_a_displacement() {
        let layout = layout("grid3x2", 6);
        let mut similarities = Array2::from_elem((6, 6), -1.0f32);
        for row in 0..2 {
            for column in 0..2 {
                similarities[(row * 3 + column, row * 3 + column + 1)] = 1.0;
            }
        }
        let mut inputs = vec![0.0; layout.width()];
        layout.write([similarities.view()], &mut inputs);

        assert_eq!(layout.width(), 36 + 2 * 6 * 7);
        assert_eq!(inputs[1], 1.0);
        for row in 0..2 {
            for column in 0..2 {
                // The match of the first image's cell, at the high inverse temperature.
                let there = &inputs[36 + (row * 3 + column) * 7..][..7];
                let back = &inputs[36 + 42 + (row * 3 + column + 1) * 7..][..7];
                for (cell, expected) in [(there, 1.0), (back, -1.0)] {
                    assert_eq!(cell[0], 1.0);
                    assert!((cell[4] - expected).abs() < 1e-6, "{cell:?}");
                    assert!(cell[5].abs() < 1e-6 && cell[6].abs() < 1e-6, "{cell:?}");
                }
            }
        }
    }

    /// Oracle: the definition in f64, for random similarities.
    #[test]
    fn matches_are_moments_of_a_softmax() {
        let layout = layout("grid3x2", 6);
        let similarities = Array2::from_shape_fn((6, 6), |(a, b)| ((a * 7 + b * 3) as f32).sin());
        let mut inputs = vec![0.0; layout.width()];
        layout.write([similarities.view()], &mut inputs);

        let x = |cell: usize| (cell % 3) as f64 - 1.0;
        let y = |cell: usize| 2.0 * (cell / 3) as f64 - 1.0;
        for cell in 0..6 {
            for (temperature, sharpness) in [(0, 8.0), (1, 30.0)] {
                let weight = |b: usize| (sharpness * f64::from(similarities[(cell, b)])).exp();
                let total: f64 = (0..6).map(weight).sum();
                let mean = |f: &dyn Fn(usize) -> f64| {
                    (0..6).map(|b| weight(b) * f(b)).sum::<f64>() / total
                };
                let (mx, my) = (mean(&x), mean(&y));
                let variance = mean(&|b| (x(b) - mx).powi(2) + (y(b) - my).powi(2));

                let found = &inputs[36 + cell * 7 + 1 + 3 * temperature..][..3];
                for (found, expected) in found.iter().zip([mx - x(cell), my - y(cell), variance]) {
                    assert!((f64::from(*found) - expected).abs() < 1e-5);
                }
            }
        }
    }

    /// Oracle: the definition: the inputs of the transposed similarities.
    #[test]
    fn reversed_inputs_are_those_of_the_transposed_similarities() {
        let parts = [("grid3x2", 6), ("grid2x2", 8)].map(|(pooling, dim)| FeatureSource {
            pooling: pooling.to_owned(),
            ..FeatureSource::imported("f", dim)
        });
        let source = FeatureSource::joined(&parts).unwrap();
        let layout = InputLayout::of(&CellLayout::of(&source).unwrap());
        let similarities = [6, 4].map(|cells| {
            Array2::from_shape_fn((cells, cells), |(a, b)| ((a * 7 + b * 3) as f32).sin())
        });

        let [mut inputs, mut reversed, mut expected] = [(); 3].map(|()| vec![0.0; layout.width()]);
        layout.write(similarities.iter().map(|part| part.view()), &mut inputs);
        layout.write(similarities.iter().map(|part| part.t()), &mut expected);
        layout.write_reversed(&inputs, &mut reversed);

        assert_eq!(reversed, expected);
    }

    /// Oracle: by hand. On three columns and one row, cell 0 becomes cell 2.
    #[test]
    fn mirrored_similarities_exchange_left_and_right() {
        let grid = Grid {
            rows: 1,
            columns: 3,
            channels: 1,
        };
        let mut similarities = Array2::from_shape_fn((3, 3), |(a, b)| (10 * a + b) as f32);
        mirrored(&mut similarities, grid);
        let expected = Array2::from_shape_fn((3, 3), |(a, b)| (10 * (2 - a) + 2 - b) as f32);
        assert_eq!(similarities, expected);
    }
}

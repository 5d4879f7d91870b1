//! Cells of feature maps, and their similarities between two images.

use ndarray::{Array2, Array3, ArrayView1, ArrayView2, ArrayViewMut2, Axis, s};

use super::super::Error;
use crate::features::{FeatureSource, Grid};

/// Added to the length of a cell, so that an image without contrast has finite cells.
const LEAST_LENGTH: f32 = 1e-6;

/// The grids of the parts of a feature.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CellLayout {
    grids: Vec<Grid>,
}

impl CellLayout {
    /// The layout of features of a source.
    ///
    /// # Errors
    /// [`Error::NotAGrid`] if the source, or a part of it, is not pooled to a grid of at least four
    /// cells.
    pub fn of(source: &FeatureSource) -> Result<Self, Error> {
        let grid = |part: &FeatureSource| {
            let grid = part.grid().filter(|grid| grid.cells() >= 4);
            grid.ok_or_else(|| Error::NotAGrid {
                name: part.name.clone(),
                pooling: part.pooling.clone(),
            })
        };

        let grids = source.parts().iter().map(grid).collect::<Result<_, _>>()?;
        Ok(Self { grids })
    }

    /// The grids, one per part.
    pub fn grids(&self) -> &[Grid] {
        &self.grids
    }

    /// Columns of a feature.
    pub fn feature_dim(&self) -> usize {
        let columns = self.grids.iter().map(|grid| grid.cells() * grid.channels);
        columns.sum()
    }
}

/// Normalized cells of a number of images: the deviation of each cell from the mean of its image,
/// scaled to unit length.
#[derive(Debug, Clone)]
pub struct Cells {
    /// One array per part, shape (n, cells, channels).
    parts: Vec<Array3<f32>>,
}

impl Cells {
    /// The cells of feature rows, shape (n, [`CellLayout::feature_dim`]).
    ///
    /// # Errors
    /// [`Error::FeatureDim`] if the width is another.
    pub fn of(layout: &CellLayout, rows: ArrayView2<'_, f32>) -> Result<Self, Error> {
        Self::stacked(layout, &[rows])
    }

    /// The cells of several blocks of feature rows, one after the other.
    ///
    /// # Errors
    /// As [`Cells::of`].
    pub fn stacked(layout: &CellLayout, blocks: &[ArrayView2<'_, f32>]) -> Result<Self, Error> {
        let expected = layout.feature_dim();
        if let Some(block) = blocks.iter().find(|block| block.ncols() != expected) {
            return Err(Error::FeatureDim {
                expected,
                actual: block.ncols(),
            });
        }

        let count = blocks.iter().map(ArrayView2::nrows).sum();
        let mut first = 0;
        let mut parts = Vec::with_capacity(layout.grids.len());
        for &grid in &layout.grids {
            let width = grid.cells() * grid.channels;
            let mut part = Array3::zeros((count, grid.cells(), grid.channels));
            let rows = blocks.iter().flat_map(|block| block.outer_iter());
            for (row, image) in rows.zip(part.outer_iter_mut()) {
                normalize(row.slice(s![first..first + width]), grid, image);
            }

            parts.push(part);
            first += width;
        }

        Ok(Self { parts })
    }

    /// Number of images.
    pub fn count(&self) -> usize {
        self.parts.first().map_or(0, |part| part.len_of(Axis(0)))
    }

    /// Cells of the given images, in the given order.
    #[must_use]
    pub fn select(&self, images: &[usize]) -> Self {
        Self {
            parts: self
                .parts
                .iter()
                .map(|part| part.select(Axis(0), images))
                .collect(),
        }
    }

    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        let numbers: usize = self.parts.iter().map(Array3::len).sum();
        numbers * size_of::<f32>()
    }

    /// Cosine similarities of the cells of image `image` with those of all images of `others`: one
    /// array per part, shape (n, cells, cells). The first cell index is that of `image`.
    pub fn similarities(&self, image: usize, others: &Self) -> Vec<Array3<f32>> {
        let parts = self.parts.iter().zip(&others.parts);
        parts
            .map(|(own, others)| {
                let own = own.index_axis(Axis(0), image);
                let (count, cells, channels) = others.dim();

                // One product for all images: (cells, channels) × (channels, n · cells).
                let flat = ArrayView2::from_shape((count * cells, channels), slice(others));
                let products = flat.map(|flat| own.dot(&flat.t())).unwrap_or_default();
                Array3::from_shape_fn((count, cells, cells), |(n, a, b)| {
                    products[(a, n * cells + b)]
                })
            })
            .collect()
    }

    /// [`Cells::similarities`] of two images: one array per part, shape (cells, cells).
    pub fn pair(&self, first: usize, second: usize) -> Vec<Array2<f32>> {
        let of = |part: &Array3<f32>| {
            let second = part.index_axis(Axis(0), second);
            part.index_axis(Axis(0), first).dot(&second.t())
        };
        self.parts.iter().map(of).collect()
    }
}

/// The numbers of an array in row order; arrays of [`Cells`] are always contiguous.
fn slice(array: &Array3<f32>) -> &[f32] {
    array.as_slice().unwrap_or(&[])
}

/// Writes the normalized cells of one image to `cells`, shape (cells, channels). The feature is
/// flattened in the order (channels, rows, columns).
fn normalize(feature: ArrayView1<'_, f32>, grid: Grid, mut cells: ArrayViewMut2<'_, f32>) {
    let count = grid.cells();
    for (channel, map) in feature.exact_chunks(count).into_iter().enumerate() {
        let mean = map.sum() / count as f32;
        for (cell, value) in map.iter().enumerate() {
            cells[(cell, channel)] = value - mean;
        }
    }

    for mut cell in cells.outer_iter_mut() {
        let length = cell.fold(0.0f32, |sum, x| sum + x * x).sqrt();
        cell /= length + LEAST_LENGTH;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(name: &str, pooling: &str, dim: usize) -> FeatureSource {
        FeatureSource {
            encoder: "e".to_owned(),
            pooling: pooling.to_owned(),
            ..FeatureSource::imported(name, dim)
        }
    }

    /// Oracle: the definition, cell by cell: cosine of the angle between two cells after the mean
    /// of each image is subtracted.
    #[test]
    fn similarities_are_cosines_of_cells() {
        let parts = [source("a", "grid2x2", 12), source("b", "grid3x2", 12)];
        let layout = CellLayout::of(&FeatureSource::joined(&parts).unwrap()).unwrap();
        let rows = Array2::from_shape_fn((4, 24), |(row, column)| {
            ((row * 24 + column) as f32 * 0.7).sin()
        });
        let cells = Cells::of(&layout, rows.view()).unwrap();

        let all = cells.similarities(1, &cells);
        for (part, (first, count, channels)) in [(0, 4, 3), (12, 6, 2)].into_iter().enumerate() {
            let cell = |image: usize, cell: usize| -> Vec<f64> {
                let number = |channel: usize, cell: usize| {
                    f64::from(rows[(image, first + channel * count + cell)])
                };
                (0..channels)
                    .map(|channel| {
                        let sum: f64 = (0..count).map(|cell| number(channel, cell)).sum();
                        number(channel, cell) - sum / count as f64
                    })
                    .collect()
            };
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();

            for (image, a, b) in [(0, 0, 1), (3, 2, 2), (2, count - 1, 0)] {
                let (from, to) = (cell(1, a), cell(image, b));
                let expected = dot(&from, &to) / (dot(&from, &from) * dot(&to, &to)).sqrt();
                assert!((f64::from(all[part][(image, a, b)]) - expected).abs() < 1e-4);
                let alone = cells.pair(1, image)[part][(a, b)];
                assert!((alone - all[part][(image, a, b)]).abs() < 1e-6);
            }
        }
    }

    /// Oracle: the contract. Means and small grids have no cells to compare.
    #[test]
    fn features_without_cells_are_refused() {
        for (pooling, dim) in [("mean", 12), ("grid2x1", 12), ("grid5x5", 12)] {
            let error = CellLayout::of(&source("f", pooling, dim)).unwrap_err();
            assert!(error.to_string().contains("'f'"), "{error}");
        }
    }
}

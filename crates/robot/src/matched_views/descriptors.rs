//! Compressed descriptors of keypoints, and their matches.

use nalgebra::DMatrix;
use ndarray::{Array1, Array2, ArrayView2, Axis};

use seese3_core::keypoints::Keypoints;

/// Number of components of a compressed descriptor; one byte each.
pub const COMPRESSED: usize = 32;

/// Maximum number of components of a descriptor before compression.
pub const MAX_WIDTH: usize = 1024;

/// Factor between a compressed descriptor of unit length and its 8-bit numbers.
const SCALE: f32 = 200.0;
/// Number of descriptors from which the principal components are computed.
const SAMPLE: usize = 20_000;

/// Mean and principal axes of the descriptors of a map. Compression subtracts the mean, projects
/// onto the axes and scales to unit length.
#[derive(Debug, Clone, PartialEq)]
pub struct DescriptorBasis {
    /// Shape (d).
    mean: Array1<f32>,
    /// Shape (d, [`COMPRESSED`]), orthonormal columns.
    axes: Array2<f32>,
}

impl DescriptorBasis {
    /// Principal components of the descriptors of all frames; `None` without any descriptor.
    pub fn of<'a>(frames: impl Iterator<Item = &'a Keypoints> + Clone) -> Option<Self> {
        let count: usize = frames.clone().map(Keypoints::len).sum();
        let width = frames
            .clone()
            .map(Keypoints::descriptor_width)
            .max()
            .filter(|&width| width > 0)?;

        // Evenly spaced descriptors are enough for the components.
        let every = count.div_ceil(SAMPLE).max(1);
        let sample: Vec<f32> = frames
            .flat_map(|frame| (0..frame.len()).map(move |place| frame.descriptor(place)))
            .step_by(every)
            .flat_map(|descriptor| descriptor.iter().map(|&value| f32::from(value)))
            .collect();
        let sample = Array2::from_shape_vec((sample.len() / width, width), sample).ok()?;

        let mean = sample.mean_axis(Axis(0))?;
        let centered = sample - &mean;
        let moment = centered.t().dot(&centered);
        let moment = DMatrix::from_fn(width, width, |row, column| f64::from(moment[(row, column)]));

        let eigen = moment.symmetric_eigen();
        let mut order: Vec<usize> = (0..width).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let axes = Array2::from_shape_fn((width, COMPRESSED), |(row, column)| {
            let axis = order.get(column);
            axis.map_or(0.0, |&axis| eigen.eigenvectors[(row, axis)] as f32)
        });

        Some(Self { mean, axes })
    }

    /// A basis from its numbers: `mean` of shape (d), `axes` of shape (d, [`COMPRESSED`]); `None`
    /// for other shapes, more than [`MAX_WIDTH`] numbers or numbers that are not finite.
    pub fn from_parts(mean: Array1<f32>, axes: Array2<f32>) -> Option<Self> {
        let is_finite = mean.iter().chain(&axes).all(|value| value.is_finite());
        let is_of_shape = axes.dim() == (mean.len(), COMPRESSED);
        (is_of_shape && (1..=MAX_WIDTH).contains(&mean.len()) && is_finite)
            .then_some(Self { mean, axes })
    }

    /// Mean, shape (d).
    pub fn mean(&self) -> &Array1<f32> {
        &self.mean
    }

    /// Principal axes, shape (d, [`COMPRESSED`]).
    pub fn axes(&self) -> &Array2<f32> {
        &self.axes
    }

    /// Number of components of the descriptors before compression.
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// Compressed descriptors, row by row, [`COMPRESSED`] bytes each.
    pub fn compress(&self, keypoints: &Keypoints) -> Vec<i8> {
        let mut full = Array2::zeros((keypoints.len(), self.width()));
        for (place, mut row) in full.outer_iter_mut().enumerate() {
            let numbers = keypoints.descriptor(place).iter();
            for (to, &from) in row.iter_mut().zip(numbers) {
                *to = f32::from(from);
            }
        }

        packed(&(full - &self.mean).dot(&self.axes))
    }

    /// Descriptors that another basis compressed, compressed by this one. Neglects the difference
    /// of the means: both bases are of one encoder.
    ///
    /// # Panics
    /// If the bases have different widths.
    pub fn compress_again(&self, compressed: &[i8], former: &Self) -> Vec<i8> {
        let change = former.axes.t().dot(&self.axes);
        packed(&unpacked(compressed).dot(&change))
    }
}

/// The rows of a matrix, scaled to unit length, as compressed descriptors.
fn packed(rows: &Array2<f32>) -> Vec<i8> {
    let mut compressed = Vec::with_capacity(rows.len());
    for row in rows.outer_iter() {
        let length = row.dot(&row).sqrt().max(1e-9);
        compressed.extend(
            row.iter()
                .map(|value| (value / length * SCALE).round().clamp(-127.0, 127.0) as i8),
        );
    }

    compressed
}

/// Compressed descriptors as numbers, shape (n, [`COMPRESSED`]); cosines are their dot products.
pub(super) fn unpacked(compressed: &[i8]) -> Array2<f32> {
    let rows = compressed.chunks_exact(COMPRESSED);
    let mut unpacked = Array2::zeros((rows.len(), COMPRESSED));
    for (mut to, from) in unpacked.outer_iter_mut().zip(rows) {
        for (to, &from) in to.iter_mut().zip(from) {
            *to = f32::from(from) / SCALE;
        }
    }
    unpacked
}

/// Pairs (row of `a`, row of `b`) that are each other's most similar row and whose cosine is at
/// least `min_cosine`.
pub(super) fn mutual_matches(
    a: ArrayView2<'_, f32>,
    b: ArrayView2<'_, f32>,
    min_cosine: f32,
) -> Vec<(usize, usize)> {
    let similarity = a.dot(&b.t());
    // For each row of `b`, its most similar row of `a`. Without branches, the compiler vectorizes
    // this.
    let mut cosines = vec![f32::NEG_INFINITY; b.nrows()];
    let mut best_in_a = vec![0_u32; b.nrows()];
    for (row, similar) in similarity.outer_iter().enumerate() {
        let best = cosines.iter_mut().zip(&mut best_in_a);
        for ((cosine, best), &value) in best.zip(similar) {
            let is_better = value > *cosine;
            *best = if is_better { row as u32 } else { *best };
            *cosine = if is_better { value } else { *cosine };
        }
    }

    let mutual = similarity.outer_iter().enumerate();
    mutual
        .filter_map(|(row, similar)| {
            let greatest = similar.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let column = similar.iter().position(|&value| value == greatest)?;
            let is_mutual = greatest >= min_cosine && best_in_a[column] as usize == row;
            is_mutual.then_some((row, column))
        })
        .collect()
}

/// Pairs of keypoints of two views, by their places, that are each other's most similar one and
/// whose cosine is at least `min_cosine`, among the first `candidates` of each; empty if the
/// descriptors have different widths.
pub(crate) fn matched_keypoints(
    first: &Keypoints,
    second: &Keypoints,
    candidates: usize,
    min_cosine: f32,
) -> Vec<(usize, usize)> {
    let unit = |keypoints: &Keypoints| {
        let count = keypoints.len().min(candidates);
        let mut rows = Array2::zeros((count, keypoints.descriptor_width()));
        for (place, mut row) in rows.outer_iter_mut().enumerate() {
            for (to, &from) in row.iter_mut().zip(keypoints.descriptor(place)) {
                *to = f32::from(from);
            }
            let length = row.dot(&row).sqrt().max(1e-9);
            row /= length;
        }
        rows
    };

    let [a, b] = [unit(first), unit(second)];
    if a.ncols() != b.ncols() {
        return Vec::new();
    }
    mutual_matches(a.view(), b.view(), min_cosine)
}

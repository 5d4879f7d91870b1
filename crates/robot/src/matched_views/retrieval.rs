//! Retrieval of the mapped frames most similar to a view, by aggregated keypoint descriptors.
//!
//! Each descriptor is assigned to its nearest of some centers, and the residuals are summed per
//! center (VLAD). Source: R. Arandjelović and A. Zisserman, "All about VLAD", CVPR 2013.

use ndarray::{Array2, ArrayView2, Axis, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::descriptors::{COMPRESSED, unpacked};
use super::keypoint_map::{KeypointMap, MappedKeypoints};

/// Number of centers.
const CENTERS: usize = 64;
/// Number of descriptors from which the centers are computed, and steps of k-means.
const SAMPLE: usize = 10_000;
const STEPS: usize = 8;
/// Seed of the first centers.
const SEED: u64 = 1;

/// The aggregated descriptors of mapped frames.
#[derive(Debug, Clone)]
pub struct PlaceIndex {
    /// Shape (centers, [`COMPRESSED`]).
    centers: Array2<f32>,
    /// One row of unit length per frame.
    rows: Array2<f32>,
}

impl PlaceIndex {
    /// Aggregates the descriptors of all frames of a map, on the threads of the calling rayon pool.
    pub fn of(map: &KeypointMap) -> Self {
        let centers = centers(&map.frames);
        let width = centers.len();
        let aggregated: Vec<Vec<f32>> = map
            .frames
            .par_iter()
            .map(|frame| aggregated(unpacked(&frame.descriptors).view(), centers.view()))
            .collect();
        let rows = Array2::from_shape_fn((aggregated.len(), width), |(row, column)| {
            aggregated[row][column]
        });

        Self { centers, rows }
    }

    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        (self.centers.len() + self.rows.len()) * size_of::<f32>()
    }

    /// Rows of the `count` frames most similar to a view with these compressed descriptors, the
    /// most similar first.
    pub fn nearest(&self, descriptors: ArrayView2<'_, f32>, count: usize) -> Vec<usize> {
        self.nearest_among(descriptors, count, &|_| true)
    }

    /// As [`PlaceIndex::nearest`], among the frames that `is_used` keeps.
    pub(super) fn nearest_among(
        &self,
        descriptors: ArrayView2<'_, f32>,
        count: usize,
        is_used: &dyn Fn(usize) -> bool,
    ) -> Vec<usize> {
        let view = aggregated(descriptors, self.centers.view());
        let similarity = self.rows.dot(&ndarray::aview1(&view));
        let mut order: Vec<usize> = (0..similarity.len()).filter(|&row| is_used(row)).collect();
        let by_similarity =
            |a: &usize, b: &usize| similarity[*b].total_cmp(&similarity[*a]).then(a.cmp(b));
        if count < order.len() {
            order.select_nth_unstable_by(count, by_similarity);
            order.truncate(count);
        }
        order.sort_by(by_similarity);
        order
    }
}

/// Centers of the descriptors of a map: k-means from randomly chosen descriptors.
fn centers(frames: &[MappedKeypoints]) -> Array2<f32> {
    let count: usize = frames.iter().map(MappedKeypoints::len).sum();
    let every = count.div_ceil(SAMPLE).max(1);
    let sample: Vec<i8> = frames
        .iter()
        .flat_map(|frame| frame.descriptors.chunks(COMPRESSED))
        .step_by(every)
        .flatten()
        .copied()
        .collect();
    let sample = unpacked(&sample);
    if sample.nrows() == 0 {
        return Array2::zeros((1, COMPRESSED));
    }

    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let chosen: Vec<usize> = (0..CENTERS)
        .map(|_| rng.random_range(0..sample.nrows()))
        .collect();
    let mut centers = sample.select(Axis(0), &chosen);
    for _ in 0..STEPS {
        let nearest = assignments(sample.view(), centers.view());
        let mut sums = Array2::<f32>::zeros(centers.dim());
        let mut counts = vec![0.0_f32; centers.nrows()];
        for (row, &center) in sample.outer_iter().zip(&nearest) {
            sums.row_mut(center).scaled_add(1.0, &row);
            counts[center] += 1.0;
        }
        for (mut center, (sum, &count)) in
            centers.outer_iter_mut().zip(sums.outer_iter().zip(&counts))
        {
            if count > 0.0 {
                center.assign(&(&sum / count));
            }
        }
    }

    centers
}

/// The nearest center of each row.
fn assignments(rows: ArrayView2<'_, f32>, centers: ArrayView2<'_, f32>) -> Vec<usize> {
    // |x − c|² = |x|² − 2 x·c + |c|², and |x|² is the same for all centers.
    let products = rows.dot(&centers.t());
    let half_lengths: Vec<f32> = centers
        .outer_iter()
        .map(|center| 0.5 * center.dot(&center))
        .collect();
    products
        .outer_iter()
        .map(|row| {
            let mut best = (0, f32::NEG_INFINITY);
            for (center, (product, half)) in row.iter().zip(&half_lengths).enumerate() {
                if product - half > best.1 {
                    best = (center, product - half);
                }
            }
            best.0
        })
        .collect()
}

/// Aggregated descriptors: residuals summed per center, each sum of unit length, together of unit
/// length.
fn aggregated(descriptors: ArrayView2<'_, f32>, centers: ArrayView2<'_, f32>) -> Vec<f32> {
    let mut sums = Array2::<f32>::zeros(centers.dim());
    for (row, center) in descriptors
        .outer_iter()
        .zip(assignments(descriptors, centers))
    {
        let residual = &row - &centers.row(center);
        sums.slice_mut(s![center, ..]).scaled_add(1.0, &residual);
    }

    for mut sum in sums.rows_mut() {
        let length = sum.dot(&sum).sqrt();
        if length > 0.0 {
            sum /= length;
        }
    }
    let length = sums.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-12);
    sums.iter().map(|x| x / length).collect()
}

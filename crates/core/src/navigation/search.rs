//! Nearest-frame search for a latent, under one of five distances.

use nalgebra::{DMatrix, SymmetricEigen};
use ndarray::{Array2, ArrayView1, ArrayView2, Axis, s};
use strum::{Display, VariantArray};

use crate::adapter::{Adapter, Error};
use crate::index::{Audit, ExactIndex, Exclusion, Index, Neighbor};
#[cfg(feature = "hnsw")]
use crate::index::{HnswIndex, HnswParameters};
use crate::matrices::{to_nalgebra, to_ndarray};
use crate::room::FrameId;

/// Singular values below this fraction of the largest count as zero, as in W⁺.
const RANK_TOLERANCE: f64 = 1e-5;

/// Maximum number of coordinates for whitening, which takes cubic time.
const MOST_WHITENED: usize = 512;

/// Distance for the retrieval of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Display, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum RetrievalMetric {
    /// Euclidean distance over all coordinates, as in the paper.
    #[default]
    Full,
    /// Euclidean distance in the row space of W, chart by chart: ignores directions that W maps to
    /// zero motion.
    RowSpace,
    /// Mahalanobis distance under the covariance of the room's latents.
    Whitened,
    /// Euclidean distance of σ ⊙ W g: the length of the predicted motion between two latents,
    /// meters and radians mixed as in Hit@ε. Not available for charts with a gate.
    Motion,
    /// Mahalanobis distance of σ ⊙ W g under the adapter's error covariance, measured in rooms
    /// outside its training set. For use with the homogeneous reading, where the predicted motion
    /// from the source to ĝ is exactly ΔP. Ours, not the paper's. Not available for charts with a
    /// gate.
    Calibrated,
}

/// Kind of the nearest-neighbor index.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum IndexKind {
    /// Exact scan of all frames.
    #[default]
    Exact,
    /// Approximate search in an HNSW graph (`hnsw_rs`).
    #[cfg(feature = "hnsw")]
    Hnsw(HnswParameters),
}

impl IndexKind {
    /// The name of the kind: `exact` or `hnsw`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            #[cfg(feature = "hnsw")]
            Self::Hnsw(_) => "hnsw",
        }
    }

    /// Approximate number of frames that one query compares in a room of `frame_count` frames.
    pub fn comparisons(self, frame_count: usize) -> usize {
        match self {
            Self::Exact => frame_count,
            // The number grows with the logarithm of the frame count; a thousand are typical.
            #[cfg(feature = "hnsw")]
            Self::Hnsw(_) => frame_count.min(1_000),
        }
    }
}

/// A linear map of latents that turns the metric into Euclidean distance.
#[derive(Debug, Clone)]
struct Projection {
    coordinates: usize,
    /// Shape (p, coordinates); `None` stands for the identity.
    matrix: Option<Array2<f64>>,
}

impl Projection {
    fn new(
        metric: RetrievalMetric,
        adapter: &Adapter,
        latents: ArrayView2<'_, f64>,
    ) -> Result<Self, Error> {
        let coordinates = adapter.coordinate_count();
        let matrix = match metric {
            RetrievalMetric::Full => None,
            // A mixture has one block of coordinates per chart, so the bases form a block diagonal.
            RetrievalMetric::RowSpace => Some(blocks(
                &adapter
                    .motion_matrices()
                    .into_iter()
                    .map(row_basis)
                    .collect::<Vec<_>>(),
            )),
            RetrievalMetric::Motion => Some(adapter.motion_of_coordinates()?),
            RetrievalMetric::Calibrated => {
                let covariance = adapter.error_covariance().ok_or(Error::NoErrorCovariance)?;

                // With Σ = L Lᵀ, ‖L⁻¹x‖ is the Mahalanobis norm of x.
                let lower = covariance.cholesky().ok_or(Error::ErrorCovariance)?.l();
                let inverse = lower.try_inverse().ok_or(Error::ErrorCovariance)?;

                Some(
                    Array2::from_shape_fn((6, 6), |at| inverse[at])
                        .dot(&adapter.motion_of_coordinates()?),
                )
            }
            RetrievalMetric::Whitened if coordinates > MOST_WHITENED => {
                return Err(Error::WhitenedColumns {
                    actual: coordinates,
                    most: MOST_WHITENED,
                });
            }
            RetrievalMetric::Whitened => Some(whitening(latents.slice(s![.., ..coordinates]))),
        };

        Ok(Self {
            coordinates,
            matrix,
        })
    }

    fn rows(&self, latents: ArrayView2<'_, f64>) -> Array2<f64> {
        let coordinates = latents.slice(s![.., ..self.coordinates]);
        match &self.matrix {
            Some(matrix) => coordinates.dot(&matrix.t()),
            None => coordinates.to_owned(),
        }
    }

    fn one(&self, latent: ArrayView1<'_, f64>) -> Vec<f64> {
        let coordinates = latent.slice(s![..self.coordinates]);
        match &self.matrix {
            Some(matrix) => matrix.dot(&coordinates).to_vec(),
            None => coordinates.to_vec(),
        }
    }
}

/// An orthonormal basis of the rows of W, shape (6, k).
fn row_basis(w: ArrayView2<'_, f64>) -> Array2<f64> {
    // Thin SVD of the transpose, Wᵀ = U S Vᵀ: the columns of U span the row space of W.
    let svd = to_nalgebra(w.t()).svd(true, false);
    let basis = svd
        .u
        .unwrap_or_else(|| DMatrix::zeros(w.ncols(), w.nrows()));

    to_ndarray(&basis.transpose())
}

/// The block-diagonal matrix of `parts`.
fn blocks(parts: &[Array2<f64>]) -> Array2<f64> {
    let rows = parts.iter().map(Array2::nrows).sum();
    let columns = parts.iter().map(Array2::ncols).sum();
    let mut matrix = Array2::zeros((rows, columns));
    let mut row = 0;

    let mut column = 0;
    for part in parts {
        let bottom = row + part.nrows();
        let right = column + part.ncols();
        matrix
            .slice_mut(s![row..bottom, column..right])
            .assign(part);

        row = bottom;
        column = right;
    }

    matrix
}

/// The whitening matrix Λ^(−1/2) Qᵀ of the rows' population covariance Q Λ Qᵀ. Directions without
/// variance get weight zero.
fn whitening(rows: ArrayView2<'_, f64>) -> Array2<f64> {
    let count = rows.nrows().max(1) as f64;
    let centered = &rows - &(rows.sum_axis(Axis(0)) / count);
    let covariance = centered.t().dot(&centered) / count;
    let eigen = SymmetricEigen::new(to_nalgebra(covariance.view()));
    let largest = eigen.eigenvalues.iter().copied().fold(0.0, f64::max);

    // Eigenvalues of a covariance are squared singular values, so the tolerance is squared.
    let weight = |value: f64| match value > largest * RANK_TOLERANCE * RANK_TOLERANCE {
        true => value.sqrt().recip(),
        false => 0.0,
    };

    Array2::from_shape_fn((rows.ncols(), rows.ncols()), |(row, column)| {
        weight(eigen.eigenvalues[row]) * eigen.eigenvectors[(column, row)]
    })
}

/// Candidate frames, indexed under a metric.
pub struct Search {
    projection: Projection,
    kind: IndexKind,
    index: Box<dyn Index>,
    audit: Option<Audit>,
}

impl Search {
    /// Exact search among the frames `candidates`; `latents` has one row per frame of the room.
    ///
    /// # Errors
    /// [`Error::NoErrorCovariance`] or [`Error::ErrorCovariance`] when the metric needs an error
    /// covariance and the adapter has no valid one; [`Error::GatedMotion`] when it needs a fixed W
    /// and the adapter has a gate; [`Error::WhitenedColumns`] when there are too many coordinates
    /// to whiten.
    pub fn exact(
        metric: RetrievalMetric,
        adapter: &Adapter,
        latents: ArrayView2<'_, f64>,
        candidates: &[FrameId],
    ) -> Result<Self, Error> {
        let projection = Projection::new(metric, adapter, latents)?;
        let index = Box::new(ExactIndex::new(projection.rows(latents).view(), candidates));

        Ok(Self {
            projection,
            kind: IndexKind::Exact,
            index,
            audit: None,
        })
    }

    /// Search among all frames.
    ///
    /// # Errors
    /// As [`Search::exact`].
    pub fn new(
        kind: IndexKind,
        metric: RetrievalMetric,
        adapter: &Adapter,
        latents: ArrayView2<'_, f64>,
    ) -> Result<Self, Error> {
        let frames: Vec<FrameId> = (0..latents.nrows() as u32).map(FrameId).collect();
        match kind {
            IndexKind::Exact => Self::exact(metric, adapter, latents, &frames),
            #[cfg(feature = "hnsw")]
            IndexKind::Hnsw(parameters) => {
                let projection = Projection::new(metric, adapter, latents)?;
                let index = HnswIndex::new(projection.rows(latents).view(), &frames, parameters);

                // Measure the recall of this graph on at most 200 queries, for the reports.
                let audit = Some(index.audit(10, frames.len().div_ceil(200)));

                Ok(Self {
                    projection,
                    kind,
                    index: Box::new(index),
                    audit,
                })
            }
        }
    }

    /// The `k` frames nearest to a latent.
    pub fn nearest(
        &self,
        latent: ArrayView1<'_, f64>,
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> Vec<Neighbor> {
        self.index
            .nearest(&self.projection.one(latent), k, exclusion)
    }

    /// The `k` frames nearest to each of some latents, as [`Search::nearest`] finds them.
    pub fn nearest_of_each<'a>(
        &self,
        latents: impl IntoIterator<Item = ArrayView1<'a, f64>>,
        k: usize,
        exclusion: Option<Exclusion>,
    ) -> Vec<Vec<Neighbor>> {
        let projected = latents
            .into_iter()
            .map(|latent| self.projection.one(latent));
        let projected: Vec<Vec<f64>> = projected.collect();
        let queries: Vec<&[f64]> = projected.iter().map(Vec::as_slice).collect();
        self.index.nearest_of_each(&queries, k, exclusion)
    }

    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        self.index.memory_bytes()
    }

    /// The kind of the index.
    pub fn kind(&self) -> IndexKind {
        self.kind
    }

    /// Recall of an approximate index against the exact scan; `None` if the index is exact.
    pub fn audit(&self) -> Option<Audit> {
        self.audit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(rows: usize, columns: usize) -> Array2<f64> {
        Array2::from_shape_fn((rows, columns), |(i, j)| {
            (((i * columns + j) as f64).powi(2) * 0.37).sin()
        })
    }

    /// Oracle: the definition of the Mahalanobis distance, (a − b)ᵀ C⁻¹ (a − b), with nalgebra's
    /// general inverse.
    #[test]
    fn whitened_distances_are_mahalanobis() {
        let rows = wave(40, 5);
        let white = rows.dot(&whitening(rows.view()).t());
        let matrix = to_nalgebra(rows.view());
        let centered = DMatrix::from_fn(40, 5, |i, j| matrix[(i, j)] - matrix.column(j).mean());
        let inverse = (centered.transpose() * &centered / 40.0)
            .try_inverse()
            .unwrap();

        for (a, b) in [(0, 1), (3, 17), (39, 2)] {
            let difference = (matrix.row(a) - matrix.row(b)).transpose();
            let expected = (difference.transpose() * &inverse * &difference)[(0, 0)];
            let found = (&white.row(a) - &white.row(b)).mapv(|x| x * x).sum();

            assert!(
                (found - expected).abs() < 1e-9 * expected,
                "{found} {expected}"
            );
        }
    }

    /// Oracle: distances after the projection W⁺W equal distances in the basis.
    #[test]
    fn row_space_distances_are_those_of_the_projector() {
        let w = wave(6, 20);
        let rows = wave(3, 20);
        let matrix = to_nalgebra(w.view());
        let projector = matrix.clone().pseudo_inverse(1e-12).unwrap() * matrix;

        let basis = row_basis(w.view());
        let difference = &rows.row(0) - &rows.row(1);
        let expected = (projector * DMatrix::from_fn(20, 1, |i, _| difference[i])).norm();
        let found = basis.dot(&difference).mapv(|x| x * x).sum().sqrt();

        assert!((found - expected).abs() < 1e-12);
    }

    /// Oracle: by hand.
    #[test]
    fn blocks_stand_along_the_diagonal() {
        let ones = |rows, columns| Array2::from_elem((rows, columns), 1.0);
        let expected = ndarray::array![[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]];
        assert_eq!(blocks(&[ones(1, 2), ones(2, 1)]), expected);
    }
}

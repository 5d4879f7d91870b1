//! Retrieval of the frames nearest to a wanted latent, under one of five distances.

use nalgebra::{DMatrix, SymmetricEigen};
use ndarray::{Array2, ArrayView1, ArrayView2, Axis, s};

use crate::adapter::{Adapter, Error};
use crate::index::{Audit, ExactIndex, Exclusion, Index, Neighbour};
#[cfg(feature = "hnsw")]
use crate::index::{HnswIndex, HnswParameters};
use crate::matrices::{to_nalgebra, to_ndarray};
use crate::room::FrameId;

/// Singular values below this share of the largest count as zero, as in W⁺.
const RANK_TOLERANCE: f64 = 1e-5;

/// The most latent columns that can be whitened: the work grows with their cube.
const MOST_WHITENED: usize = 512;

/// The distance by which frames are retrieved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RetrievalMetric {
    /// Euclidean distance over all coordinates, as in the paper.
    #[default]
    Full,
    /// Euclidean distance in the row space of W, chart by chart: only the directions that W maps to
    /// motion count.
    RowSpace,
    /// Mahalanobis distance under the covariance of the room's latents.
    Whitened,
    /// Euclidean norm of σ ⊙ W g: the length of the motion that the adapter reads between two
    /// latents, in the metres and radians of Hit@ε. Not available for charts under a gate.
    Motion,
    /// Mahalanobis distance of σ ⊙ W g under the second moment of the adapter's errors in rooms
    /// that it was not trained on: the nearest candidate is the one for which the error of the
    /// wanted motion is least surprising. It belongs to the homogeneous reading, in which W reads
    /// exactly ΔP between the source and the imagined latent. Ours, not the paper's. Not available
    /// for charts under a gate.
    Calibrated,
}

impl RetrievalMetric {
    /// Every metric.
    pub const ALL: [Self; 5] = [
        Self::Full,
        Self::RowSpace,
        Self::Whitened,
        Self::Motion,
        Self::Calibrated,
    ];

    /// Its name in tables and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::RowSpace => "row-space",
            Self::Whitened => "whitened",
            Self::Motion => "motion",
            Self::Calibrated => "calibrated",
        }
    }

    /// The metric with this [`RetrievalMetric::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|metric| metric.name() == name)
    }
}

/// Which kind of index is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum IndexKind {
    /// An exact scan of every frame.
    #[default]
    Exact,
    /// The approximate graph of `hnsw_rs`.
    #[cfg(feature = "hnsw")]
    Hnsw(HnswParameters),
}

/// A linear map of latents after which the metric is the Euclidean distance.
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
            // A mixture's coordinates are one block per chart, so the charts' bases stand on a
            // block diagonal.
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

                // Σ = L Lᵀ, so ‖L⁻¹x‖ is the Mahalanobis norm of x.
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

/// The whitening matrix Λ^(−1/2) Qᵀ of the rows' population covariance Q Λ Qᵀ. Directions in which
/// the rows do not vary get weight zero.
fn whitening(rows: ArrayView2<'_, f64>) -> Array2<f64> {
    let count = rows.nrows().max(1) as f64;
    let centred = &rows - &(rows.sum_axis(Axis(0)) / count);
    let covariance = centred.t().dot(&centred) / count;
    let eigen = SymmetricEigen::new(to_nalgebra(covariance.view()));
    let largest = eigen.eigenvalues.iter().copied().fold(0.0, f64::max);

    // The eigenvalues of a covariance are squares of singular values, so the tolerance is squared
    // too.
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
    index: Box<dyn Index>,
    audit: Option<Audit>,
}

impl Search {
    /// An exact search among `candidates`, frames whose latents are rows of `latents`.
    ///
    /// # Errors
    /// [`Error::NoErrorCovariance`] or [`Error::ErrorCovariance`] when the metric needs calibrated
    /// errors and the adapter has none that can be used; [`Error::GatedMotion`] when it needs a
    /// fixed W and the adapter has charts under a gate; [`Error::WhitenedColumns`] when the latents
    /// are too wide to whiten.
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
            index,
            audit: None,
        })
    }

    /// A search among all frames.
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

                // The recall of this very graph is measured on at most 200 queries, so that it can
                // be reported.
                let audit = Some(index.audit(10, frames.len().div_ceil(200)));

                Ok(Self {
                    projection,
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
    ) -> Vec<Neighbour> {
        self.index
            .nearest(&self.projection.one(latent), k, exclusion)
    }

    /// About how much memory it holds, bytes.
    pub fn memory_bytes(&self) -> usize {
        self.index.memory_bytes()
    }

    /// How an approximate index compares with the exact scan; `None` if the index is exact.
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

    /// Oracle: the definition of Mahalanobis' distance, (a − b)ᵀ C⁻¹ (a − b), by nalgebra's general
    /// inverse.
    #[test]
    fn whitened_distances_are_mahalanobis() {
        let rows = wave(40, 5);
        let white = rows.dot(&whitening(rows.view()).t());
        let matrix = to_nalgebra(rows.view());
        let centred = DMatrix::from_fn(40, 5, |i, j| matrix[(i, j)] - matrix.column(j).mean());
        let inverse = (centred.transpose() * &centred / 40.0)
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

    /// Oracle: the projector W⁺W, whose distances are those in the basis.
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

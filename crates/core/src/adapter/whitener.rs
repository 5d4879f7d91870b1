//! Whitening: coordinates in which Euclidean distance is Mahalanobis distance.

use nalgebra::Cholesky;
use ndarray::{Array2, ArrayView1, ArrayView2};

use super::Error;
use crate::matrices::{to_nalgebra, to_ndarray};

/// Symmetry tolerance of a covariance, as a fraction of its largest entry.
const SYMMETRY_TOLERANCE: f64 = 1e-9;

/// Mahalanobis distance of latents under a covariance Σ: √(dᵀ Σ⁻¹ d).
#[derive(Debug, Clone, PartialEq)]
pub struct Whitener {
    /// L⁻¹ with Σ = L Lᵀ, shape (c, c).
    matrix: Array2<f64>,
}

impl Whitener {
    /// The whitener of a covariance, shape (c, c).
    ///
    /// # Errors
    /// [`Error::ErrorModel`] when the covariance is not symmetric and positive definite.
    pub fn new(covariance: ArrayView2<'_, f64>) -> Result<Self, Error> {
        let unsound = Error::ErrorModel {
            what: "a covariance of latents",
        };
        let size = covariance.nrows();
        let is_finite = covariance.iter().all(|x| x.is_finite());
        if size == 0 || covariance.ncols() != size || !is_finite {
            return Err(unsound);
        }

        let matrix = to_nalgebra(covariance);
        if (&matrix - matrix.transpose()).amax() > SYMMETRY_TOLERANCE * matrix.amax() {
            return Err(unsound);
        }

        let lower = Cholesky::new(matrix).ok_or(unsound.clone())?.unpack();
        let inverse = lower.try_inverse().ok_or(unsound)?;

        Ok(Self {
            matrix: to_ndarray(&inverse),
        })
    }

    /// Number of columns of a latent, c.
    pub fn size(&self) -> usize {
        self.matrix.nrows()
    }

    /// The whitened rows, shape (n, c); their L2 distance is the Mahalanobis distance.
    pub fn whitened(&self, rows: ArrayView2<'_, f64>) -> Array2<f64> {
        rows.dot(&self.matrix.t())
    }

    /// Squared Mahalanobis length of a difference of latents, shape (c,).
    pub fn squared_length(&self, difference: ArrayView1<'_, f64>) -> f64 {
        self.matrix.dot(&difference).mapv(|x| x * x).sum()
    }
}

#[cfg(test)]
mod tests {
    use ndarray::array;

    use super::*;

    /// Oracle: by hand; with variances 4 and 9, a difference of (2, 3) has length √2.
    #[test]
    fn a_whitener_measures_in_deviations() {
        let whitener = Whitener::new(array![[4.0, 0.0], [0.0, 9.0]].view()).unwrap();
        let difference = array![2.0, 3.0];
        assert!((whitener.squared_length(difference.view()) - 2.0).abs() < 1e-12);

        let white = whitener.whitened(array![[2.0, 3.0], [0.0, 0.0]].view());
        let squared = (&white.row(0) - &white.row(1)).mapv(|x| x * x).sum();
        assert!((squared - 2.0).abs() < 1e-12);

        assert!(Whitener::new(array![[1.0, 2.0], [2.0, 1.0]].view()).is_err());
        assert!(Whitener::new(array![[1.0, 0.5], [0.0, 1.0]].view()).is_err());
    }
}

//! The inverse Poincaré step: a motion as a step in latent space, ĝ − g = W⁺ΔP.

use nalgebra::{DMatrix, Vector6};
use ndarray::{Array1, Array2, ArrayView2};
use strum::{Display, EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::{Error, TargetScale};
use crate::geometry::Twist;
use crate::matrices::to_nalgebra;

/// Relative tolerance of the rank: singular values up to this fraction of the largest count as zero
///
const RANK_TOLERANCE: f64 = 1e-5;

/// How μ and σ, the z-scoring of the training targets, enter the inverse.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Display, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
pub enum Reading {
    /// Inverts the trained predictor exactly; zero motion changes the latent.
    ///
    /// W⁺((ΔP − μ)/σ). If μ is zero, zero motion does not change the latent.
    Affine,
    /// Zero motion keeps the latent; equal parts add up to the whole.
    ///
    /// W⁺(ΔP/σ). The service's default.
    Homogeneous,
    /// As printed in the paper.
    ///
    /// W⁺ΔP, without μ and σ.
    Literal,
}

/// W⁺, the pseudo-inverse of W by truncated SVD, together with μ and σ for the three readings.
#[derive(Debug, Clone)]
pub struct Inverse {
    /// Shape (k, 6).
    pseudo_inverse: Array2<f64>,
    /// Largest first.
    singular_values: [f64; 6],
    scale: TargetScale,
}

impl Inverse {
    /// Inverts `motion`, W of shape (6, k).
    ///
    /// # Errors
    /// [`Error::RankDeficient`] when the numerical rank of W is below 6.
    pub fn new(motion: ArrayView2<'_, f64>, scale: &TargetScale) -> Result<Self, Error> {
        let (pseudo_inverse, singular_values, rank) = pseudo_inverse(motion);
        let [largest, .., smallest] = singular_values;
        if rank < 6 {
            return Err(Error::RankDeficient {
                rank,
                largest,
                smallest,
            });
        }

        Ok(Self {
            pseudo_inverse,
            singular_values,
            scale: scale.clone(),
        })
    }

    /// W⁺, shape (k, 6).
    pub fn matrix(&self) -> ArrayView2<'_, f64> {
        self.pseudo_inverse.view()
    }

    /// Singular values of W, largest first.
    pub fn singular_values(&self) -> [f64; 6] {
        self.singular_values
    }

    /// The latent step of a motion. `mean_share` is the fraction of μ that the affine reading
    /// subtracts: 1 for a whole motion, 1/S for one of S equal parts. The steps of the parts then
    /// add up to the step of the whole.
    ///
    /// Source: SeeSE3, ĝ = φ(z) + W⁺ΔP.
    pub fn step(&self, twist: Twist, reading: Reading, mean_share: f64) -> Array1<f64> {
        self.pseudo_inverse
            .dot(&target(&self.scale, twist, reading, mean_share))
    }
}

/// The vector that W⁺ is applied to, in the given reading.
pub(super) fn target(
    scale: &TargetScale,
    twist: Twist,
    reading: Reading,
    mean_share: f64,
) -> Array1<f64> {
    let motion = twist.to_vector();
    let target: Vector6<f64> = match reading {
        Reading::Affine => (motion - scale.mean * mean_share).component_div(&scale.deviation),
        Reading::Homogeneous => motion.component_div(&scale.deviation),
        Reading::Literal => motion,
    };

    Array1::from_iter(target.iter().copied())
}

/// The pseudo-inverse (k, 6) of a (6, k) matrix by truncated SVD, the singular values in descending
/// order, and the numerical rank.
pub(super) fn pseudo_inverse(motion: ArrayView2<'_, f64>) -> (Array2<f64>, [f64; 6], usize) {
    // Thin SVD of the tall transpose: Wᵀ = U S Vᵀ, so W⁺ = U S⁻¹ Vᵀ.
    let columns = motion.ncols();
    let svd = to_nalgebra(motion.t()).svd(true, true);
    let mut sorted: Vec<f64> = svd.singular_values.iter().copied().collect();
    sorted.sort_by(|a, b| b.total_cmp(a));

    // A matrix with fewer than six columns has fewer singular values; the missing ones are zero.
    sorted.resize(6, 0.0);
    let least = RANK_TOLERANCE * sorted[0];
    let rank = sorted.iter().filter(|&&value| value > least).count();
    let reciprocal = svd
        .singular_values
        .map(|value| if value > least { value.recip() } else { 0.0 });
    let inverse = match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => u * DMatrix::from_diagonal(&reciprocal) * v_t,
        // This cannot happen: both factors were requested above.
        _ => DMatrix::zeros(columns, 6),
    };

    (
        Array2::from_shape_fn((columns, 6), |at| inverse[at]),
        std::array::from_fn(|i| sorted[i]),
        rank,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit_scale() -> TargetScale {
        TargetScale {
            mean: Vector6::zeros(),
            deviation: Vector6::repeat(1.0),
        }
    }

    /// Oracle: the definition of a right inverse, W W⁺ = I for a W of full row rank, and the
    /// Moore–Penrose condition that W⁺W is symmetric, which selects the shortest step.
    #[test]
    fn the_pseudo_inverse_is_the_shortest_right_inverse() {
        let w = Array2::from_shape_fn((6, 20), |(row, column)| {
            (((row * 20 + column) as f64).powi(2) * 0.37).sin()
        });
        let inverse = Inverse::new(w.view(), &unit_scale()).unwrap();
        let identity = w.dot(&inverse.matrix());

        assert!(
            (&identity - &Array2::<f64>::eye(6))
                .iter()
                .all(|x| x.abs() < 1e-12)
        );

        let projector = inverse.matrix().dot(&w);
        assert!(
            (&projector - &projector.t())
                .iter()
                .all(|x| x.abs() < 1e-12)
        );
    }

    /// Oracle: a W with two equal rows has rank 5 by definition.
    #[test]
    fn a_direction_that_was_never_trained_is_refused() {
        let mut w = Array2::from_shape_fn((6, 20), |(row, column)| {
            (((row * 20 + column) as f64).powi(2) * 0.37).sin()
        });
        let copy = w.row(0).to_owned();
        w.row_mut(5).assign(&copy);

        assert!(matches!(
            Inverse::new(w.view(), &unit_scale()),
            Err(Error::RankDeficient { rank: 5, .. })
        ));
    }
}

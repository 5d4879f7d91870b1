//! The covariance of heavy-tailed errors.

use nalgebra::{Matrix6, Vector6};

use super::balancing_factor;

/// Degrees of freedom of the fitted Student's t distribution.
const DEGREES_OF_FREEDOM: f64 = 4.0;
/// Number of components of an error.
const DIMENSIONS: f64 = 6.0;
/// Number of reweighting steps; the fit converges linearly, and after 30 steps changes are
/// negligible.
const ITERATIONS: usize = 30;

/// Robust covariance of errors: the shape of a Student's t, fitted by iterative reweighting, times
/// the [`balancing_factor`] of the 68 % and 95 % ellipsoids. `None` when the errors do not span six
/// dimensions.
pub fn robust_covariance(residuals: &[Vector6<f64>]) -> Option<Matrix6<f64>> {
    let mut shape = weighted_moment(residuals, |_| 1.0);
    for _ in 0..ITERATIONS {
        // Weights of the maximum-likelihood fit of a t distribution: small in the tails.
        let inverse = shape.cholesky()?.inverse();
        shape = weighted_moment(residuals, |residual| {
            let squared_length = residual.dot(&(inverse * residual));
            (DEGREES_OF_FREEDOM + DIMENSIONS) / (DEGREES_OF_FREEDOM + squared_length)
        });
    }

    let inverse = shape.cholesky()?.inverse();
    let mut squared_lengths: Vec<f64> = residuals
        .iter()
        .map(|residual| residual.dot(&(inverse * residual)))
        .collect();
    let factor = balancing_factor(&mut squared_lengths)?;

    Some((shape + shape.transpose()) * (0.5 * factor))
}

/// Mean of w(r) r rᵀ.
fn weighted_moment(
    residuals: &[Vector6<f64>],
    weight: impl Fn(&Vector6<f64>) -> f64,
) -> Matrix6<f64> {
    let sum = residuals.iter().fold(Matrix6::zeros(), |sum, residual| {
        sum + residual * residual.transpose() * weight(residual)
    });

    sum / residuals.len() as f64
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::super::normal_deviates;
    use super::*;

    /// Oracle: the definition: for normal errors, the result is their covariance.
    #[test]
    fn the_shape_of_normal_errors_is_theirs() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        let deviations = Vector6::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03);
        let drawn: Vec<Vector6<f64>> = (0..20_000)
            .map(|_| Vector6::from_iterator(normal_deviates(&mut random, 6)))
            .map(|normal| normal.component_mul(&deviations))
            .collect();

        let found = robust_covariance(&drawn).unwrap();
        for (axis, deviation) in deviations.iter().enumerate() {
            let ratio = found[(axis, axis)].sqrt() / deviation;
            assert!((0.95..1.05).contains(&ratio), "axis {axis}: {ratio}");
        }

        let flat: Vec<Vector6<f64>> = drawn
            .iter()
            .map(|r| Vector6::new(r[0], r[1], 0.0, r[3], r[4], r[5]))
            .collect();
        assert!(
            robust_covariance(&flat).is_none(),
            "errors that never leave a plane have no covariance"
        );
    }
}

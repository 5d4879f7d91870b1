//! The covariance of heavy-tailed errors.

use nalgebra::{Matrix6, Vector6};

use super::balancing_factor;

/// Degrees of freedom of the Student's t that shapes are fitted with.
const DEGREES_OF_FREEDOM: f64 = 4.0;
/// Components of an error.
const DIMENSIONS: f64 = 6.0;
/// Reweighting steps of the fit; it converges linearly, and thirty leave no visible change.
const ITERATIONS: usize = 30;

/// The covariance of errors: the shape of a Student's t, fitted by reweighting, times the factor
/// that balances the shares of errors inside the 68 % and the 95 % ellipsoid. None when the errors do
/// not span six dimensions.
pub fn robust_covariance(residuals: &[Vector6<f64>]) -> Option<Matrix6<f64>> {
    let mut shape = weighted_moment(residuals, |_| 1.0);
    for _ in 0..ITERATIONS {
        // An error far out in the tail gets a small weight; the t's own likelihood says how small.
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

    /// Oracle: the definition of a covariance: of normal errors it is their own, and both shares
    /// are near what is wanted.
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

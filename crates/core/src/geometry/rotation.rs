//! Projection of a matrix onto SO(3).

use nalgebra::{Matrix3, Rotation3};

/// Result of [`nearest_rotation`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NearestRotation {
    /// The nearest rotation in the Frobenius norm.
    pub rotation: Rotation3<f64>,
    /// Deviation of the matrix R from SO(3): the largest absolute entry of RRᵀ − I.
    pub deviation: f64,
}

/// The rotation nearest to `matrix` in the Frobenius norm: the orthogonal factor of its polar
/// decomposition. `None` when the matrix is not finite, is singular or contains a reflection.
pub fn nearest_rotation(matrix: &Matrix3<f64>) -> Option<NearestRotation> {
    if !matrix.iter().all(|x| x.is_finite()) || matrix.determinant() <= 1e-9 {
        return None;
    }

    // For M = U S Vᵀ the polar factor is U Vᵀ; the positive determinant makes it a proper rotation.
    let svd = matrix.svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    let deviation = (matrix * matrix.transpose() - Matrix3::identity())
        .abs()
        .max();

    Some(NearestRotation {
        rotation: Rotation3::from_matrix_unchecked(rotation),
        deviation,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// Oracle: by hand, a rotation scaled by 1.001 is nearest to the rotation itself, and RRᵀ − I =
    /// (1.001² − 1) I.
    #[test]
    fn a_scaled_rotation_projects_to_the_rotation() {
        let expected = Rotation3::new(Vector3::new(0.3, -0.8, 0.1));
        let found = nearest_rotation(&(expected.matrix() * 1.001)).unwrap();
        assert!((found.rotation.matrix() - expected.matrix()).norm() < 1e-12);
        assert!((found.deviation - 0.002_001).abs() < 1e-12);
    }

    /// Oracle: the definition of SO(3): determinant +1.
    #[test]
    fn a_mirror_or_a_singular_matrix_has_no_nearest_rotation() {
        assert!(nearest_rotation(&Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0))).is_none());
        assert!(nearest_rotation(&Matrix3::zeros()).is_none());
        assert!(nearest_rotation(&Matrix3::repeat(f64::NAN)).is_none());
    }
}

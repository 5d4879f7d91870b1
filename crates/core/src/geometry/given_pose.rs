//! Poses from external matrices and quaternions.

use nalgebra::{Matrix4, Quaternion, RowVector4, UnitQuaternion};

use super::{Pose, nearest_rotation};

/// Tolerance of a rotation matrix, the largest entry of |RRᵀ − I|. Within it, the matrix is
/// projected onto SO(3); above it, the matrix is refused.
pub const MAX_ROTATION_DEVIATION: f64 = 1e-2;

/// Tolerance of a quaternion's norm.
const NORM_TOLERANCE: f64 = 1e-2;

/// Why a matrix or a quaternion is not a rigid transform.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GivenPoseError {
    /// A number is infinite or NaN.
    #[error("is not finite")]
    NotFinite,
    /// The upper left 3×3 block is singular or mirrored.
    #[error("has no rotation: its matrix is singular or mirrored")]
    Singular,
    /// The last row is not (0, 0, 0, 1): the matrix is transposed, or is not a pose.
    #[error("the last row is not 0 0 0 1; is the matrix transposed?")]
    NotHomogeneous,
    /// The upper left 3×3 block is too far from SO(3) for a rounding error.
    #[error(
        "the rotation is {deviation:.1e} off SO(3), over the limit of {MAX_ROTATION_DEVIATION:.0e}; \
         is this a rotation matrix, row by row?"
    )]
    NotARotation {
        /// Largest entry of |RRᵀ − I|.
        deviation: f64,
    },
    /// The quaternion's norm is too far from 1 for a rounding error, or the position is not finite.
    #[error("the quaternion has norm {norm}, or the position is not finite")]
    NotUnit {
        /// Norm of the quaternion.
        norm: f64,
    },
}

/// A rigid transform, such as `world_from_camera`, from a homogeneous matrix. Also returns the
/// largest entry of |RRᵀ − I| of the rotation R before its projection onto SO(3).
///
/// # Errors
/// [`GivenPoseError`] if the matrix is not a rigid transform up to rounding.
pub fn pose_from_matrix(matrix: &Matrix4<f64>) -> Result<(Pose, f64), GivenPoseError> {
    if !matrix.iter().all(|number| number.is_finite()) {
        return Err(GivenPoseError::NotFinite);
    }
    if matrix.row(3) != RowVector4::new(0.0, 0.0, 0.0, 1.0) {
        return Err(GivenPoseError::NotHomogeneous);
    }

    // Published rotations have rounding errors: use the nearest rotation.
    let block = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let nearest = nearest_rotation(&block).ok_or(GivenPoseError::Singular)?;
    let deviation = nearest.deviation;
    if deviation > MAX_ROTATION_DEVIATION {
        return Err(GivenPoseError::NotARotation { deviation });
    }

    let rotation = UnitQuaternion::from_rotation_matrix(&nearest.rotation);
    let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    Ok((Pose::from_parts(translation.into(), rotation), deviation))
}

/// A pose from a position, meters, and a quaternion of norm 1 up to rounding.
///
/// # Errors
/// [`GivenPoseError::NotUnit`] if the norm is not 1 or a number is not finite.
pub fn pose_from_quaternion(
    position: [f64; 3],
    quaternion: Quaternion<f64>,
) -> Result<Pose, GivenPoseError> {
    let norm = quaternion.norm();
    let is_unit = (norm - 1.0).abs() <= NORM_TOLERANCE;
    if !is_unit || !position.iter().all(|number| number.is_finite()) {
        return Err(GivenPoseError::NotUnit { norm });
    }

    let rotation = UnitQuaternion::from_quaternion(quaternion);
    Ok(Pose::from_parts(position.into(), rotation))
}

//! Rigid motions of a camera: SE(3), its Lie algebra se(3), and pose errors.
//!
//! Conventions of the crate:
//! - A [`Pose`] is `world_from_camera`: it maps camera coordinates to world coordinates. Meters.
//! - Camera axes: x right, y down, z forward.
//! - A [`Twist`] is ordered (v, ω), the paper's order. GTSAM and sophus-rs use (ω, v).
//! - The motion between two frames is the twist in the body frame of the first camera: ΔP =
//!   log(P₁⁻¹ P₂), v in meters, ω in radians, |ω| ≤ π.
//! - v is the translation part of the logarithm, V(ω)⁻¹ t, not the translation t itself.

mod camera;
mod given_pose;
mod pose_error;
mod rotation;
mod se3;

pub use camera::{CameraError, CameraIntrinsics, Distortion, PixelCamera};
pub use given_pose::{
    GivenPoseError, MAX_ROTATION_DEVIATION, pose_from_matrix, pose_from_quaternion,
};
pub use pose_error::PoseError;
pub use rotation::{NearestRotation, nearest_rotation};
pub use se3::{Twist, adjoint, body_twist, exp, left_jacobian_inverse, log, twist_covariance};

/// A camera's position and orientation, `world_from_camera`, meters.
pub type Pose = nalgebra::Isometry3<f64>;

/// Margin below a rotation of π, radians, within which the logarithm is ambiguous up to rounding
///
pub const PI_MARGIN_RAD: f64 = 1e-6;

//! Conversion of poses and motions between wire types and nalgebra types.
//!
//! A wire pose is `parent_from_child`: it maps coordinates of the child frame to the parent frame,
//! meters. A wire twist is in se(3): v in meters and ω in radians, in the body frame of the camera
//! at the start of the motion.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};

use crate::proto::v1 as pb;

/// Tolerance of a quaternion's norm: the largest deviation from 1 that counts as rounding.
const QUATERNION_TOLERANCE: f64 = 1e-3;

/// Why a wire pose or twist is invalid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field} {problem}")]
pub struct ConvertError {
    /// The invalid field.
    pub field: &'static str,
    /// What is wrong with it.
    pub problem: String,
}

impl ConvertError {
    fn new(field: &'static str, problem: impl Into<String>) -> Self {
        Self {
            field,
            problem: problem.into(),
        }
    }
}

/// A camera motion in se(3), in the body frame of the camera at its start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Twist {
    /// v, meters.
    pub linear: Vector3<f64>,
    /// ω, the rotation axis times the angle, radians.
    pub angular: Vector3<f64>,
}

/// `parent_from_child` of a wire pose. Frame names are ignored.
///
/// # Errors
/// [`ConvertError`] if a part is missing or not finite, or the quaternion does not have norm 1.
pub fn pose(pose: &pb::Pose) -> Result<Isometry3<f64>, ConvertError> {
    let orientation = pose
        .orientation
        .as_ref()
        .ok_or_else(|| ConvertError::new("orientation", "is required"))?;
    let quaternion = Quaternion::new(orientation.w, orientation.x, orientation.y, orientation.z);
    let norm = quaternion.norm();

    // A small deviation is rounding, removed by `UnitQuaternion` below; a large one means that the
    // numbers are not a rotation.
    if norm.is_nan() || (norm - 1.0).abs() > QUATERNION_TOLERANCE {
        let problem = format!("has norm {norm}, a rotation has 1");
        return Err(ConvertError::new("orientation", problem));
    }

    let position = vector("position", pose.position.as_ref())?;
    Ok(Isometry3::from_parts(
        position.into(),
        UnitQuaternion::from_quaternion(quaternion),
    ))
}

/// The wire pose of `parent_from_child`, with the names of both frames.
pub fn pose_to_wire(
    parent_from_child: &Isometry3<f64>,
    parent_frame: &str,
    child_frame: &str,
) -> pb::Pose {
    let q = parent_from_child.rotation.quaternion();
    pb::Pose {
        parent_frame: parent_frame.to_owned(),
        child_frame: child_frame.to_owned(),
        position: Some(vector_to_wire(&parent_from_child.translation.vector)),
        orientation: Some(pb::Quaternion {
            w: q.w,
            x: q.i,
            y: q.j,
            z: q.k,
        }),
    }
}

/// The motion of a wire twist.
///
/// # Errors
/// [`ConvertError`] if a part is missing or not finite.
pub fn twist(twist: &pb::Twist) -> Result<Twist, ConvertError> {
    Ok(Twist {
        linear: vector("linear", twist.linear.as_ref())?,
        angular: vector("angular", twist.angular.as_ref())?,
    })
}

/// The wire twist of a motion.
pub fn twist_to_wire(twist: &Twist) -> pb::Twist {
    pb::Twist {
        linear: Some(vector_to_wire(&twist.linear)),
        angular: Some(vector_to_wire(&twist.angular)),
    }
}

fn vector(field: &'static str, vector: Option<&pb::Vector3>) -> Result<Vector3<f64>, ConvertError> {
    let &pb::Vector3 { x, y, z } = vector.ok_or_else(|| ConvertError::new(field, "is required"))?;
    let vector = Vector3::new(x, y, z);

    if vector.iter().all(|value| value.is_finite()) {
        Ok(vector)
    } else {
        let problem = format!("({x}, {y}, {z}) must be finite");
        Err(ConvertError::new(field, problem))
    }
}

fn vector_to_wire(vector: &Vector3<f64>) -> pb::Vector3 {
    pb::Vector3 {
        x: vector.x,
        y: vector.y,
        z: vector.z,
    }
}

impl pb::TrackUpdate {
    /// The camera pose in the map frame; `None` if it is unknown.
    pub fn map_from_camera(&self) -> Option<&pb::Pose> {
        self.camera.as_ref()?.map_from_body()
    }

    /// The camera pose in the odometry frame.
    pub fn odom_from_camera(&self) -> Option<&pb::Pose> {
        self.camera.as_ref()?.odom_from_body()
    }

    /// The pose of the robot's base in the map frame; `None` without it, or if the map pose is
    /// unknown.
    pub fn map_from_base(&self) -> Option<&pb::Pose> {
        self.base.as_ref()?.map_from_body()
    }

    /// The pose of the robot's base in the odometry frame; `None` without it.
    pub fn odom_from_base(&self) -> Option<&pb::Pose> {
        self.base.as_ref()?.odom_from_body()
    }
}

impl pb::TrackedBody {
    fn map_from_body(&self) -> Option<&pb::Pose> {
        self.map_pose.as_ref()?.pose.as_ref()
    }

    fn odom_from_body(&self) -> Option<&pb::Pose> {
        self.odom_pose.as_ref()?.pose.as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition: a round trip preserves values and names.
    #[test]
    fn poses_and_twists_come_back() {
        let parent_from_child =
            Isometry3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.1, 0.2, -0.3));
        let wire = pose_to_wire(&parent_from_child, "rooms/kitchen", "camera");
        let back = pose(&wire).unwrap();

        assert!((back.to_homogeneous() - parent_from_child.to_homogeneous()).norm() < 1e-12);
        assert_eq!(
            (&*wire.parent_frame, &*wire.child_frame),
            ("rooms/kitchen", "camera")
        );

        let motion = Twist {
            linear: Vector3::new(0.1, 0.0, 0.4),
            angular: Vector3::new(0.0, 0.2, 0.0),
        };
        assert_eq!(twist(&twist_to_wire(&motion)), Ok(motion));
    }

    /// Oracle: by hand: a missing part, a number that is not finite, and a quaternion of norm 2.
    #[test]
    fn what_is_no_pose_is_refused_by_field() {
        let identity = pose_to_wire(&Isometry3::identity(), "", "");
        let field = |wire: &pb::Pose| pose(wire).unwrap_err().field;

        let missing = pb::Pose {
            position: None,
            ..identity.clone()
        };
        let infinite = pb::Pose {
            position: Some(pb::Vector3 {
                x: f64::INFINITY,
                y: 0.0,
                z: 0.0,
            }),
            ..identity.clone()
        };
        let stretched = pb::Pose {
            orientation: Some(pb::Quaternion {
                w: 2.0,
                x: 0.0,
                y: 0.0,
                z: 0.0,
            }),
            ..identity
        };
        assert_eq!(field(&missing), "position");
        assert_eq!(field(&infinite), "position");
        assert_eq!(field(&stretched), "orientation");
    }
}

//! Poses measured by wheel or inertial odometry.
//!
//! The sensor reports the camera's pose in its own odometry frame, which drifts but never jumps.

use nalgebra::{Matrix6, Vector6};

use seese3_core::geometry::{Pose, Twist, exp};

/// Constant part of the standard deviations of a motion: 1 mm and 0.5 mrad.
const LEAST_DEVIATION_M: f64 = 1e-3;
const LEAST_DEVIATION_RAD: f64 = 5e-4;

/// Camera pose measured by another sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPose {
    /// Pose in the sensor's own odometry frame: `sensor_odom_from_camera`.
    pub pose: Pose,
    /// Drift rate of the sensor.
    pub drift: Drift,
    /// Covariance of the independent error of the velocity over the time since the last frame, on
    /// (v, ω) in the camera's body frame, m²/s² and rad²/s², if the sensor states one.
    pub velocity_covariance: Option<Matrix6<f64>>,
}

/// Drift rate of odometry, as standard deviations per axis. Errors are modeled as fully correlated,
/// like that of a wrong wheel radius: they grow with the distance, at any frame rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Meters per meter of translation, above 0.
    pub translation_share: f64,
    /// Radians per radian of rotation, and radians per meter of translation; above 0.
    pub rotation_share: f64,
}

/// Accumulated odometry from an earlier frame to the last frame with odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryDelta {
    /// Pose of the later camera in the earlier one.
    pub pose: Pose,
    /// Path length, meters.
    pub way_m: f64,
    /// Sum of all rotation angles, radians.
    pub turns_rad: f64,
}

impl OdometryDelta {
    /// The delta from a frame to itself.
    pub(crate) fn zero() -> Self {
        Self {
            pose: Pose::identity(),
            way_m: 0.0,
            turns_rad: 0.0,
        }
    }

    pub(crate) fn and(self, motion: Twist) -> Self {
        Self {
            pose: self.pose * exp(&motion),
            way_m: self.way_m + motion.linear.norm(),
            turns_rad: self.turns_rad + motion.angular.norm(),
        }
    }
}

impl Drift {
    /// Covariance of the error of an odometry delta, on (v, ω) in the later camera's body frame.
    /// The mean of a linearly growing heading error is half its final value, hence the factor 0.5.
    pub(crate) fn over(self, driven: OdometryDelta) -> Matrix6<f64> {
        let OdometryDelta {
            way_m, turns_rad, ..
        } = driven;
        let rotation = LEAST_DEVIATION_RAD + self.rotation_share * (turns_rad + way_m);
        let translation =
            LEAST_DEVIATION_M + self.translation_share * way_m + 0.5 * rotation * way_m;

        let (v, w) = (translation.powi(2), rotation.powi(2));
        Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use seese3_core::geometry::PoseError;

    /// Oracle: the definition, by hand: errors are fractions of the path, at any frame rate.
    #[test]
    fn errors_grow_with_the_distance_and_not_with_the_frames() {
        let drift = Drift {
            translation_share: 0.05,
            rotation_share: 0.02,
        };
        let rotation = 5e-4 + 0.02 * (0.3 + 3.0);
        let translation = 1e-3 + 0.05 * 3.0 + 0.5 * rotation * 3.0;
        let whole = Twist {
            linear: Vector3::new(3.0, 0.0, 0.0),
            angular: Vector3::new(0.0, 0.3, 0.0),
        };

        for frames in [1, 30, 300] {
            let step = whole.scaled(1.0 / f64::from(frames));
            let motions = (0..frames).map(|_| step);
            let driven = motions.fold(OdometryDelta::zero(), OdometryDelta::and);
            let covariance = drift.over(driven);
            assert!((covariance[(0, 0)].sqrt() - translation).abs() < 1e-9);
            assert!((covariance[(4, 4)].sqrt() - rotation).abs() < 1e-9);
        }
    }

    /// Oracle: composition.
    #[test]
    fn steps_of_odometry_add_up() {
        let step = Twist {
            linear: Vector3::new(0.1, 0.0, 0.0),
            angular: Vector3::new(0.0, 0.0, 0.1),
        };
        let twice = OdometryDelta::zero().and(step).and(step);
        let error = PoseError::between(&twice.pose, &exp(&step.times(2)));
        assert!(error.translation_m < 1e-12 && error.rotation_rad < 1e-7);
        assert!((twice.way_m - 0.2).abs() < 1e-12 && (twice.turns_rad - 0.2).abs() < 1e-12);
    }
}

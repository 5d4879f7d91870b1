//! Measured gravity as an observation of the camera's tilt.
//!
//! Views constrain the tilt poorly: a view rolled by 10° is most similar to mapped views of a level
//! camera at the same place. Gravity constrains the tilt, but neither the heading nor the position.

use nalgebra::{Matrix3, Unit, Vector3};

use super::FilterParameters;
use super::belief::{Observation, Step};

/// Squared Mahalanobis length of a tilt above which gravity counts less: the 99 % quantile of χ²
/// with two degrees of freedom.
const GATE: f64 = 9.21;

/// The direction of gravity, as an accelerometer measures it in the camera's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredGravity {
    /// In the room's world frame.
    pub in_world: Unit<Vector3<f64>>,
    /// In the camera's frame.
    pub in_camera: Unit<Vector3<f64>>,
    /// The standard deviation of the measured direction about each axis, radians, above 0.
    pub deviation_rad: f64,
}

/// Gravity that contradicts a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tilted {
    /// The angle between measured and expected gravity, radians.
    pub angle_rad: f64,
}

impl MeasuredGravity {
    /// The rotation of the camera that aligns expected with measured gravity, in its body frame,
    /// radians. Its derivative by a rotation error of the pose is the projection onto the plane
    /// across the expected direction.
    fn observed(&self, step: &Step) -> Observation<3> {
        let expected = step.end_pose().rotation.inverse() * self.in_world.into_inner();
        let measured = self.in_camera.into_inner();

        // A camera rotated by ω measures a direction h as h − ω × h, so the axis is measured ×
        // expected. If the two are opposite, use any perpendicular axis.
        let across = measured.cross(&expected);
        let angle = across.norm().atan2(measured.dot(&expected));
        let axis = across.try_normalize(1e-9).unwrap_or_else(|| {
            let least = expected.iamin();
            expected.cross(&Vector3::ith(least, 1.0)).normalize()
        });

        let projection = Matrix3::identity() - expected * expected.transpose();
        let of_pose = step.end_derivative();
        Observation {
            residual: axis * angle,
            derivative: projection * of_pose.fixed_rows::<3>(3),
            noise: Matrix3::identity() * self.deviation_rad.powi(2),
        }
    }

    /// Corrects the tilt of a step. `seconds` is the time since the last measurement. Returns the
    /// contradiction if gravity is outside the gate: the robot accelerates, or the axes are wrong.
    pub(super) fn correct(
        &self,
        step: &mut Step,
        seconds: f64,
        parameters: &FilterParameters,
    ) -> Option<Tilted> {
        let observed = self.observed(step);
        let excess = step.squared_innovation(&observed) / GATE;

        // With the correlation ρ between successive errors, n measurements have the information of
        // n (1 − ρ)/(1 + ρ) independent ones.
        let correlation = (-seconds / parameters.gravity_correlation_s).exp();
        let inflation = (1.0 + correlation) / (1.0 - correlation);
        step.update(&observed, inflation * excess.max(1.0).powi(2));
        let angle_rad = observed.residual.norm();
        (excess > 1.0).then_some(Tilted { angle_rad })
    }
}

//! Pose errors: distance and angle between two poses.

use super::Pose;

/// Error of an estimated pose against the true one, from E = found⁻¹ · true.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// Distance between the camera centers, meters.
    pub translation_m: f64,
    /// Rotation angle between them, radians, in \[0, π\].
    pub rotation_rad: f64,
}

impl PoseError {
    /// Error of the estimate `world_from_found` against `world_from_true`.
    pub fn between(world_from_found: &Pose, world_from_true: &Pose) -> Self {
        let found_from_true = world_from_found.inv_mul(world_from_true);

        // q and −q are the same rotation; |w| selects the angle in [0, π]. Unlike acos, atan2 stays
        // accurate for small angles.
        let quaternion = found_from_true.rotation.quaternion();

        Self {
            translation_m: found_from_true.translation.vector.norm(),
            rotation_rad: 2.0 * quaternion.imag().norm().atan2(quaternion.w.abs()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// Oracle: by hand, 3-4-5 in the plane and a quarter turn.
    #[test]
    fn a_quarter_turn_five_meters_away() {
        let found = Pose::new(Vector3::new(1.0, 0.0, 0.0), Vector3::zeros());

        let truth = Pose::new(
            Vector3::new(4.0, 4.0, 0.0),
            Vector3::new(0.0, std::f64::consts::FRAC_PI_2, 0.0),
        );
        let error = PoseError::between(&found, &truth);

        assert!((error.translation_m - 5.0).abs() < 1e-12);
        assert!((error.rotation_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }
}

//! A Gaussian on SE(3): the pose of a camera and its uncertainty.

use nalgebra::{Matrix6, Vector6};

use seese3_core::geometry::{Pose, adjoint, log};

/// Largest standard deviations of a usable pose: 2.5 of them are 0.5 m or 15°.
pub(crate) const PLACE_DEVIATION_M: f64 = 0.2;
const PLACE_DEVIATION_RAD: f64 = 0.105;

/// A pose with the covariance of its error δ in its own body frame: true = pose · exp(δ), δ ordered
/// (v, ω), meters and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseWithCovariance {
    /// `parent_from_camera`.
    pub pose: Pose,
    /// Symmetric and positive definite.
    pub covariance: Matrix6<f64>,
}

impl PoseWithCovariance {
    /// A pose with independent errors; `translation_m` and `rotation_rad` are standard deviations
    /// along and about each axis.
    pub fn known(pose: Pose, translation_m: f64, rotation_rad: f64) -> Self {
        let v = translation_m * translation_m;
        let w = rotation_rad * rotation_rad;

        Self {
            pose,
            covariance: Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w)),
        }
    }

    /// The pose after a motion `earlier_from_later` with an independent error, which is in the
    /// later body frame.
    #[must_use]
    pub fn composed(&self, motion: &Self) -> Self {
        let back = adjoint(&motion.pose.inverse());
        let carried = back * self.covariance * back.transpose();
        Self {
            pose: self.pose * motion.pose,
            covariance: symmetric(&(carried + motion.covariance)),
        }
    }

    /// Pose of another body, rigidly attached to this one at `body_from_other`. The covariance is
    /// transformed by the adjoint.
    #[must_use]
    pub fn of_attached(&self, body_from_other: &Pose) -> Self {
        let other = adjoint(&body_from_other.inverse());
        Self {
            pose: self.pose * *body_from_other,
            covariance: symmetric(&(other * self.covariance * other.transpose())),
        }
    }

    /// The covariance in the order and frame of `geometry_msgs/PoseWithCovariance`: x, y, z, then
    /// rotations about x, y, z, about the parent's fixed axes. Row-major, meters and radians.
    ///
    /// Source: ROS REP-103; δ_parent = R δ_body for both halves, to first order.
    pub fn ros_covariance(&self) -> Matrix6<f64> {
        let rotation = self.pose.rotation.to_rotation_matrix().into_inner();
        let mut turn = Matrix6::zeros();
        turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
        turn.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);

        symmetric(&(turn * self.covariance * turn.transpose()))
    }

    /// Squared Mahalanobis length of the error relative to the true pose; `None` if the covariance
    /// is not positive definite.
    pub fn squared_error(&self, truth: &Pose) -> Option<f64> {
        let error = log(&self.pose.inv_mul(truth)).to_vector();
        Some(error.dot(&self.covariance.cholesky()?.solve(&error)))
    }

    /// Whether the uncertainty is at most 0.5 m and 15°, at 2.5 standard deviations.
    pub fn tells_a_place(&self) -> bool {
        self.position_deviation_m() <= PLACE_DEVIATION_M
            && self.rotation_deviation_rad() <= PLACE_DEVIATION_RAD
    }

    /// The largest standard deviation of the position along any direction, meters.
    pub fn position_deviation_m(&self) -> f64 {
        self.largest_deviation(0)
    }

    /// The largest standard deviation of the rotation about any axis, radians.
    pub fn rotation_deviation_rad(&self) -> f64 {
        self.largest_deviation(3)
    }

    fn largest_deviation(&self, at: usize) -> f64 {
        let block = self.covariance.fixed_view::<3, 3>(at, at).into_owned();
        block.symmetric_eigenvalues().max().max(0.0).sqrt()
    }
}

/// The symmetric part of a matrix: rounding leaves products slightly asymmetric.
fn symmetric(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    (matrix + matrix.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Cholesky, Vector3};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use seese3_core::geometry::{Twist, exp};
    use seese3_core::statistics::normal_deviates;

    fn twist(v: [f64; 3], w: [f64; 3]) -> Twist {
        Twist {
            linear: Vector3::from(v),
            angular: Vector3::from(w),
        }
    }

    fn drawn(random: &mut ChaCha8Rng, covariance: &Matrix6<f64>) -> Vector6<f64> {
        Cholesky::new(*covariance).unwrap().l() * Vector6::from_iterator(normal_deviates(random, 6))
    }

    /// Oracle: Monte Carlo with 10,000 samples: their covariance is the composed one.
    #[test]
    fn a_composed_covariance_is_that_of_drawn_motions() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let start = PoseWithCovariance::known(Pose::translation(1.0, 2.0, 3.0), 0.02, 0.03);
        let motion = PoseWithCovariance {
            pose: exp(&twist([0.5, -0.2, 0.8], [0.1, 0.6, -0.2])),
            covariance: Matrix6::from_diagonal(&Vector6::new(4e-4, 1e-4, 9e-4, 1e-4, 4e-4, 2e-4)),
        };
        let found = start.composed(&motion);

        let count = 10_000;
        let mut sum = Matrix6::zeros();
        for _ in 0..count {
            let [from, step] = [&start, &motion]
                .map(|of| of.pose * exp(&Twist::from_vector(&drawn(&mut random, &of.covariance))));
            let error = log(&found.pose.inv_mul(&(from * step))).to_vector();
            sum += error * error.transpose() / f64::from(count);
        }

        let worst = (sum - found.covariance).amax() / found.covariance.amax();
        assert!(
            worst < 0.05,
            "off by {worst}: {sum} against {}",
            found.covariance
        );
    }

    /// Oracle: ROS's definition, by hand. For a camera rotated by 90° about z, the variance along
    /// its own x axis is along the parent's y axis. The same holds for the rotation about x.
    #[test]
    fn covariances_for_ros_are_about_the_parents_axes() {
        let turn = Pose::rotation(Vector3::z() * std::f64::consts::FRAC_PI_2);
        let covariance = Matrix6::from_diagonal(&Vector6::new(4.0, 1.0, 1.0, 0.9, 0.1, 0.1));
        let found = PoseWithCovariance {
            pose: turn,
            covariance,
        }
        .ros_covariance();

        let expected = Matrix6::from_diagonal(&Vector6::new(1.0, 4.0, 1.0, 0.1, 0.9, 0.1));
        assert!((found - expected).amax() < 1e-12, "{found}");
    }
}

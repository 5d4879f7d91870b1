//! A Gaussian on SE(3): the pose of a camera and its uncertainty.

use nalgebra::{Cholesky, Matrix6, Vector6};

use seese3_core::geometry::{Pose, Twist, adjoint, exp, left_jacobian_inverse, log};

/// Largest standard deviations of a usable pose: 2.5 of them are 0.5 m or 15°.
pub(crate) const PLACE_DEVIATION_M: f64 = 0.2;
const PLACE_DEVIATION_RAD: f64 = 0.105;

/// A pose with the covariance of its error δ in its own body frame: true = pose · exp(δ), δ ordered
/// (v, ω), meters and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct PoseWithCovariance {
    /// `parent_from_camera`.
    pub pose: Pose,
    /// Symmetric and positive definite.
    #[cfg_attr(
        feature = "serde",
        serde(with = "seese3_core::matrices::upper_triangle")
    )]
    pub covariance: Matrix6<f64>,
}

/// Difference between a predicted and a measured pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// log(pose⁻¹ measured).
    pub twist: Vector6<f64>,
    /// Squared Mahalanobis length of `twist` under the sum of both covariances: χ² with six degrees
    /// of freedom if both covariances are correct.
    pub squared_length: f64,
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

    /// Prediction after a motion with error r, true = exp(motion + r); `noise` is the covariance of
    /// r.
    ///
    /// Source: P' = Ad P Adᵀ + J_r Q J_rᵀ with Ad of exp(−ξ); Barfoot, State Estimation for
    /// Robotics, ch. 8.
    #[must_use]
    pub fn moved(&self, motion: Twist, noise: &Matrix6<f64>) -> Self {
        // The old error is carried into the new body frame by the adjoint of exp(−ξ).
        let back = adjoint(&exp(&motion.reversed()));
        let carried = back * self.covariance * back.transpose();

        // J_r(ξ) = J_l(−ξ), found by inverting J_l⁻¹(−ξ), which can be inverted for |ω| < π.
        let right = left_jacobian_inverse(&motion.reversed())
            .try_inverse()
            .unwrap_or_else(Matrix6::identity);
        let covariance = symmetric(&(carried + right * noise * right.transpose()));

        Self {
            pose: self.pose * exp(&motion),
            covariance,
        }
    }

    /// The pose after a motion `earlier_from_later` with an independent error, which is in the later
    /// body frame.
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

    /// Innovation of a measured pose; `None` if the sum of the covariances is not positive
    /// definite.
    pub fn innovation(&self, measured: &PoseWithCovariance) -> Option<Innovation> {
        let twist = log(&self.pose.inv_mul(&measured.pose)).to_vector();
        let sum = Cholesky::new(self.covariance + measured.covariance)?;

        Some(Innovation {
            twist,
            squared_length: twist.dot(&sum.solve(&twist)),
        })
    }

    /// Kalman update with a measured pose, to first order in the innovation. The covariance uses
    /// Joseph's form, which stays positive definite under rounding. If the sum of the covariances
    /// is not positive definite, `self` is returned unchanged.
    #[must_use]
    pub fn corrected(&self, measured: &PoseWithCovariance) -> Self {
        let Some(sum) = Cholesky::new(self.covariance + measured.covariance) else {
            return *self;
        };
        let gain = self.covariance * sum.inverse();

        let twist = log(&self.pose.inv_mul(&measured.pose)).to_vector();
        let step = Twist::from_vector(&(gain * twist));

        // Joseph's form: (I − K) P (I − K)ᵀ + K R Kᵀ.
        let rest = Matrix6::identity() - gain;
        let joseph = rest * self.covariance * rest.transpose()
            + gain * measured.covariance * gain.transpose();

        Self {
            pose: self.pose * exp(&step),
            covariance: symmetric(&joseph),
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
        self.is_within(1.0)
    }

    /// Whether the uncertainty is at most 1 m and 30°, at 2.5 standard deviations.
    pub(super) fn hints_at_a_place(&self) -> bool {
        self.is_within(2.0)
    }

    fn is_within(&self, factor: f64) -> bool {
        self.position_deviation_m() <= factor * PLACE_DEVIATION_M
            && self.rotation_deviation_rad() <= factor * PLACE_DEVIATION_RAD
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
    use nalgebra::Vector3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

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

    /// Oracle: Monte Carlo with 10,000 samples: their covariance is the predicted one.
    #[test]
    fn a_moved_covariance_is_that_of_drawn_motions() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let start = PoseWithCovariance::known(Pose::translation(1.0, 2.0, 3.0), 0.02, 0.03);
        let motion = twist([0.5, -0.2, 0.8], [0.1, 0.6, -0.2]);
        let noise = Matrix6::from_diagonal(&Vector6::new(4e-4, 1e-4, 9e-4, 1e-4, 4e-4, 2e-4));
        let found = start.moved(motion, &noise);

        let count = 10_000;
        let mut sum = Matrix6::zeros();
        for _ in 0..count {
            let from =
                start.pose * exp(&Twist::from_vector(&drawn(&mut random, &start.covariance)));
            let read = motion.to_vector() + drawn(&mut random, &noise);
            let end = from * exp(&Twist::from_vector(&read));
            let error = log(&found.pose.inv_mul(&end)).to_vector();
            sum += error * error.transpose() / f64::from(count);
        }

        let worst = (sum - found.covariance).amax() / found.covariance.amax();
        assert!(
            worst < 0.05,
            "off by {worst}: {sum} against {}",
            found.covariance
        );
    }

    /// Oracle: by hand. Two poses with equal covariance meet in the middle with half the variance.
    /// The squared Mahalanobis length of a 2 m innovation with variances 1 + 1 is 2.
    #[test]
    fn two_equally_sure_poses_meet_in_the_middle() {
        let ours = PoseWithCovariance::known(Pose::identity(), 1.0, 0.1);
        let theirs = PoseWithCovariance::known(Pose::translation(2.0, 0.0, 0.0), 1.0, 0.1);
        let met = ours.corrected(&theirs);

        assert!((met.pose.translation.vector - Vector3::x()).norm() < 1e-12);
        assert!((met.covariance - ours.covariance * 0.5).amax() < 1e-12);
        assert!((ours.innovation(&theirs).unwrap().squared_length - 2.0).abs() < 1e-12);
        assert!((ours.position_deviation_m() - 1.0).abs() < 1e-12);
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

    /// Oracle: the definition of positive definite, over many predictions and corrections.
    #[test]
    fn a_covariance_stays_positive_definite() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let mut belief = PoseWithCovariance::known(Pose::identity(), 1e-6, 1e-6);
        let noise = Matrix6::from_diagonal_element(1e-8);
        for step in 0..5_000 {
            let motion = Twist::from_vector(
                &(0.3 * Vector6::from_iterator(normal_deviates(&mut random, 6))),
            );
            belief = belief.moved(motion, &noise);

            if step % 7 == 0 {
                belief = belief.corrected(&PoseWithCovariance {
                    pose: belief.pose,
                    covariance: Matrix6::from_diagonal_element(1e-9),
                });
            }

            assert!(
                Cholesky::new(belief.covariance).is_some(),
                "after {step} steps"
            );
        }
    }
}

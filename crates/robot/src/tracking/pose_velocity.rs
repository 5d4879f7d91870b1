//! A Gaussian on a camera's pose and velocity.

use nalgebra::{Cholesky, Matrix6, SMatrix, SVector};

use super::motion_prior::{Matrix12, MotionPrior};
use super::{Innovation, PoseWithCovariance};
use seese3_core::geometry::{Pose, Twist, adjoint, exp, log};

type Matrix18 = SMatrix<f64, 18, 18>;

/// Factor on the process noise of the motion prior, since a person turns and stops more abruptly
/// than the Gaussian process. Chosen on calibration rooms from 1 to 16: with 1 the filter lags;
/// from 8 on velocities are worse.
const ABRUPTNESS: f64 = 4.0;

/// A pose and a velocity with the covariance of their errors. The pose error δ is in the body
/// frame, true = pose · exp(δ). Both are ordered (v, ω), in meters, radians and seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct PoseVelocity {
    /// `parent_from_camera`.
    pub pose: Pose,
    /// In the camera's body frame, meters and radians per second.
    pub velocity: Twist,
    /// Of (pose, velocity); symmetric and positive definite.
    #[cfg_attr(
        feature = "serde",
        serde(with = "seese3_core::matrices::upper_triangle")
    )]
    pub covariance: SMatrix<f64, 12, 12>,
}

/// A motion between two frames, predicted or measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ReadMotion {
    pub motion: Twist,
    pub covariance: Matrix6<f64>,
}

impl PoseVelocity {
    /// A state with a known pose and unknown velocity: zero, with the covariance of the prior.
    pub fn at(place: PoseWithCovariance, prior: &MotionPrior) -> Self {
        let mut covariance = Matrix12::zeros();
        covariance
            .fixed_view_mut::<6, 6>(0, 0)
            .copy_from(&place.covariance);
        covariance
            .fixed_view_mut::<6, 6>(6, 6)
            .copy_from(&prior.velocity_covariance());

        Self {
            pose: place.pose,
            velocity: Twist::default(),
            covariance,
        }
    }

    /// The pose without the velocity.
    pub fn place(&self) -> PoseWithCovariance {
        PoseWithCovariance {
            pose: self.pose,
            covariance: self.covariance.fixed_view::<6, 6>(0, 0).into_owned(),
        }
    }

    /// Predicts the state some seconds later. `read` is an estimate of the motion in between, if
    /// there is one; it is fused with the prior by their covariances.
    #[must_use]
    pub(super) fn moved(
        &self,
        prior: &MotionPrior,
        seconds: f64,
        read: Option<&ReadMotion>,
    ) -> Self {
        let drift = prior.over(&self.velocity, seconds);

        // Joint covariance of three errors: the initial pose, the motion, the final velocity. The
        // motion error is in the final body frame.
        let mut spread = SMatrix::<f64, 18, 12>::zeros();
        for axis in 0..6 {
            let part = axis / 3;
            spread[(axis, axis)] = 1.0;
            spread[(6 + axis, 6 + axis)] = drift.reach_s[part];
            spread[(12 + axis, 6 + axis)] = drift.left[part];
        }
        let mut covariance: Matrix18 = spread * self.covariance * spread.transpose();
        let mut of_drift = covariance.fixed_view_mut::<12, 12>(6, 6);
        of_drift += drift.noise * ABRUPTNESS;

        let mut change = SVector::<f64, 18>::zeros();
        if let Some(read) = read {
            let error = log(&exp(&drift.motion).inv_mul(&exp(&read.motion))).to_vector();
            let of_motion = covariance.fixed_view::<18, 6>(0, 6).into_owned();
            let sum = covariance.fixed_view::<6, 6>(6, 6) + read.covariance;
            if let Some(sum) = Cholesky::new(sum) {
                let gain = of_motion * sum.inverse();
                change = gain * error;
                covariance -= gain * of_motion.transpose();
            }
        }

        let part = |at: usize| Twist::from_vector(&change.fixed_rows::<6>(at).into_owned());
        let motion = exp(&drift.motion) * exp(&part(6));
        let velocity = drift.velocity.to_vector() + change.fixed_rows::<6>(12);

        // Final pose error: the initial pose error in the new body frame, plus the motion error.
        let mut merged = SMatrix::<f64, 12, 18>::zeros();
        merged
            .fixed_view_mut::<6, 6>(0, 0)
            .copy_from(&adjoint(&motion.inverse()));
        for axis in 0..6 {
            merged[(axis, 6 + axis)] = 1.0;
            merged[(6 + axis, 12 + axis)] = 1.0;
        }

        Self {
            pose: self.pose * exp(&part(0)) * motion,
            velocity: Twist::from_vector(&velocity),
            covariance: symmetric(&(merged * covariance * merged.transpose())),
        }
    }

    /// Innovation of a measured pose; `None` if the sum of the covariances is not positive
    /// definite.
    pub fn innovation(&self, measured: &PoseWithCovariance) -> Option<Innovation> {
        self.place().innovation(measured)
    }

    /// Kalman update with a measured pose, to first order in the innovation. The velocity changes
    /// through its correlation with the pose. If the sum of the covariances is not positive
    /// definite, `self` is returned unchanged.
    #[must_use]
    pub fn corrected(&self, measured: &PoseWithCovariance) -> Self {
        let place = self.place();
        let Some(sum) = Cholesky::new(place.covariance + measured.covariance) else {
            return *self;
        };
        let gain = self.covariance.fixed_view::<12, 6>(0, 0) * sum.inverse();

        let twist = log(&self.pose.inv_mul(&measured.pose)).to_vector();
        let change = gain * twist;
        let step = Twist::from_vector(&change.fixed_rows::<6>(0).into_owned());
        let velocity = self.velocity.to_vector() + change.fixed_rows::<6>(6);

        // Joseph's form: (I − K H) P (I − K H)ᵀ + K R Kᵀ, with H = [I 0].
        let mut rest = Matrix12::identity();
        let mut of_pose = rest.fixed_view_mut::<12, 6>(0, 0);
        of_pose -= gain;
        let joseph = rest * self.covariance * rest.transpose()
            + gain * measured.covariance * gain.transpose();

        Self {
            pose: self.pose * exp(&step),
            velocity: Twist::from_vector(&velocity),
            covariance: symmetric(&joseph),
        }
    }
}

/// The symmetric part of a matrix: rounding leaves products slightly asymmetric.
fn symmetric(matrix: &Matrix12) -> Matrix12 {
    (matrix + matrix.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    fn prior() -> MotionPrior {
        MotionPrior::assumed()
    }

    /// Oracle: the stationary Ornstein–Uhlenbeck process in closed form, and the Kalman gain by
    /// hand. After a time t the variance of the displacement is 2σ²τ²(t/τ − 1 + e^(−t/τ)), and its
    /// covariance with the velocity σ²τ(1 − e^(−t/τ)). The part due to the initial velocity counts
    /// once, the rest [`ABRUPTNESS`] times.
    #[test]
    fn a_measured_pose_tells_the_velocity() {
        let (variance, duration, time) = (0.25, 0.5, 0.1_f64);
        let left = (-time / duration).exp();
        let reach = duration * (1.0 - left);
        let abrupt = |all: f64, begun: f64| begun + ABRUPTNESS * (all - begun);
        let way = abrupt(
            2.0 * variance * duration * duration * (time / duration - 1.0 + left),
            variance * reach * reach,
        );
        let way_velocity = abrupt(variance * reach, variance * reach * left);
        let velocity = abrupt(variance, variance * left * left);

        let start = PoseVelocity::at(
            PoseWithCovariance::known(Pose::identity(), 0.01, 0.01),
            &prior(),
        );
        let later = start.moved(&prior(), time, None);
        let found = later.covariance;
        assert!((found[(0, 0)] - (1e-4 + way)).abs() < 1e-12);
        assert!((found[(0, 6)] - way_velocity).abs() < 1e-12);
        assert!((found[(6, 6)] - velocity).abs() < 1e-12);

        let measured = PoseWithCovariance::known(Pose::translation(0.03, 0.0, 0.0), 0.02, 0.02);
        let corrected = later.corrected(&measured);
        let gain = 0.03 / (1e-4 + way + 4e-4);
        assert!((corrected.pose.translation.x - (1e-4 + way) * gain).abs() < 1e-12);
        assert!((corrected.velocity.linear.x - way_velocity * gain).abs() < 1e-12);
        assert!(corrected.velocity.linear.yz().norm() < 1e-12);
    }

    /// Oracle: the definition. An exact motion estimate determines the motion and leaves only the
    /// initial error, in the new body frame. An estimate with infinite variance changes nothing.
    #[test]
    fn a_reading_counts_as_much_as_it_is_sure() {
        let start = PoseVelocity::at(
            PoseWithCovariance::known(Pose::identity(), 0.1, 1e-6),
            &prior(),
        );
        let motion = Twist {
            linear: Vector3::new(0.2, -0.1, 0.05),
            angular: Vector3::new(0.0, 0.4, 0.1),
        };
        let read = |variance: f64| ReadMotion {
            motion,
            covariance: Matrix6::from_diagonal_element(variance),
        };

        let sure = start.moved(&prior(), 0.5, Some(&read(1e-12)));
        let error = log(&sure.pose.inv_mul(&exp(&motion))).to_vector();
        assert!(error.norm() < 1e-6, "{error}");
        let of_position = sure.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        assert!((of_position - nalgebra::Matrix3::identity() * 0.01).amax() < 1e-6);

        let unsure = start.moved(&prior(), 0.5, Some(&read(1e12)));
        let without = start.moved(&prior(), 0.5, None);
        assert!((unsure.covariance - without.covariance).amax() < 1e-9);
        assert!((unsure.pose.to_homogeneous() - without.pose.to_homogeneous()).amax() < 1e-9);
    }

    /// Oracle: the definition of positive definite, over many predictions and corrections.
    #[test]
    fn a_covariance_stays_positive_definite() {
        let mut belief = PoseVelocity::at(
            PoseWithCovariance::known(Pose::identity(), 1e-6, 1e-6),
            &prior(),
        );
        for step in 0..5_000 {
            belief = belief.moved(&prior(), 0.02, None);
            if step % 3 == 0 {
                belief = belief.corrected(&PoseWithCovariance::known(belief.pose, 1e-4, 1e-4));
            }
            assert!(
                Cholesky::new(belief.covariance).is_some(),
                "after {step} steps"
            );
        }
    }
}

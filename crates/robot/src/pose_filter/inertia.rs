//! Measured inertial motion, which predicts a step in place of the motion prior.

use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Unit, UnitQuaternion, Vector3, Vector6};

use super::belief::{BIASES, Belief, POSE, Predicted, STATE, VELOCITY};
use crate::inertial::{GRAVITY_M_S2, InertialMotion};
use seese3_core::geometry::{Pose, Twist, exp, log};

/// Least variance of a prediction, squared meters, radians, m/s and rad/s.
const LEAST_VARIANCE: f64 = 1e-9;

/// Rows of a prediction: translation and rotation of the motion, linear and angular velocity.
const TRANSLATION: usize = 0;
const ROTATION: usize = 3;
const LINEAR: usize = 6;
const ANGULAR: usize = 9;

/// Rows of an [`InertialMotion`]: position, rotation and velocity.
const OF_POSITION: usize = 0;
const OF_ROTATION: usize = 3;
const OF_VELOCITY: usize = 6;

/// The motion since the last frame by a gyroscope and an accelerometer.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredInertia {
    /// In the axes of the camera.
    pub motion: InertialMotion,
    /// The direction of gravity in the parent frame of the belief; `None` if it is unknown: only
    /// the gyroscope counts then.
    pub down_in_parent: Option<Unit<Vector3<f64>>>,
}

/// An inertial motion at the estimated biases.
struct Corrected {
    /// `start_from_end`.
    rotation: UnitQuaternion<f64>,
    /// In the axes of the start.
    position: Vector3<f64>,
    velocity: Vector3<f64>,
    /// At the end.
    rate: Vector3<f64>,
    /// Derivatives of (position, rotation, velocity) by the biases in their standard deviations.
    by_bias: SMatrix<f64, 9, 6>,
}

impl Corrected {
    fn of(motion: &InertialMotion, belief: &Belief) -> Self {
        let [gyroscope, accelerometer] = motion.noise.bias;
        let mut deviations = Vector6::repeat(gyroscope);
        deviations.fixed_rows_mut::<3>(3).fill(accelerometer);
        let by_bias = motion.by_bias * Matrix6::from_diagonal(&deviations);
        let biases = belief.inertial_biases();
        let corrections: SVector<f64, 9> = by_bias * biases;
        let part = |row: usize| -> Vector3<f64> { corrections.fixed_rows::<3>(row).into() };

        Self {
            rotation: motion.rotation * UnitQuaternion::from_scaled_axis(part(OF_ROTATION)),
            position: motion.position + part(OF_POSITION),
            velocity: motion.velocity + part(OF_VELOCITY),
            rate: motion.last_rate - biases.fixed_rows::<3>(0) * gyroscope,
            by_bias,
        }
    }

    fn by_bias_of(&self, row: usize) -> SMatrix<f64, 3, 6> {
        self.by_bias.fixed_rows::<3>(row).into_owned()
    }
}

impl MeasuredInertia {
    /// The prediction with the rotation of the gyroscope and, where the direction of gravity is
    /// known, the translation of the accelerometer.
    pub(super) fn in_place_of(&self, mut predicted: Predicted, belief: &Belief) -> Predicted {
        let corrected = Corrected::of(&self.motion, belief);
        self.turn(&mut predicted, &corrected);
        match &self.down_in_parent {
            Some(down) => self.accelerate(&mut predicted, &corrected, belief, down),
            None => {
                predicted.motion = exp(&Twist {
                    linear: log(&predicted.motion).linear,
                    angular: corrected.rotation.scaled_axis(),
                });
            }
        }
        for axis in 0..12 {
            predicted.noise[(axis, axis)] += LEAST_VARIANCE;
        }
        predicted
    }

    /// Replaces rotation and angular velocity.
    fn turn(&self, predicted: &mut Predicted, corrected: &Corrected) {
        let motion = &self.motion;
        for row in [ROTATION, ANGULAR] {
            predicted.forget(row);
        }
        let mut angular = predicted.velocity.fixed_rows_mut::<3>(3);
        angular.copy_from(&corrected.rate);

        let transition = &mut predicted.transition;
        let mut of_rotation = transition.fixed_view_mut::<3, 6>(ROTATION, BIASES);
        of_rotation.copy_from(&corrected.by_bias_of(OF_ROTATION));
        let mut of_rate = transition.fixed_view_mut::<3, 3>(ANGULAR, BIASES);
        of_rate.fill_diagonal(-motion.noise.bias[0]);

        let of_noise = motion
            .covariance
            .fixed_view::<3, 3>(OF_ROTATION, OF_ROTATION);
        let mut rotation = predicted.noise.fixed_view_mut::<3, 3>(ROTATION, ROTATION);
        rotation.copy_from(&of_noise);
        let mut rate = predicted.noise.fixed_view_mut::<3, 3>(ANGULAR, ANGULAR);
        rate.fill_diagonal(motion.last_rate_variance);
    }

    /// Replaces translation and linear velocity. With the initial velocity v and gravity g, in the
    /// axes of the start, the camera moves by v t + g t²/2 + position, and ends at the velocity v +
    /// g t + velocity.
    fn accelerate(
        &self,
        predicted: &mut Predicted,
        corrected: &Corrected,
        belief: &Belief,
        down: &Unit<Vector3<f64>>,
    ) {
        let seconds = self.motion.seconds;
        let half_square = 0.5 * seconds * seconds;
        let gravity = belief.pose.rotation.inverse() * down.into_inner() * GRAVITY_M_S2;
        let start = belief.velocity.linear;
        let moved = start * seconds + gravity * half_square + corrected.position;
        predicted.motion = Pose::from_parts(moved.into(), corrected.rotation);
        let turned = corrected.rotation.inverse().to_rotation_matrix();
        let end_from_start: Matrix3<f64> = turned.into_inner();
        let end = end_from_start * (start + gravity * seconds + corrected.velocity);
        predicted.velocity.fixed_rows_mut::<3>(0).copy_from(&end);

        // A tilt of the start turns gravity; an error of the rotation turns the final velocity.
        let by_tilt = end_from_start * gravity.cross_matrix();
        let of_motion = end_from_start * corrected.by_bias_of(OF_POSITION);
        let of_velocity = end_from_start * corrected.by_bias_of(OF_VELOCITY)
            + end.cross_matrix() * corrected.by_bias_of(OF_ROTATION);
        for (row, by_velocity, by_tilt, by_biases) in [
            (TRANSLATION, seconds, by_tilt * half_square, of_motion),
            (LINEAR, 1.0, by_tilt * seconds, of_velocity),
        ] {
            predicted.forget(row);
            let transition = &mut predicted.transition;
            let mut of = transition.fixed_view_mut::<3, 3>(row, VELOCITY);
            of.copy_from(&(end_from_start * by_velocity));
            let mut of = transition.fixed_view_mut::<3, 3>(row, POSE + 3);
            of.copy_from(&by_tilt);
            let mut of = transition.fixed_view_mut::<3, 6>(row, BIASES);
            of.copy_from(&by_biases);
        }

        let mut spread = SMatrix::<f64, 12, 9>::zeros();
        for (row, column, block) in [
            (TRANSLATION, OF_POSITION, end_from_start),
            (ROTATION, OF_ROTATION, Matrix3::identity()),
            (LINEAR, OF_VELOCITY, end_from_start),
            (LINEAR, OF_ROTATION, end.cross_matrix()),
        ] {
            let mut of = spread.fixed_view_mut::<3, 3>(row, column);
            of.copy_from(&block);
        }
        // The noise of the angular velocity stays.
        let rate = predicted
            .noise
            .fixed_view::<3, 3>(ANGULAR, ANGULAR)
            .into_owned();
        predicted.noise = spread * self.motion.covariance * spread.transpose();
        let mut angular = predicted.noise.fixed_view_mut::<3, 3>(ANGULAR, ANGULAR);
        angular.copy_from(&rate);
    }
}

impl Predicted {
    /// Forgets derivatives and noise of three rows.
    fn forget(&mut self, row: usize) {
        let mut of_state = self.transition.fixed_view_mut::<3, STATE>(row, 0);
        of_state.fill(0.0);
        self.noise.fixed_rows_mut::<3>(row).fill(0.0);
        self.noise.fixed_columns_mut::<3>(row).fill(0.0);
    }
}

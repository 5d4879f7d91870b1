//! Motion between two frames from a gyroscope and an accelerometer (preintegration).
//!
//! Source: C. Forster, L. Carlone, F. Dellaert and D. Scaramuzza, "On-Manifold Preintegration for
//! Real-Time Visual–Inertial Odometry", IEEE Transactions on Robotics 33 (2017).

use std::collections::VecDeque;

use nalgebra::{Matrix3, SMatrix, UnitQuaternion, Vector3};

use seese3_core::geometry::Pose;

/// Magnitude of gravity, m/s². Its regional deviation, at most 0.03 m/s², is part of the
/// accelerometer's bias.
pub const GRAVITY_M_S2: f64 = 9.806_65;
/// Longest interval between samples that is integrated over, seconds.
const MAX_INTERVAL_S: f64 = 0.1;
/// Shortest interval between samples from which an angular acceleration is computed, seconds: over
/// a shorter one it would be noise.
const LEAST_INTERVAL_S: f64 = 5e-4;
/// Maximum number of samples that wait for the next frame.
const MAX_SAMPLES: usize = 20_000;

/// Rows of position, rotation and velocity.
const POSITION: usize = 0;
const ROTATION: usize = 3;
const VELOCITY: usize = 6;
/// Columns of the gyroscope and of the accelerometer.
const GYRO: usize = 0;
const ACCEL: usize = 3;

/// A sample, in the axes of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertialSample {
    /// Timestamp, nanoseconds on the clock of the frames.
    pub time_ns: i64,
    /// Angular velocity, rad/s.
    pub angular_rate: Vector3<f64>,
    /// Acceleration minus gravity, m/s²: at rest, 9.8 upwards.
    pub specific_force: Vector3<f64>,
}

/// Noise of an inertial sensor; of the gyroscope and of the accelerometer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertialNoise {
    /// White noise, rad/s/√Hz and m/s²/√Hz.
    pub density: [f64; 2],
    /// Standard deviation of the biases at the beginning of a stream, rad/s and m/s².
    pub bias: [f64; 2],
    /// Random walk of the biases, rad/s²/√Hz and m/s³/√Hz.
    pub bias_walk: [f64; 2],
}

impl InertialNoise {
    /// Noise of the small sensors of robots and telephones, with a margin for vibration.
    pub const TYPICAL: Self = Self {
        density: [1e-3, 2e-2],
        bias: [1e-2, 2e-1],
        bias_walk: [1e-4, 1e-3],
    };
}

/// How a sensor is mounted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertialMount {
    /// Pose of the camera in the axes of the sensor.
    pub sensor_from_camera: Pose,
}

impl InertialMount {
    /// What a sensor at the camera would measure. `last` is the sample before, in the same axes as
    /// `sample`; the angular acceleration follows from both.
    pub fn at_camera(
        &self,
        sample: &InertialSample,
        last: Option<&InertialSample>,
    ) -> InertialSample {
        let rate = sample.angular_rate;
        let known = last.map(|last| (last, seconds_between(last.time_ns, sample.time_ns)));
        let angular_acceleration = known
            .filter(|(_, seconds)| *seconds >= LEAST_INTERVAL_S)
            .map_or_else(Vector3::zeros, |(last, seconds)| {
                (rate - last.angular_rate) / seconds
            });
        let arm = self.sensor_from_camera.translation.vector;
        let of_arm = angular_acceleration.cross(&arm) + rate.cross(&rate.cross(&arm));

        let camera_from_sensor = self.sensor_from_camera.rotation.inverse();
        InertialSample {
            time_ns: sample.time_ns,
            angular_rate: camera_from_sensor * rate,
            specific_force: camera_from_sensor * (sample.specific_force + of_arm),
        }
    }
}

/// The integrated samples between two frames, for biases of zero. With the velocity v and the
/// gravity g at the first frame, in its axes, the camera moves by v t + g t²/2 + `position`, and
/// its velocity changes by g t + `velocity`.
#[derive(Debug, Clone, PartialEq)]
pub struct InertialMotion {
    /// Time between the frames.
    pub seconds: f64,
    /// `first_from_second`.
    pub rotation: UnitQuaternion<f64>,
    /// In the axes of the first frame, m/s.
    pub velocity: Vector3<f64>,
    /// In the axes of the first frame, meters.
    pub position: Vector3<f64>,
    /// Angular velocity at the second frame, in its axes, rad/s.
    pub last_rate: Vector3<f64>,
    /// Variance of each of its components.
    pub last_rate_variance: f64,
    /// Derivatives of (position, rotation, velocity) by the biases of gyroscope and accelerometer.
    /// The rotation's is in the axes of the second frame.
    pub by_bias: SMatrix<f64, 9, 6>,
    /// Covariance of the errors of (position, rotation, velocity) by white noise.
    pub covariance: SMatrix<f64, 9, 9>,
    /// The noise of the sensor.
    pub noise: InertialNoise,
}

impl InertialMotion {
    fn at_rest(noise: InertialNoise) -> Self {
        Self {
            seconds: 0.0,
            rotation: UnitQuaternion::identity(),
            velocity: Vector3::zeros(),
            position: Vector3::zeros(),
            last_rate: Vector3::zeros(),
            last_rate_variance: 0.0,
            by_bias: SMatrix::zeros(),
            covariance: SMatrix::zeros(),
            noise,
        }
    }

    /// Integrates over some seconds with a constant angular rate and specific force.
    fn integrate(&mut self, rate: &Vector3<f64>, force: &Vector3<f64>, seconds: f64) {
        let turn = UnitQuaternion::from_scaled_axis(rate * seconds);
        let halfway = self.rotation * UnitQuaternion::from_scaled_axis(rate * (0.5 * seconds));
        let axes: Matrix3<f64> = halfway.to_rotation_matrix().into_inner();
        let by_turn = -axes * force.cross_matrix();

        let half_square = 0.5 * seconds * seconds;
        let to_end: Matrix3<f64> = turn.inverse().to_rotation_matrix().into_inner();
        let mut transition = SMatrix::<f64, 9, 9>::identity();
        for (row, column, block) in [
            (ROTATION, ROTATION, to_end),
            (VELOCITY, ROTATION, by_turn * seconds),
            (POSITION, ROTATION, by_turn * half_square),
            (POSITION, VELOCITY, Matrix3::identity() * seconds),
        ] {
            let mut to = transition.fixed_view_mut::<3, 3>(row, column);
            to.copy_from(&block);
        }

        // The right Jacobian of the rotation, to first order.
        let by_rate = Matrix3::identity() - (rate * (0.5 * seconds)).cross_matrix();
        let mut by_sample = SMatrix::<f64, 9, 6>::zeros();
        for (row, column, block) in [
            (ROTATION, GYRO, by_rate * seconds),
            (VELOCITY, ACCEL, axes * seconds),
            (POSITION, ACCEL, axes * half_square),
        ] {
            let mut to = by_sample.fixed_view_mut::<3, 3>(row, column);
            to.copy_from(&block);
        }

        self.by_bias = transition * self.by_bias - by_sample;
        let mut noisy = by_sample;
        for (columns, density) in [GYRO, ACCEL].into_iter().zip(self.noise.density) {
            let mut of_sensor = noisy.fixed_columns_mut::<3>(columns);
            of_sensor *= density / seconds.sqrt();
        }
        self.covariance =
            transition * self.covariance * transition.transpose() + noisy * noisy.transpose();

        self.position += self.velocity * seconds + halfway * force * half_square;
        self.velocity += halfway * force * seconds;
        self.rotation *= turn;
        self.seconds += seconds;
    }
}

/// The samples of a stream since its last frame.
#[derive(Debug, Clone, Default)]
pub struct InertialBuffer {
    samples: VecDeque<InertialSample>,
}

impl InertialBuffer {
    /// The newest sample.
    pub fn last(&self) -> Option<&InertialSample> {
        self.samples.back()
    }

    /// Adds a sample. One that is not later than the newest is dropped; of too many that wait, the
    /// oldest.
    pub fn push(&mut self, sample: InertialSample) {
        if self
            .last()
            .is_some_and(|last| last.time_ns >= sample.time_ns)
        {
            return;
        }
        if self.samples.len() >= MAX_SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
    }

    /// Forgets the samples that are not needed for motions from a time on.
    pub fn forget_before(&mut self, time_ns: i64) {
        while self.samples.len() > 1 && self.samples[1].time_ns <= time_ns {
            self.samples.pop_front();
        }
    }

    /// The motion between two frames; `None` where samples are missing for more than 0.1 s.
    pub fn between(
        &self,
        first_ns: i64,
        second_ns: i64,
        noise: InertialNoise,
    ) -> Option<InertialMotion> {
        let mut motion = InertialMotion::at_rest(noise);
        let mut at_ns = first_ns;
        for later in 1..=self.samples.len() {
            // The last sample is held.
            let from = self.samples.get(later - 1)?;
            let to = self.samples.get(later);
            let end_ns = to.map_or(second_ns, |to| to.time_ns.min(second_ns));
            let seconds = seconds_between(at_ns, end_ns);
            if seconds <= 0.0 {
                continue;
            }
            let interval_s = seconds_between(from.time_ns, to.map_or(end_ns, |to| to.time_ns));
            if from.time_ns > at_ns || interval_s > MAX_INTERVAL_S {
                return None;
            }

            let middle_ns = at_ns + (end_ns - at_ns) / 2;
            let [rate, force] = between(from, to.unwrap_or(from), middle_ns);
            motion.integrate(&rate, &force, seconds);
            at_ns = end_ns;
            if at_ns == second_ns {
                [motion.last_rate, _] = between(from, to.unwrap_or(from), second_ns);
                motion.last_rate_variance =
                    noise.density[0].powi(2) / interval_s.max(LEAST_INTERVAL_S);
            }
        }
        (at_ns == second_ns && motion.seconds > 0.0).then_some(motion)
    }
}

fn seconds_between(from_ns: i64, to_ns: i64) -> f64 {
    to_ns.saturating_sub(from_ns) as f64 * 1e-9
}

/// Angular rate and specific force between two samples.
fn between(from: &InertialSample, to: &InertialSample, at_ns: i64) -> [Vector3<f64>; 2] {
    let span_s = seconds_between(from.time_ns, to.time_ns).max(1e-9);
    let share = (seconds_between(from.time_ns, at_ns) / span_s).clamp(0.0, 1.0);
    [
        from.angular_rate.lerp(&to.angular_rate, share),
        from.specific_force.lerp(&to.specific_force, share),
    ]
}

//! A Gaussian on a camera's pose, its velocity, and the correlated errors of its sensors.

use nalgebra::{Cholesky, Matrix6, SMatrix, SVector, Vector6};

use super::{FilterParameters, MeasuredInertia};
use crate::tracking::{Drift, MotionPrior, PoseWithCovariance};
use crate::visual_odometry::VisualMotion;
use seese3_core::geometry::{Pose, Twist, adjoint, exp, log};

pub const STATE: usize = 30;
const JOINT: usize = 36;
/// Number of lasting errors of motions.
const MOTION_ERRORS: usize = 12;
/// Places of the scale of translations of wheel odometry, of its rotations, of its rotations per
/// meter, of the scale of visual odometry, and of the biases of gyroscope and accelerometer.
const WHEEL_SCALE: usize = 0;
const WHEEL_TURN: usize = 1;
const WHEEL_CURVE: usize = 2;
const VISUAL_SCALE: usize = 5;
const INERTIAL_BIASES: usize = 6;
/// Rows of the inertial biases in the state.
pub const BIASES: usize = MOTIONS + INERTIAL_BIASES;
type StateMatrix = SMatrix<f64, STATE, STATE>;
type JointMatrix = SMatrix<f64, JOINT, JOINT>;
type Observed<const N: usize> = SMatrix<f64, N, JOINT>;

/// Factor on the process noise of a prior that tells nothing.
const UNINFORMATIVE: f64 = 1e4;

/// Rows of the blocks of the state.
pub const POSE: usize = 0;
pub const VELOCITY: usize = 6;
const CORRELATED: usize = 12;
const MOTIONS: usize = 18;

/// Rows of the blocks of [`Step`].
const START: usize = 0;
const MOTION: usize = 6;
const END_VELOCITY: usize = 12;
const END_CORRELATED: usize = 18;
const END_MOTIONS: usize = 24;

/// Shortest time of a step, seconds.
const LEAST_SECONDS: f64 = 1e-3;

/// Pose, velocity, the correlated error of located poses, and the errors of measured motions, with
/// the covariance of the errors of all four.
///
/// The pose error δ is in the body frame, true = pose · exp(δ), ordered (v, ω), meters and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    /// `parent_from_camera`.
    pub pose: Pose,
    /// In the camera's body frame, meters and radians per second.
    pub velocity: Twist,
    /// Correlated error of located poses, in standard deviations of each pose.
    pub correlated_error: Vector6<f64>,
    /// Errors of wheel odometry, in standard deviations of its drift: scale of the translations,
    /// scale of the rotations, and rotation about each axis per meter. Then the error of the scale
    /// of visual odometry, and the biases of gyroscope and accelerometer, in their deviations.
    pub motion_errors: SVector<f64, MOTION_ERRORS>,
    /// Of (pose, velocity, correlated error, motion errors); symmetric and positive definite.
    pub covariance: StateMatrix,
}

/// The origin of an odometry frame. Its deviation keeps covariances positive definite.
pub fn origin() -> PoseWithCovariance {
    PoseWithCovariance::known(Pose::identity(), 1e-6, 1e-6)
}

/// The belief over one step of time, while observations are added.
///
/// The error state is (initial pose, motion, final velocity, final correlated error, motion
/// errors). The motion's error is in the final body frame.
pub struct Step {
    /// The initial pose.
    start: Pose,
    /// Expected motion, final velocity and final correlated error, before any observation.
    motion: Pose,
    velocity: Vector6<f64>,
    correlated_error: Vector6<f64>,
    motion_errors: SVector<f64, MOTION_ERRORS>,
    covariance: JointMatrix,
}

/// The motion and the final velocity that a belief predicts. Their errors are ordered (motion,
/// velocity), each (v, ω).
pub struct Predicted {
    /// `start_from_end`.
    pub motion: Pose,
    pub velocity: Vector6<f64>,
    /// Derivatives of their errors by that of the state.
    pub transition: SMatrix<f64, 12, STATE>,
    /// Covariance of their errors for a known state.
    pub noise: SMatrix<f64, 12, 12>,
}

/// A linear observation of the error state.
pub struct Observation<const N: usize> {
    pub residual: SVector<f64, N>,
    /// Derivative of the residual with respect to the error state.
    pub derivative: Observed<N>,
    /// Covariance of its independent noise.
    pub noise: SMatrix<f64, N, N>,
}

impl Belief {
    /// A state with a known pose and unknown velocity: zero, with the covariance of the prior.
    ///
    /// `correlated_share` is the share of the pose's variance that is the correlated error of
    /// located poses; 0 for a pose from another source.
    pub fn at(place: &PoseWithCovariance, prior: &MotionPrior, correlated_share: f64) -> Self {
        let mut covariance = StateMatrix::zeros();
        let mut block = |row: usize, column: usize, of: &Matrix6<f64>| {
            covariance.fixed_view_mut::<6, 6>(row, column).copy_from(of);
        };

        let scale = correlated_scale(place, correlated_share);
        block(POSE, POSE, &place.covariance);
        block(POSE, CORRELATED, &scale);
        block(CORRELATED, POSE, &scale.transpose());
        block(VELOCITY, VELOCITY, &prior.velocity_covariance());
        block(CORRELATED, CORRELATED, &Matrix6::identity());
        covariance
            .fixed_view_mut::<MOTION_ERRORS, MOTION_ERRORS>(MOTIONS, MOTIONS)
            .fill_with_identity();

        Self {
            pose: place.pose,
            velocity: Twist::default(),
            correlated_error: Vector6::zeros(),
            motion_errors: SVector::zeros(),
            covariance,
        }
    }

    /// A state at the origin of an odometry frame.
    pub fn at_origin(prior: &MotionPrior) -> Self {
        Self::at(&origin(), prior, 0.0)
    }

    /// The pose with its covariance.
    pub fn place(&self) -> PoseWithCovariance {
        PoseWithCovariance {
            pose: self.pose,
            covariance: self.covariance.fixed_view::<6, 6>(POSE, POSE).into_owned(),
        }
    }

    /// The state with another velocity, independent of all other errors.
    #[must_use]
    pub fn with_velocity(mut self, velocity: Twist, covariance: &Matrix6<f64>) -> Self {
        self.velocity = velocity;
        self.covariance.fixed_rows_mut::<6>(VELOCITY).fill(0.0);
        self.covariance.fixed_columns_mut::<6>(VELOCITY).fill(0.0);
        self.covariance
            .fixed_view_mut::<6, 6>(VELOCITY, VELOCITY)
            .copy_from(covariance);
        self
    }

    /// The state with the errors of motion sensors of another one, independent of all other errors:
    /// they belong to the sensors, not to the place.
    #[must_use]
    pub fn with_sensors_of(mut self, other: Option<&Self>) -> Self {
        let Some(other) = other else {
            return self;
        };
        self.motion_errors = other.motion_errors;
        let of_other = other
            .covariance
            .fixed_view::<MOTION_ERRORS, MOTION_ERRORS>(MOTIONS, MOTIONS);
        let mut covariance = self.covariance;
        covariance
            .fixed_rows_mut::<MOTION_ERRORS>(MOTIONS)
            .fill(0.0);
        covariance
            .fixed_columns_mut::<MOTION_ERRORS>(MOTIONS)
            .fill(0.0);
        covariance
            .fixed_view_mut::<MOTION_ERRORS, MOTION_ERRORS>(MOTIONS, MOTIONS)
            .copy_from(&of_other);
        self.covariance = covariance;
        self
    }

    /// Biases of gyroscope and accelerometer, in their standard deviations.
    pub fn inertial_biases(&self) -> Vector6<f64> {
        self.motion_errors.fixed_rows::<6>(INERTIAL_BIASES).into()
    }

    /// Covariance of the velocity.
    pub fn velocity_covariance(&self) -> Matrix6<f64> {
        self.covariance
            .fixed_view::<6, 6>(VELOCITY, VELOCITY)
            .into_owned()
    }

    /// Predicts the state some seconds later.
    ///
    /// The velocity is the Ornstein–Uhlenbeck process of `prior`. The correlated error decays over
    /// the motion that the velocity predicts, by the correlation range of the parameters.
    pub fn step(
        &self,
        prior: &MotionPrior,
        seconds: f64,
        inertia: Option<&MeasuredInertia>,
        parameters: &FilterParameters,
    ) -> Step {
        let predicted = self.by_prior(prior, seconds, parameters.process_noise_factor);
        self.step_by(predicted, seconds, inertia, parameters)
    }

    /// As [`Belief::step`], but the prior tells nothing about the motion, which sensors measure:
    /// its mean of zero would shorten it.
    pub fn measured_step(
        &self,
        prior: &MotionPrior,
        seconds: f64,
        inertia: Option<&MeasuredInertia>,
        parameters: &FilterParameters,
    ) -> Step {
        let predicted = self.by_prior(prior, seconds, UNINFORMATIVE);
        self.step_by(predicted, seconds, inertia, parameters)
    }

    /// The motion by the prior; `noise_factor` is on its process noise.
    fn by_prior(&self, prior: &MotionPrior, seconds: f64, noise_factor: f64) -> Predicted {
        let drift = prior.over(&self.velocity, seconds);
        let mut transition = SMatrix::zeros();
        for axis in 0..6 {
            let part = axis / 3;
            transition[(axis, VELOCITY + axis)] = drift.reach_s[part];
            transition[(6 + axis, VELOCITY + axis)] = drift.left[part];
        }
        Predicted {
            motion: exp(&drift.motion),
            velocity: drift.velocity.to_vector(),
            transition,
            noise: drift.noise * noise_factor,
        }
    }

    fn step_by(
        &self,
        by_prior: Predicted,
        seconds: f64,
        inertia: Option<&MeasuredInertia>,
        parameters: &FilterParameters,
    ) -> Step {
        let predicted = match inertia {
            Some(measured) => measured.in_place_of(by_prior, self),
            None => by_prior,
        };
        let expected = log(&predicted.motion);
        let ranges =
            (expected.linear.norm() + expected.angular.norm()) / parameters.correlation_range;
        let decay = (-ranges).exp();

        // The errors of wheels last; the scale of visual odometry changes with the scene.
        let visual_decay = (-seconds / parameters.visual_scale_time_s).exp();
        let mut motion_errors = self.motion_errors;
        motion_errors[VISUAL_SCALE] *= visual_decay;

        // Every row but those of the motion is one of the state, times a factor.
        let poses = (0..6).map(|axis| (START + axis, POSE + axis, 1.0));
        let correlated = (0..6).map(|axis| (END_CORRELATED + axis, CORRELATED + axis, decay));
        let errors = (0..MOTION_ERRORS).map(|error| {
            let factor = if error == VISUAL_SCALE {
                visual_decay
            } else {
                1.0
            };
            (END_MOTIONS + error, MOTIONS + error, factor)
        });
        let kept: Vec<(usize, usize, f64)> = poses.chain(correlated).chain(errors).collect();

        let of_state = predicted.transition * self.covariance;
        let of_motion = of_state * predicted.transition.transpose() + predicted.noise;
        let mut covariance = JointMatrix::zeros();
        let mut block = covariance.fixed_view_mut::<12, 12>(MOTION, MOTION);
        block.copy_from(&of_motion);
        for &(to, from, factor) in &kept {
            for row in 0..12 {
                let value = of_state[(row, from)] * factor;
                covariance[(MOTION + row, to)] = value;
                covariance[(to, MOTION + row)] = value;
            }
            for &(other_to, other_from, other_factor) in &kept {
                covariance[(to, other_to)] =
                    self.covariance[(from, other_from)] * factor * other_factor;
            }
        }
        for axis in END_CORRELATED..END_MOTIONS {
            covariance[(axis, axis)] += 1.0 - decay * decay;
        }
        let visual_scale = END_MOTIONS + VISUAL_SCALE;
        covariance[(visual_scale, visual_scale)] += 1.0 - visual_decay * visual_decay;
        if let Some(measured) = inertia {
            let noise = &measured.motion.noise;
            for bias in 0..6 {
                let at = END_MOTIONS + INERTIAL_BIASES + bias;
                let walk = noise.bias_walk[bias / 3] / noise.bias[bias / 3];
                covariance[(at, at)] += walk * walk * seconds;
            }
        }

        Step {
            start: self.pose,
            motion: predicted.motion,
            velocity: predicted.velocity,
            correlated_error: self.correlated_error * decay,
            motion_errors,
            covariance,
        }
    }
}

/// Covariance of the independent errors of a motion by visual odometry.
fn visual_noise(
    visual: &VisualMotion,
    seconds: f64,
    parameters: &FilterParameters,
) -> Matrix6<f64> {
    let twist = log(&visual.motion);
    // Wrong depths turn the translation, too, for about as long as they are in view.
    let steps = (parameters.visual_depth_time_s / seconds.max(LEAST_SECONDS)).max(1.0);
    let of_depths = (twist.linear.norm() * visual.scale_deviation).powi(2) * steps;
    let mut of_translation = Matrix6::zeros();
    of_translation
        .fixed_view_mut::<3, 3>(0, 0)
        .fill_diagonal(of_depths);
    let of_matches = visual.pose_covariance * parameters.visual_design_effect;
    parameters.visual_noise.over(&twist) + of_matches + of_translation
}

impl Step {
    /// The observation of a located pose.
    ///
    /// Its error is L (√ρ · correlated error + √(1 − ρ) · noise), with covariance L Lᵀ and share ρ.
    pub fn located(&self, located: &PoseWithCovariance, correlated_share: f64) -> Observation<6> {
        let scale = correlated_scale(located, correlated_share);
        let mut derivative = self.end_derivative();
        derivative
            .fixed_view_mut::<6, 6>(0, END_CORRELATED)
            .copy_from(&-scale);

        let difference = log(&self.end_pose().inv_mul(&located.pose)).to_vector();
        Observation {
            residual: difference + scale * self.correlated_error,
            derivative,
            noise: located.covariance * (1.0 - correlated_share),
        }
    }

    /// The observation of the motion by wheel odometry, `start_from_end`.
    ///
    /// The drift is a scale error of translations, a scale error of rotations, and a rotation per
    /// meter forward, as those of a wrong wheel radius, a wrong track width and unequal wheels. The
    /// optical axis points forward.
    pub fn by_wheels(&self, motion: &Pose, drift: &Drift, noise: &Matrix6<f64>) -> Observation<6> {
        let Twist { linear, angular } = log(motion);
        let mut errors = SMatrix::<f64, 6, MOTION_ERRORS>::zeros();
        errors
            .fixed_view_mut::<3, 1>(0, WHEEL_SCALE)
            .copy_from(&(linear * drift.translation_share));
        errors
            .fixed_view_mut::<3, 1>(3, WHEEL_TURN)
            .copy_from(&(angular * drift.rotation_share));
        errors
            .fixed_view_mut::<3, 3>(3, WHEEL_CURVE)
            .fill_diagonal(drift.rotation_share * linear.norm() * linear.z.signum());
        self.by_motion(motion, &errors, noise)
    }

    /// The observation of the motion by visual odometry.
    pub fn by_images(
        &self,
        visual: &VisualMotion,
        seconds: f64,
        parameters: &FilterParameters,
    ) -> Observation<6> {
        let mut errors = SMatrix::<f64, 6, MOTION_ERRORS>::zeros();
        errors
            .fixed_view_mut::<3, 1>(0, VISUAL_SCALE)
            .copy_from(&(log(&visual.motion).linear * visual.scale_deviation));
        let noise = visual_noise(visual, seconds, parameters);
        self.by_motion(&visual.motion, &errors, &noise)
    }

    /// The observation of a motion, with the derivatives of its twist by the lasting errors.
    fn by_motion(
        &self,
        motion: &Pose,
        errors: &SMatrix<f64, 6, MOTION_ERRORS>,
        noise: &Matrix6<f64>,
    ) -> Observation<6> {
        let mut derivative = Observed::zeros();
        derivative
            .fixed_view_mut::<6, 6>(0, MOTION)
            .fill_with_identity();
        derivative
            .fixed_view_mut::<6, MOTION_ERRORS>(0, END_MOTIONS)
            .copy_from(errors);

        let difference = log(&self.motion.inv_mul(motion)).to_vector();
        Observation {
            residual: difference - errors * self.motion_errors,
            derivative,
            noise: *noise,
        }
    }

    /// Takes the velocity of another step, independent of the errors of this one.
    pub fn take_velocity(&mut self, other: &Self) {
        self.velocity = other.velocity;
        self.covariance.fixed_rows_mut::<6>(END_VELOCITY).fill(0.0);
        self.covariance
            .fixed_columns_mut::<6>(END_VELOCITY)
            .fill(0.0);
        let theirs = other
            .covariance
            .fixed_view::<6, 6>(END_VELOCITY, END_VELOCITY);
        self.covariance
            .fixed_view_mut::<6, 6>(END_VELOCITY, END_VELOCITY)
            .copy_from(&theirs);
    }

    /// Squared Mahalanobis length of the innovation: χ² with six degrees of freedom if all
    /// covariances are correct. Infinite if the sum of the covariances is not positive definite.
    pub fn squared_innovation<const N: usize>(&self, observed: &Observation<N>) -> f64 {
        let innovation = observed.residual;
        let sum = Cholesky::new(self.state_covariance(observed) + observed.noise);
        sum.map_or(f64::INFINITY, |sum| innovation.dot(&sum.solve(&innovation)))
    }

    /// Kalman update; `factor` is on the covariance of the observation's noise. The observation is
    /// one of the current state. Nothing changes if the sum of the covariances is not positive
    /// definite.
    pub fn update<const N: usize>(&mut self, observed: &Observation<N>, factor: f64) {
        let noise = observed.noise * factor;
        let Some(sum) = Cholesky::new(self.state_covariance(observed) + noise) else {
            return;
        };
        let gain = self.covariance * observed.derivative.transpose() * sum.inverse();
        let change = gain * observed.residual;
        let part = |at: usize| change.fixed_rows::<6>(at).into_owned();
        self.start *= exp(&Twist::from_vector(&part(START)));
        self.motion *= exp(&Twist::from_vector(&part(MOTION)));
        self.velocity += part(END_VELOCITY);
        self.correlated_error += part(END_CORRELATED);
        self.motion_errors += change.fixed_rows::<MOTION_ERRORS>(END_MOTIONS);

        // Joseph's form: (I − K H) P (I − K H)ᵀ + K R Kᵀ.
        let rest = self.covariance - gain * (observed.derivative * self.covariance);
        let of_state = rest - (rest * observed.derivative.transpose()) * gain.transpose();
        self.covariance = of_state + gain * noise * gain.transpose();
    }

    /// The motion of the step, `start_from_end`. Correlated errors of located poses cancel in it.
    pub fn motion(&self) -> PoseWithCovariance {
        let covariance = self.covariance.fixed_view::<6, 6>(MOTION, MOTION);
        PoseWithCovariance {
            pose: self.motion,
            covariance: covariance.into_owned(),
        }
    }

    /// The state after the step.
    pub fn end(&self) -> Belief {
        // The final pose error is the initial one in the new body frame, plus the motion's. The
        // other rows stay as they are.
        const OTHERS: usize = STATE - VELOCITY;
        let end_from_start = adjoint(&self.motion.inverse());
        let joint = &self.covariance;
        let of_pose = end_from_start * joint.fixed_rows::<6>(START) + joint.fixed_rows::<6>(MOTION);
        let pose = of_pose.fixed_columns::<6>(START) * end_from_start.transpose()
            + of_pose.fixed_columns::<6>(MOTION);
        let cross = of_pose.fixed_columns::<OTHERS>(END_VELOCITY);

        let mut covariance = StateMatrix::zeros();
        let mut block = covariance.fixed_view_mut::<6, 6>(POSE, POSE);
        block.copy_from(&pose);
        let mut block = covariance.fixed_view_mut::<6, OTHERS>(POSE, VELOCITY);
        block.copy_from(&cross);
        let mut block = covariance.fixed_view_mut::<OTHERS, 6>(VELOCITY, POSE);
        block.copy_from(&cross.transpose());
        let others = joint.fixed_view::<OTHERS, OTHERS>(END_VELOCITY, END_VELOCITY);
        let mut block = covariance.fixed_view_mut::<OTHERS, OTHERS>(VELOCITY, VELOCITY);
        block.copy_from(&others);

        Belief {
            pose: self.start * self.motion,
            velocity: Twist::from_vector(&self.velocity),
            correlated_error: self.correlated_error,
            motion_errors: self.motion_errors,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }

    /// The final pose.
    pub fn end_pose(&self) -> Pose {
        self.start * self.motion
    }

    /// Derivative of the final pose error with respect to the error state.
    pub fn end_derivative(&self) -> Observed<6> {
        let mut derivative = Observed::zeros();
        derivative
            .fixed_view_mut::<6, 6>(0, START)
            .copy_from(&adjoint(&self.motion.inverse()));
        derivative
            .fixed_view_mut::<6, 6>(0, MOTION)
            .fill_with_identity();
        derivative
    }

    /// Covariance of the residual without its noise.
    fn state_covariance<const N: usize>(&self, observed: &Observation<N>) -> SMatrix<f64, N, N> {
        observed.derivative * self.covariance * observed.derivative.transpose()
    }
}

/// √ρ L, with L Lᵀ the covariance of a located pose; zero if that is not positive definite.
fn correlated_scale(located: &PoseWithCovariance, correlated_share: f64) -> Matrix6<f64> {
    let root = Cholesky::new(located.covariance).map_or_else(Matrix6::zeros, |root| root.unpack());
    root * correlated_share.sqrt()
}

//! A Gaussian on a camera's pose, its velocity, and the correlated errors of its sensors.

use nalgebra::{Cholesky, Matrix6, SMatrix, SVector, Vector6};

use super::FilterParameters;
use crate::tracking::{Drift, MotionPrior, PoseWithCovariance};
use seese3_core::geometry::{Pose, Twist, adjoint, exp, left_jacobian_inverse, log};

const STATE: usize = 23;
const JOINT: usize = 29;
/// Number of wheel errors.
const WHEEL_ERRORS: usize = 5;
type StateMatrix = SMatrix<f64, STATE, STATE>;
type JointMatrix = SMatrix<f64, JOINT, JOINT>;
type Observed = SMatrix<f64, 6, JOINT>;

/// Independent noise of a motion by wheel odometry: standard deviations per axis at rest, and over 1 m.
const DRIVEN_FLOOR_M: f64 = 5e-4;
const DRIVEN_FLOOR_RAD: f64 = 5e-4;
const DRIVEN_NOISE_M: f64 = 1e-2;
const DRIVEN_NOISE_RAD: f64 = 5e-3;

/// Rows of the blocks of the state.
const POSE: usize = 0;
const VELOCITY: usize = 6;
const CORRELATED: usize = 12;
const WHEELS: usize = 18;

/// Rows of the blocks of [`Step`].
const START: usize = 0;
const MOTION: usize = 6;
const END_VELOCITY: usize = 12;
const END_CORRELATED: usize = 18;
const END_WHEELS: usize = 24;

/// Pose, velocity, and the correlated errors of located poses and of wheel odometry, with the covariance
/// of the errors of all four.
///
/// The pose error δ is in the body frame, true = pose · exp(δ), ordered (v, ω), in meters and
/// radians.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Belief {
    /// `parent_from_camera`.
    pub pose: Pose,
    /// In the camera's body frame, meters and radians per second.
    pub velocity: Twist,
    /// Lasting error of located poses, in standard deviations of each pose.
    pub correlated_error: Vector6<f64>,
    /// Errors of wheel odometry, in standard deviations of its drift: scale of the translations, scale
    /// of the rotations, and rotation about each axis per meter.
    pub wheels: SVector<f64, WHEEL_ERRORS>,
    /// Of (pose, velocity, correlated error, wheel error); symmetric and positive definite.
    #[cfg_attr(
        feature = "serde",
        serde(with = "seese3_core::matrices::upper_triangle")
    )]
    pub covariance: StateMatrix,
}

/// The origin of an odometry frame. Its deviation keeps covariances positive definite.
pub fn origin() -> PoseWithCovariance {
    PoseWithCovariance::known(Pose::identity(), 1e-6, 1e-6)
}

/// The belief over one step of time, while observations are added.
///
/// The error state is (initial pose, motion, final velocity, final correlated error, wheel error). The
/// motion's error is in the final body frame.
pub struct Step {
    /// The initial pose.
    start: Pose,
    /// Expected motion, final velocity and final correlated error, before any observation.
    motion: Pose,
    velocity: Vector6<f64>,
    correlated_error: Vector6<f64>,
    wheels: SVector<f64, WHEEL_ERRORS>,
    covariance: JointMatrix,
}

/// A linear observation of the error state.
pub struct Observation {
    residual: Vector6<f64>,
    /// Derivative of the residual with respect to the error state.
    derivative: Observed,
    noise: Matrix6<f64>,
}

impl Belief {
    /// A state with a known pose and unknown velocity: zero, with the covariance of the prior.
    ///
    /// `correlated_share` is the share of the pose's variance that is the correlated error of located
    /// poses; 0 for a pose from another source.
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
            .fixed_view_mut::<WHEEL_ERRORS, WHEEL_ERRORS>(WHEELS, WHEELS)
            .fill_with_identity();

        Self {
            pose: place.pose,
            velocity: Twist::default(),
            correlated_error: Vector6::zeros(),
            wheels: SVector::zeros(),
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

    /// Predicts the state some seconds later.
    ///
    /// The velocity is the Ornstein–Uhlenbeck process of `prior`, the correlated error one with the
    /// correlation time of the parameters.
    pub fn step(&self, prior: &MotionPrior, seconds: f64, parameters: &FilterParameters) -> Step {
        let drift = prior.over(&self.velocity, seconds);
        let decay = (-seconds / parameters.correlation_time_s).exp();

        let mut transition = SMatrix::<f64, JOINT, STATE>::zeros();
        for axis in 0..6 {
            let part = axis / 3;
            transition[(START + axis, POSE + axis)] = 1.0;
            transition[(MOTION + axis, VELOCITY + axis)] = drift.reach_s[part];
            transition[(END_VELOCITY + axis, VELOCITY + axis)] = drift.left[part];
            transition[(END_CORRELATED + axis, CORRELATED + axis)] = decay;
        }
        for error in 0..WHEEL_ERRORS {
            transition[(END_WHEELS + error, WHEELS + error)] = 1.0;
        }

        let mut covariance = transition * self.covariance * transition.transpose();
        let mut of_drift = covariance.fixed_view_mut::<12, 12>(MOTION, MOTION);
        of_drift += drift.noise * parameters.process_noise_factor;
        for axis in END_CORRELATED..END_WHEELS {
            covariance[(axis, axis)] += 1.0 - decay * decay;
        }

        Step {
            start: self.pose,
            motion: exp(&drift.motion),
            velocity: drift.velocity.to_vector(),
            correlated_error: self.correlated_error * decay,
            wheels: self.wheels,
            covariance,
        }
    }
}

impl Step {
    /// The observation of a located pose.
    ///
    /// Its error is L (√ρ · correlated error + √(1 − ρ) · noise) with L Lᵀ its covariance and the
    /// correlated share ρ.
    pub fn located(
        &self,
        located: &PoseWithCovariance,
        parameters: &FilterParameters,
    ) -> Observation {
        let scale = correlated_scale(located, parameters.correlated_share);
        let mut derivative = Observed::zeros();
        let mut block = |column: usize, of: &Matrix6<f64>| {
            derivative.fixed_view_mut::<6, 6>(0, column).copy_from(of);
        };
        block(START, &adjoint(&self.motion.inverse()));
        block(MOTION, &Matrix6::identity());
        block(END_CORRELATED, &-scale);

        let expected = self.start * self.motion;
        let difference = log(&expected.inv_mul(&located.pose)).to_vector();
        Observation {
            residual: difference + scale * self.correlated_error,
            derivative,
            noise: located.covariance * (1.0 - parameters.correlated_share),
        }
    }

    /// The observation of the motion by wheel odometry, `start_from_end`.
    ///
    /// The drift is a scale error of translations, a scale error of rotations, and a rotation per meter
    /// forward, as those of a wrong wheel radius, a wrong track width and unequal wheels. The optical
    /// axis points forward.
    pub fn by_wheels(&self, motion: &Pose, drift: &Drift) -> Observation {
        let Twist { linear, angular } = log(motion);
        let distance_m = linear.norm();
        let mut of_wheels = SMatrix::<f64, 6, WHEEL_ERRORS>::zeros();
        of_wheels
            .fixed_view_mut::<3, 1>(0, 0)
            .copy_from(&(linear * drift.translation_share));
        of_wheels
            .fixed_view_mut::<3, 1>(3, 1)
            .copy_from(&(angular * drift.rotation_share));
        of_wheels
            .fixed_view_mut::<3, 3>(3, 2)
            .fill_diagonal(drift.rotation_share * distance_m * linear.z.signum());

        let mut derivative = Observed::zeros();
        derivative
            .fixed_view_mut::<6, 6>(0, MOTION)
            .fill_with_identity();
        derivative
            .fixed_view_mut::<6, WHEEL_ERRORS>(0, END_WHEELS)
            .copy_from(&of_wheels);

        let v = DRIVEN_FLOOR_M.powi(2) + DRIVEN_NOISE_M.powi(2) * distance_m;
        let w = DRIVEN_FLOOR_RAD.powi(2) + DRIVEN_NOISE_RAD.powi(2) * distance_m;
        let noise = Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w));
        Observation {
            residual: log(&self.motion.inv_mul(motion)).to_vector() - of_wheels * self.wheels,
            derivative,
            noise,
        }
    }

    /// Squared Mahalanobis length of the innovation: χ² with six degrees of freedom if all
    /// covariances are correct. Infinite if the sum of the covariances is not positive definite.
    pub fn squared_innovation(&self, observed: &Observation) -> f64 {
        let innovation = observed.residual;
        let sum = Cholesky::new(self.innovation_covariance(observed));
        sum.map_or(f64::INFINITY, |sum| innovation.dot(&sum.solve(&innovation)))
    }

    /// Kalman update; `factor` is on the covariance of the observation's noise. The observation is one
    /// of the current state. Nothing changes if the sum of the covariances is not positive definite.
    pub fn update(&mut self, observed: &Observation, factor: f64) {
        let observed = Observation {
            noise: observed.noise * factor,
            ..*observed
        };
        let Some(sum) = Cholesky::new(self.innovation_covariance(&observed)) else {
            return;
        };
        let gain = self.covariance * observed.derivative.transpose() * sum.inverse();
        let change = gain * observed.residual;
        let part = |at: usize| change.fixed_rows::<6>(at).into_owned();
        self.start *= exp(&Twist::from_vector(&part(START)));
        self.motion *= exp(&Twist::from_vector(&part(MOTION)));
        self.velocity += part(END_VELOCITY);
        self.correlated_error += part(END_CORRELATED);
        self.wheels += change.fixed_rows::<WHEEL_ERRORS>(END_WHEELS);

        // Joseph's form: (I − K H) P (I − K H)ᵀ + K R Kᵀ.
        let rest = JointMatrix::identity() - gain * observed.derivative;
        self.covariance =
            rest * self.covariance * rest.transpose() + gain * observed.noise * gain.transpose();
    }

    /// The motion of the step, `start_from_end`. Time-correlated errors of located poses cancel in it.
    pub fn motion(&self) -> PoseWithCovariance {
        let covariance = self.covariance.fixed_view::<6, 6>(MOTION, MOTION);
        PoseWithCovariance {
            pose: self.motion,
            covariance: covariance.into_owned(),
        }
    }

    /// The state after the step.
    pub fn end(&self) -> Belief {
        // The final pose error is the initial one in the new body frame, plus the motion's.
        let mut merged = SMatrix::<f64, STATE, JOINT>::zeros();
        merged
            .fixed_view_mut::<6, 6>(POSE, START)
            .copy_from(&adjoint(&self.motion.inverse()));
        for axis in 0..6 {
            merged[(POSE + axis, MOTION + axis)] = 1.0;
            merged[(VELOCITY + axis, END_VELOCITY + axis)] = 1.0;
            merged[(CORRELATED + axis, END_CORRELATED + axis)] = 1.0;
        }
        for error in 0..WHEEL_ERRORS {
            merged[(WHEELS + error, END_WHEELS + error)] = 1.0;
        }
        let covariance = merged * self.covariance * merged.transpose();

        Belief {
            pose: self.start * self.motion,
            velocity: Twist::from_vector(&self.velocity),
            correlated_error: self.correlated_error,
            wheels: self.wheels,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }

    fn innovation_covariance(&self, observed: &Observation) -> Matrix6<f64> {
        let of_state = observed.derivative * self.covariance * observed.derivative.transpose();
        of_state + observed.noise
    }
}

/// Covariance of the error of the twist ξ of a motion, exp(ξ): J_r⁻¹(ξ) Σ J_r⁻ᵀ(ξ).
pub fn twist_covariance(motion: &PoseWithCovariance) -> Matrix6<f64> {
    let inverse = left_jacobian_inverse(&log(&motion.pose).reversed());
    let covariance = inverse * motion.covariance * inverse.transpose();
    (covariance + covariance.transpose()) * 0.5
}

/// √ρ L, with L Lᵀ the covariance of a located pose; zero if that is not positive definite.
fn correlated_scale(located: &PoseWithCovariance, correlated_share: f64) -> Matrix6<f64> {
    let root = Cholesky::new(located.covariance).map_or_else(Matrix6::zeros, |root| root.unpack());
    root * correlated_share.sqrt()
}

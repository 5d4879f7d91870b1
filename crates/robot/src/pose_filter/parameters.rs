//! Parameters of a filter.

use nalgebra::{Matrix6, Vector6};

use seese3_core::geometry::{Pose, Twist, log};

/// Parameters of a filter. In a file, the settings of one stream are left out: `trust_wheels`, the
/// two of keyframes, and `fuse`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(default, deny_unknown_fields)
)]
pub struct FilterParameters {
    /// Share of the variance of a located pose that is correlated from view to view, 0 to 1. It is
    /// the error of the map in view: a camera at rest does not average it out.
    pub correlated_share: f64,
    /// Motion, meters plus radians, over which the correlated part decays by a factor e.
    pub correlation_range: f64,
    /// Number of consecutive located poses that must agree to start the tracking, or to replace a
    /// pose that they contradict: by matched keypoints, and by the most similar mapped frames.
    pub views_to_agree: [u32; 2],
    /// Factor on the process noise of the motion prior: people turn and stop abruptly.
    pub process_noise_factor: f64,
    /// Squared Mahalanobis length of an innovation above which a located pose counts less: its
    /// covariance is multiplied by the square of (squared length / gate).
    pub gate: f64,
    /// Squared Mahalanobis length of an innovation above which a located pose is not used.
    pub outlier_gate: f64,
    /// Maximum time between two poses that agree, seconds. After a longer gap, an uncertain belief
    /// needs `views_to_agree` poses again.
    pub max_candidate_s: f64,
    /// Correlation time of measured gravity, seconds. Most of its errors are accelerations.
    pub gravity_correlation_s: f64,
    /// Largest standard deviations of the position along any direction, meters, and of the rotation
    /// about any axis, radians, while TRACKING.
    pub max_deviation: [f64; 2],
    /// Independent noise of wheel odometry.
    pub wheel_noise: MotionNoise,
    /// Independent noise of visual odometry.
    pub visual_noise: MotionNoise,
    /// Factor on the stated covariance of visual odometry, which takes its matches as independent.
    pub visual_design_effect: f64,
    /// Time for which wrong depths turn the translation of visual odometry the same way, seconds.
    /// Their relative deviation is that of the scale.
    pub visual_depth_time_s: f64,
    /// Correlation time of the error of the scale of visual odometry, seconds.
    pub visual_scale_time_s: f64,
    /// Whether wheel odometry is trusted: it is not left out where other sensors contradict it, and
    /// located views do not replace a pose that it carries.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub trust_wheels: bool,
    /// Times over which the differences of two sensors are summed, seconds, the shorter one first.
    /// The longer one detects a frozen picture while the wheels move slowly.
    pub disagreement_times_s: [f64; 2],
    /// Largest speed of a measured motion, meters per second and radians per second. A faster one
    /// is a restart of the sensor.
    pub max_speed: f64,
    /// Number of repetitions of an image after which a stream is DEGRADED.
    pub max_unchanged_frames: u32,
    /// Interval of keyframes, in frames; at least 1.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub keyframe_frames: u32,
    /// Motion since the keyframe that triggers a new one, ‖(v, ω)‖, meters and radians mixed.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub keyframe_displacement: f64,
    /// Whether located poses are used.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub fuse: bool,
}

impl Default for FilterParameters {
    fn default() -> Self {
        Self {
            correlated_share: 0.7,
            correlation_range: 0.15,
            views_to_agree: [2, 10],
            process_noise_factor: 4.0,
            // The 99 % quantile of χ² with six degrees of freedom, and four times that.
            gate: 16.81,
            outlier_gate: 67.24,
            max_candidate_s: 5.0,
            gravity_correlation_s: 2.0,
            // Errors of 0.2 m and 10° are 2.6 standard deviations: rarer than 1 in 100.
            max_deviation: [0.077, 0.067],
            wheel_noise: MotionNoise::WHEELS,
            visual_noise: MotionNoise::IMAGES,
            visual_design_effect: 10.0,
            visual_depth_time_s: 1.0,
            visual_scale_time_s: 10.0,
            trust_wheels: false,
            disagreement_times_s: [1.0, 20.0],
            max_speed: 10.0,
            max_unchanged_frames: 5,
            keyframe_frames: 30,
            keyframe_displacement: f64::INFINITY,
            fuse: true,
        }
    }
}

/// Independent noise of measured motions: standard deviations per axis. Variances grow in
/// proportion to the distance and the angle.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MotionNoise {
    /// At rest, meters and radians.
    pub at_rest: f64,
    /// Over a distance of 1 m, meters, and over an angle of 1 rad, radians.
    pub over_motion: f64,
    /// Of the rotation, over a distance of 1 m, radians.
    pub rotation_over_meter: f64,
}

impl MotionNoise {
    /// Noise of wheel odometry, besides its drift.
    pub const WHEELS: Self = Self {
        at_rest: 5e-4,
        over_motion: 1e-2,
        rotation_over_meter: 5e-3,
    };

    /// Noise of visual odometry, besides the error of its scale.
    pub const IMAGES: Self = Self {
        at_rest: 1e-3,
        over_motion: 5e-2,
        rotation_over_meter: 2e-2,
    };

    /// Covariance over a motion, ordered (v, ω).
    pub fn over(&self, motion: &Twist) -> Matrix6<f64> {
        let distance_m = motion.linear.norm();
        let angle_rad = motion.angular.norm();
        let [rest, over_motion, rotation_over_meter] =
            [self.at_rest, self.over_motion, self.rotation_over_meter].map(|d| d.powi(2));

        let v = rest + over_motion * distance_m;
        let w = rest + over_motion * angle_rad + rotation_over_meter * distance_m;
        Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w))
    }
}

/// A parameter that no filter can have.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field} must be {expected}, but is {value}")]
pub struct ParameterError {
    /// The field, named as in [`FilterParameters`].
    pub field: &'static str,
    /// Its range.
    pub expected: &'static str,
    /// Its value.
    pub value: f64,
}

impl FilterParameters {
    /// Whether a robot may move so far in some seconds.
    pub(super) fn is_possible(&self, motion: &Pose, seconds: f64) -> bool {
        let Twist { linear, angular } = log(motion);
        let most = self.max_speed * seconds;
        linear.norm() <= most && angular.norm() <= most
    }

    /// The parameters with the default settings of a stream, as in a file.
    #[must_use]
    pub fn without_settings(self) -> Self {
        let default = Self::default();
        Self {
            trust_wheels: default.trust_wheels,
            keyframe_frames: default.keyframe_frames,
            keyframe_displacement: default.keyframe_displacement,
            fuse: default.fuse,
            ..self
        }
    }

    /// Checks that covariances computed with these parameters are positive definite.
    ///
    /// # Errors
    /// [`ParameterError`] for the first parameter out of range.
    pub fn check(&self) -> Result<(), ParameterError> {
        let share = ("0 to 0.999", 0.0..=0.999);
        let noise = ("0 to 1e9", 0.0..=1e9);
        let positive = ("1e-9 to 1e9", 1e-9..=1e9);
        let (wheels, images) = (&self.wheel_noise, &self.visual_noise);
        let [deviation_m, deviation_rad] = self.max_deviation;
        let [shorter_s, longer_s] = self.disagreement_times_s;
        let [matched, retrieved] = self.views_to_agree.map(f64::from);
        let gravity_s = self.gravity_correlation_s;
        let wheels_turn = wheels.rotation_over_meter;
        let images_turn = images.rotation_over_meter;

        let numbers = [
            ("correlated_share", &share, self.correlated_share),
            ("correlation_range", &positive, self.correlation_range),
            ("views_to_agree[0]", &positive, matched),
            ("views_to_agree[1]", &positive, retrieved),
            ("process_noise_factor", &positive, self.process_noise_factor),
            ("gate", &positive, self.gate),
            ("outlier_gate", &positive, self.outlier_gate),
            ("max_candidate_s", &positive, self.max_candidate_s),
            ("gravity_correlation_s", &positive, gravity_s),
            ("max_deviation[0]", &positive, deviation_m),
            ("max_deviation[1]", &positive, deviation_rad),
            ("wheel_noise.at_rest", &positive, wheels.at_rest),
            ("wheel_noise.over_motion", &noise, wheels.over_motion),
            ("wheel_noise.rotation_over_meter", &noise, wheels_turn),
            ("visual_noise.at_rest", &positive, images.at_rest),
            ("visual_noise.over_motion", &noise, images.over_motion),
            ("visual_noise.rotation_over_meter", &noise, images_turn),
            ("visual_design_effect", &positive, self.visual_design_effect),
            ("visual_depth_time_s", &positive, self.visual_depth_time_s),
            ("visual_scale_time_s", &positive, self.visual_scale_time_s),
            ("disagreement_times_s[0]", &positive, shorter_s),
            ("disagreement_times_s[1]", &positive, longer_s),
            ("max_speed", &positive, self.max_speed),
        ];
        for (field, (expected, range), value) in numbers {
            if !range.contains(&value) {
                return Err(ParameterError {
                    field,
                    expected,
                    value,
                });
            }
        }
        Ok(())
    }
}

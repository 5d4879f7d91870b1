//! Motions that another sensor has measured: wheels, or an inertial unit.
//!
//! The sensor reports the camera's pose in an odometry frame of its own, which drifts and never jumps.
//! The motion between two such poses counts in place of what the adapter reads, also where a view
//! shows nothing. A frame that brings no pose ends that until the next keyframe or place.

use nalgebra::{Matrix6, Vector6};

use super::Belief;
use super::moving::ReadMotion;
use crate::geometry::{Pose, Twist, body_twist, log};

/// Standard deviations that a motion has besides its shares: a millimetre, and half a milliradian.
const LEAST_DEVIATION_M: f64 = 1e-3;
const LEAST_DEVIATION_RAD: f64 = 5e-4;

/// Where another sensor says that the camera is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPose {
    /// In the sensor's own odometry frame: `sensor_odom_from_camera`.
    pub pose: Pose,
    /// How fast it drifts.
    pub drift: Drift,
}

/// How fast a sensor's odometry drifts, as standard deviations by axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Metres per metre of translation, above 0.
    pub translation_share: f64,
    /// Radians per radian of rotation, and radians per metre of translation; above 0.
    pub rotation_share: f64,
}

/// A motion between two frames, with the covariance of r in true motion = motion + r, on (v, ω),
/// metres and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
struct MeasuredMotion {
    motion: Twist,
    covariance: Matrix6<f64>,
}

/// What was measured from earlier frames to the last one: its pose in theirs. None where a frame
/// between them brought no pose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MeasuredSince {
    /// The last frame's pose in the sensor's odometry frame.
    pub last: Option<Pose>,
    /// Since the keyframe.
    pub keyframe: Option<Belief>,
    /// Since the frame of the last place.
    pub place: Option<Belief>,
}

impl MeasuredSince {
    /// As it is before the next frame of a stream whose last frame has become keyframe and place.
    #[must_use]
    pub(super) fn begun(self) -> Self {
        let begun = self.last.map(|_| no_motion());
        Self {
            last: self.last,
            keyframe: begun,
            place: begun,
        }
    }

    /// As it is after a frame, which may have become keyframe or place.
    #[must_use]
    pub(super) fn after(
        self,
        measured: Option<&MeasuredPose>,
        is_keyframe: bool,
        is_place: bool,
    ) -> Self {
        let step = self.step(measured);
        let or_begin = |begins: bool, since: Option<Belief>| {
            if begins {
                measured.map(|_| no_motion())
            } else {
                moved(since, step)
            }
        };

        Self {
            last: measured.map(|measured| measured.pose),
            keyframe: or_begin(is_keyframe, self.keyframe),
            place: or_begin(is_place, self.place),
        }
    }

    /// The motion from the keyframe to this frame, if it was measured all along.
    pub(super) fn from_keyframe(&self, measured: Option<&MeasuredPose>) -> Option<ReadMotion> {
        read(moved(self.keyframe, self.step(measured)))
    }

    /// The motion from the last place to this frame, if it was measured all along.
    pub(super) fn from_place(&self, measured: Option<&MeasuredPose>) -> Option<ReadMotion> {
        read(moved(self.place, self.step(measured)))
    }

    /// The motion from the last frame to this one, if both brought a pose.
    pub(super) fn from_last(&self, measured: Option<&MeasuredPose>) -> Option<Twist> {
        Some(self.step(measured)?.motion)
    }

    fn step(&self, measured: Option<&MeasuredPose>) -> Option<MeasuredMotion> {
        let (last, measured) = self.last.zip(measured)?;
        let motion = body_twist(&last, &measured.pose);

        motion.is_unique_logarithm().then(|| MeasuredMotion {
            motion,
            covariance: measured.drift.over(motion),
        })
    }
}

impl Drift {
    fn over(self, motion: Twist) -> Matrix6<f64> {
        let metres = motion.linear.norm();
        let translation = LEAST_DEVIATION_M + self.translation_share * metres;
        let rotation = LEAST_DEVIATION_RAD + self.rotation_share * (motion.angular.norm() + metres);

        let (v, w) = (translation.powi(2), rotation.powi(2));
        Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w))
    }
}

/// No motion, without any error.
fn no_motion() -> Belief {
    Belief {
        pose: Pose::identity(),
        covariance: Matrix6::zeros(),
    }
}

fn moved(since: Option<Belief>, step: Option<MeasuredMotion>) -> Option<Belief> {
    let (since, step) = since.zip(step)?;
    Some(since.moved(step.motion, &step.covariance))
}

fn read(whole: Option<Belief>) -> Option<ReadMotion> {
    let whole = whole?;
    let motion = log(&whole.pose);

    motion.is_unique_logarithm().then_some(ReadMotion {
        motion,
        covariance: whole.covariance,
    })
}

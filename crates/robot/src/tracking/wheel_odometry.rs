//! Wheel or inertial odometry.
//!
//! The sensor reports the camera's pose in its own odometry frame, which drifts but never jumps.
//! The motion between two such poses replaces the motion predicted by the adapter, also for blank
//! views. Frames without odometry use vision for the map pose; the next odometry pose spans the
//! gap. A keyframe or place without odometry has no measured motion until the next one with
//! odometry.

use nalgebra::{Matrix6, Vector6};

use super::pose_velocity::ReadMotion;
use super::state::Observation;
use seese3_core::geometry::{Pose, Twist, body_twist, exp, log};

/// Constant part of the standard deviations of a motion: 1 mm and 0.5 mrad.
const LEAST_DEVIATION_M: f64 = 1e-3;
const LEAST_DEVIATION_RAD: f64 = 5e-4;

/// Camera pose measured by another sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredPose {
    /// Pose in the sensor's own odometry frame: `sensor_odom_from_camera`.
    pub pose: Pose,
    /// Drift rate of the sensor.
    pub drift: Drift,
}

/// Drift rate of odometry, as standard deviations per axis. Errors are modeled as fully correlated,
/// like that of a wrong wheel radius: they grow with the distance, at any frame rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Meters per meter of translation, above 0.
    pub translation_share: f64,
    /// Radians per radian of rotation, and radians per meter of translation; above 0.
    pub rotation_share: f64,
}

/// Accumulated odometry from an earlier frame to the last frame with odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OdometryDelta {
    /// Pose of the later camera in the earlier one.
    pub pose: Pose,
    /// Path length, meters.
    pub way_m: f64,
    /// Sum of all rotation angles, radians.
    pub turns_rad: f64,
}

/// The last frame with odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LastMeasured {
    /// Timestamp, nanoseconds on the camera's clock.
    pub time_ns: i64,
    /// Camera pose in the sensor's odometry frame.
    pub pose: Pose,
}

/// Odometry accumulated up to the last frame with odometry.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OdometryAccumulator {
    /// The last frame with odometry.
    pub last: Option<LastMeasured>,
    /// Odometry since the keyframe; `None` if the keyframe has none.
    pub keyframe: Option<OdometryDelta>,
    /// Odometry since the frame of the last place; `None` if that frame has none.
    pub place: Option<OdometryDelta>,
}

impl OdometryAccumulator {
    /// Restarts both deltas at the last frame of the stream, which became keyframe and place.
    #[must_use]
    pub(super) fn begun(self, time_ns: i64) -> Self {
        let brought_pose = self.last.filter(|last| last.time_ns == time_ns);
        let begun = brought_pose.map(|_| OdometryDelta::zero());
        Self {
            last: self.last,
            keyframe: begun,
            place: begun,
        }
    }

    /// Adds a frame, which may have become keyframe or place.
    #[must_use]
    pub(super) fn after(self, frame: &Observation, is_keyframe: bool, is_place: bool) -> Self {
        let measured = frame.measured.as_ref();
        let step = self.step(measured);
        let or_begin = |begins: bool, since: Option<OdometryDelta>| match (begins, measured) {
            (true, measured) => measured.map(|_| OdometryDelta::zero()),
            (false, None) => since,
            (false, Some(_)) => Some(since?.and(step?)),
        };

        Self {
            last: measured.map_or(self.last, |measured| {
                Some(LastMeasured {
                    time_ns: frame.time_ns,
                    pose: measured.pose,
                })
            }),
            keyframe: or_begin(is_keyframe, self.keyframe),
            place: or_begin(is_place, self.place),
        }
    }

    /// The motion from the keyframe to this frame, if both have odometry.
    pub(super) fn motion_since_keyframe(
        &self,
        measured: Option<&MeasuredPose>,
    ) -> Option<ReadMotion> {
        self.known(self.keyframe, measured)
    }

    /// The motion from the last place to this frame, if both have odometry.
    pub(super) fn motion_since_place(&self, measured: Option<&MeasuredPose>) -> Option<ReadMotion> {
        self.known(self.place, measured)
    }

    /// The motion from the last frame with odometry to this one, if it has odometry.
    pub(super) fn step(&self, measured: Option<&MeasuredPose>) -> Option<Twist> {
        let (last, measured) = self.last.zip(measured)?;
        let motion = body_twist(&last.pose, &measured.pose);
        motion.is_unique_logarithm().then_some(motion)
    }

    fn known(
        &self,
        since: Option<OdometryDelta>,
        measured: Option<&MeasuredPose>,
    ) -> Option<ReadMotion> {
        let driven = since?.and(self.step(measured)?);
        let motion = log(&driven.pose);

        motion.is_unique_logarithm().then_some(ReadMotion {
            motion,
            covariance: measured?.drift.over(driven),
        })
    }
}

impl OdometryDelta {
    /// The delta from a frame to itself.
    pub(crate) fn zero() -> Self {
        Self {
            pose: Pose::identity(),
            way_m: 0.0,
            turns_rad: 0.0,
        }
    }

    pub(crate) fn and(self, motion: Twist) -> Self {
        Self {
            pose: self.pose * exp(&motion),
            way_m: self.way_m + motion.linear.norm(),
            turns_rad: self.turns_rad + motion.angular.norm(),
        }
    }
}

impl Drift {
    /// Covariance of the error of an odometry delta, on (v, ω) in the later camera's body frame.
    /// The mean of a linearly growing heading error is half its final value, hence the factor 0.5.
    pub(crate) fn over(self, driven: OdometryDelta) -> Matrix6<f64> {
        let OdometryDelta {
            way_m, turns_rad, ..
        } = driven;
        let rotation = LEAST_DEVIATION_RAD + self.rotation_share * (turns_rad + way_m);
        let translation =
            LEAST_DEVIATION_M + self.translation_share * way_m + 0.5 * rotation * way_m;

        let (v, w) = (translation.powi(2), rotation.powi(2));
        Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use seese3_core::geometry::PoseError;

    const DRIFT: Drift = Drift {
        translation_share: 0.05,
        rotation_share: 0.02,
    };

    /// A path of 3 m along x with a rotation of 0.3 rad about y, in `frames` frames. Frames for
    /// which `is_silent` holds have no odometry.
    fn ridden(frames: u32, is_silent: impl Fn(u32) -> bool) -> Option<ReadMotion> {
        let whole = Twist {
            linear: Vector3::new(3.0, 0.0, 0.0),
            angular: Vector3::new(0.0, 0.3, 0.0),
        };
        let measured = |frame: u32| {
            let share = f64::from(frame) / f64::from(frames);
            let place = Pose::new(Vector3::new(7.0, 1.0, -2.0), Vector3::new(0.4, 0.0, 1.0));
            (!is_silent(frame)).then(|| MeasuredPose {
                pose: place * exp(&whole.scaled(share)),
                drift: DRIFT,
            })
        };

        let observed = |frame: u32| Observation {
            measured: measured(frame),
            ..Observation::new(
                i64::from(frame),
                u64::from(frame),
                ndarray::Array1::zeros(1),
            )
        };

        let mut since = OdometryAccumulator::default().after(&observed(0), true, true);
        for frame in 1..frames {
            since = since.after(&observed(frame), false, false);
        }
        since.motion_since_place(measured(frames).as_ref())
    }

    /// Oracle: the definition, by hand: errors are fractions of the path, at any frame rate and
    /// with missing odometry in between.
    #[test]
    fn errors_grow_with_the_way_and_not_with_the_frames() {
        let rotation = 5e-4 + 0.02 * (0.3 + 3.0);
        let translation = 1e-3 + 0.05 * 3.0 + 0.5 * rotation * 3.0;

        let silences: [fn(u32) -> bool; 2] = [|_| false, |frame| frame % 10 == 5];
        for frames in [1, 30, 300] {
            for is_silent in silences {
                let found = ridden(frames, is_silent).unwrap();
                assert!((found.motion.linear - Vector3::new(3.0, 0.0, 0.0)).norm() < 1e-9);
                assert!((found.covariance[(0, 0)].sqrt() - translation).abs() < 1e-9);
                assert!((found.covariance[(4, 4)].sqrt() - rotation).abs() < 1e-9);
            }
        }
    }

    /// Oracle: the rules: there is no measured motion if the first or the last frame has no
    /// odometry.
    #[test]
    fn nothing_is_measured_from_or_to_a_silent_frame() {
        assert!(ridden(30, |frame| frame == 0).is_none());
        assert!(ridden(30, |frame| frame == 30).is_none());
        assert!(ridden(30, |frame| frame == 29).is_some());
    }

    /// Oracle: the rule, by hand: a place set at a frame without odometry has no measured motion.
    #[test]
    fn a_place_at_a_silent_frame_begins_nothing() {
        let since = OdometryAccumulator {
            last: Some(LastMeasured {
                time_ns: 5,
                pose: Pose::identity(),
            }),
            ..OdometryAccumulator::default()
        };
        assert!(since.begun(5).place.is_some() && since.begun(5).keyframe.is_some());
        assert!(since.begun(6).place.is_none() && since.begun(6).keyframe.is_none());
    }

    /// Oracle: composition.
    #[test]
    fn what_is_driven_adds_up() {
        let step = Twist {
            linear: Vector3::new(0.1, 0.0, 0.0),
            angular: Vector3::new(0.0, 0.0, 0.1),
        };
        let twice = OdometryDelta::zero().and(step).and(step);
        let error = PoseError::between(&twice.pose, &exp(&step.times(2)));
        assert!(error.translation_m < 1e-12 && error.rotation_rad < 1e-7);
        assert!((twice.way_m - 0.2).abs() < 1e-12 && (twice.turns_rad - 0.2).abs() < 1e-12);
    }
}

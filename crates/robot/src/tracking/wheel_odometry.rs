//! Motions that another sensor has measured: wheels, or an inertial unit.
//!
//! The sensor reports the camera's pose in an odometry frame of its own, which drifts and never jumps.
//! The motion between two such poses counts in place of what the adapter reads, also where a view
//! shows nothing. A frame that brings no pose is told by its view alone; the next one that brings a
//! pose covers both. A keyframe or place at a frame without a pose waits for the next one with it.

use nalgebra::{Matrix6, Vector6};

use super::pose_velocity::ReadMotion;
use super::state::Observation;
use seese3_core::geometry::{Pose, Twist, body_twist, exp, log};

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

/// How fast a sensor's odometry drifts, as standard deviations by axis. Errors are taken to last, as
/// those of a wheel of the wrong size do: they grow with the way, however many frames it takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Metres per metre of translation, above 0.
    pub translation_share: f64,
    /// Radians per radian of rotation, and radians per metre of translation; above 0.
    pub rotation_share: f64,
}

/// What was driven from an earlier frame to the last one that brought a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OdometryDelta {
    /// The later camera's pose in the earlier one.
    pub pose: Pose,
    /// The length of the way, metres.
    pub way_m: f64,
    /// The sum of all turns, radians.
    pub turns_rad: f64,
}

/// The last frame that brought a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LastMeasured {
    /// When it was taken, nanoseconds on the camera's clock.
    pub time_ns: i64,
    /// Its pose in the sensor's odometry frame.
    pub pose: Pose,
}

/// What was measured up to the last frame that brought a pose.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OdometryAccumulator {
    /// That frame.
    pub last: Option<LastMeasured>,
    /// OdometryDelta since the keyframe; none if that brought no pose.
    pub keyframe: Option<OdometryDelta>,
    /// OdometryDelta since the frame of the last place; none if that brought no pose.
    pub place: Option<OdometryDelta>,
}

impl OdometryAccumulator {
    /// As it is when the frame of this time, the last of its stream, has become keyframe and place.
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

    /// As it is after a frame, which may have become keyframe or place.
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

    /// The motion from the keyframe to this frame, if both brought a pose.
    pub(super) fn motion_since_keyframe(
        &self,
        measured: Option<&MeasuredPose>,
    ) -> Option<ReadMotion> {
        self.known(self.keyframe, measured)
    }

    /// The motion from the last place to this frame, if both brought a pose.
    pub(super) fn motion_since_place(&self, measured: Option<&MeasuredPose>) -> Option<ReadMotion> {
        self.known(self.place, measured)
    }

    /// The motion from the last frame that brought a pose to this one, if it does too.
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
    /// From a frame to itself.
    fn zero() -> Self {
        Self {
            pose: Pose::identity(),
            way_m: 0.0,
            turns_rad: 0.0,
        }
    }

    fn and(self, motion: Twist) -> Self {
        Self {
            pose: self.pose * exp(&motion),
            way_m: self.way_m + motion.linear.norm(),
            turns_rad: self.turns_rad + motion.angular.norm(),
        }
    }
}

impl Drift {
    /// The covariance of the error of what was driven, on (v, ω) in the later camera's body frame. A
    /// heading that is wrong more and more leads aside by half of what it is wrong at the end.
    fn over(self, driven: OdometryDelta) -> Matrix6<f64> {
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

    /// A way of three metres along x that turns by 0.3 rad about y, in so many frames; without a pose
    /// in the frames that `is_silent` says.
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

    /// Oracle: the definition, by hand: shares of the way, whatever the rate and whatever is missing in
    /// between.
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

    /// Oracle: the rules: what began without a pose is not known, and a frame without one has no
    /// measured motion.
    #[test]
    fn nothing_is_measured_from_or_to_a_silent_frame() {
        assert!(ridden(30, |frame| frame == 0).is_none());
        assert!(ridden(30, |frame| frame == 30).is_none());
        assert!(ridden(30, |frame| frame == 29).is_some());
    }

    /// Oracle: the rule, by hand: a place that is set at a frame without a pose is not measured from.
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

//! Input and state of a filter.

use nalgebra::Matrix6;

use super::belief::origin;
use super::gravity::Tilted;
use super::{
    Belief, Contradicted, Disagreements, FilterParameters, MeasuredGravity, MeasuredInertia,
};
use crate::tracking::{
    BestMatch, Candidate, Drift, MeasuredPose, OdometryDelta, PoseWithCovariance, Refusal, Sensor,
};
use crate::visual_odometry::VisualMotion;
use seese3_core::geometry::{Pose, log};

/// One frame of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewObservation {
    /// Timestamp, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number set by the sender.
    pub sequence: u64,
    /// Poses of the stream's own camera by the views of this frame. The first one leads: only it
    /// may start the tracking or replace a pose. Views of one frame have correlated errors:
    /// together they count as one.
    pub located: Vec<LocatedPose>,
    /// The most similar mapped frame of all views.
    pub best_match: Option<BestMatch>,
    /// How unlike the view is to the map, relative to the limit; infinite if unknown.
    pub novelty: f64,
    /// Why no view is located; empty if one is.
    pub unlocated: String,
    /// Equal for identical images of the stream's own camera. `None` for a blank image.
    pub fingerprint: Option<u64>,
    /// The motion since the last frame by visual odometry, if its images agree.
    pub visual: Option<VisualMotion>,
    /// Camera pose from wheel odometry, in the odometry frame of that sensor.
    pub measured: Option<MeasuredPose>,
    /// The direction of gravity, if it is measured.
    pub gravity: Option<MeasuredGravity>,
    /// The motion since the last frame by gyroscope and accelerometer, if they are measured.
    pub inertia: Option<MeasuredInertia>,
}

impl ViewObservation {
    /// A frame without any observation.
    pub fn empty(time_ns: i64, sequence: u64) -> Self {
        Self {
            time_ns,
            sequence,
            located: Vec::new(),
            best_match: None,
            novelty: f64::INFINITY,
            unlocated: String::new(),
            fingerprint: None,
            visual: None,
            measured: None,
            gravity: None,
            inertia: None,
        }
    }
}

/// How a view is located.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// By keypoints that are matched with the map.
    Matched,
    /// By the most similar mapped frames.
    Retrieved,
}

/// The pose of the stream's own camera, from one view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocatedPose {
    /// The room, an index of the filter's rooms.
    pub room: usize,
    /// `world_from_camera`.
    pub pose: PoseWithCovariance,
    /// How the view is located.
    pub source: Source,
    /// Whether the view certainly shows the room. Other views only correct a pose that agrees.
    pub is_of_room: bool,
    /// The other camera of the view; `None` for the stream's own camera.
    pub camera: Option<u32>,
}

/// Complete state of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct FilterState {
    /// The only room, or the one in which the camera was located; an index of the filter's rooms.
    pub room: Option<usize>,
    /// The last frame.
    pub last: Option<LastView>,
    /// The belief in the room if `is_placed`, else in an odometry frame.
    pub belief: Option<Belief>,
    /// Whether the belief is in the room.
    pub is_placed: bool,
    /// `odom_from_camera`, without the drift of wheel odometry in its covariance.
    pub odom: PoseWithCovariance,
    /// Wheel odometry since the start of the stream, for that drift.
    pub wheel_motion: OdometryDelta,
    /// The last frame with wheel odometry.
    pub measured: Option<OdometryMark>,
    /// The keyframe of reported motions.
    pub keyframe: Option<KeyframeMark>,
    /// A belief that a located pose supports, but not enough of them.
    pub candidate: Option<FilterCandidate>,
    /// Time of the last frame whose located pose was used, nanoseconds on the sensor's clock.
    pub located_ns: Option<i64>,
    /// Whether visual odometry, or wheels that are trusted, have measured the motion of every frame
    /// since the last located one.
    pub is_carried: bool,
    /// The differences between the sensors of motions.
    pub disagreements: Disagreements,
    /// The sensors that are left out because of a contradiction.
    pub contradicted: Contradicted,
    /// Number of consecutive frames with the same image as the one before.
    pub unchanged_frames: u32,
    /// Time of the last measured gravity, nanoseconds on the sensor's clock.
    pub gravity_ns: Option<i64>,
}

/// The last frame of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LastView {
    /// Timestamp, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number.
    pub sequence: u64,
    /// As [`ViewObservation::fingerprint`].
    pub fingerprint: Option<u64>,
}

/// The keyframe of reported motions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeMark {
    /// Sequence number.
    pub sequence: u64,
    /// The motion since.
    pub since: PoseWithCovariance,
}

/// The last frame with wheel odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryMark {
    /// Camera pose in the sensor's odometry frame.
    pub pose: Pose,
    /// Whether it is the last frame of the stream.
    pub is_last: bool,
    /// The drift that the sensor states.
    pub translation_share: f64,
    /// The same for rotations.
    pub rotation_share: f64,
}

/// A hypothesis with too few agreeing poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FilterCandidate {
    /// The room, an index of the filter's rooms.
    pub room: usize,
    /// Timestamp of the newest supporting frame, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number of that frame.
    pub sequence: u64,
    /// The belief at that frame.
    pub belief: Belief,
    /// Number of consecutive located poses that agree.
    pub agreeing: u32,
    /// Number of poses that must agree.
    pub needed: u32,
    /// Whether the located pose before was in the same room, and did not agree.
    pub contradicts_last: bool,
}

impl FilterState {
    /// The state of a new stream.
    pub(super) fn in_room(room: Option<usize>) -> Self {
        Self {
            room,
            last: None,
            belief: None,
            is_placed: false,
            odom: origin(),
            wheel_motion: OdometryDelta::zero(),
            measured: None,
            keyframe: None,
            candidate: None,
            located_ns: None,
            is_carried: false,
            disagreements: Disagreements::default(),
            contradicted: Contradicted::default(),
            unchanged_frames: 0,
            gravity_ns: None,
        }
    }

    /// Seconds from the last frame to this one; 0 for the first.
    ///
    /// # Errors
    /// [`Refusal`] if the frame is not newer.
    pub(super) fn seconds_to(&self, time_ns: i64, sequence: u64) -> Result<f64, Refusal> {
        let Some(last) = self.last else {
            return Ok(0.0);
        };
        if sequence <= last.sequence {
            return Err(Refusal::Duplicate {
                sequence,
                last: last.sequence,
            });
        }
        if time_ns <= last.time_ns {
            return Err(Refusal::Late {
                time_ns,
                last_ns: last.time_ns,
            });
        }
        Ok(time_ns.abs_diff(last.time_ns) as f64 * 1e-9)
    }

    /// The motion since the last frame by wheel odometry, `last_from_this`, if both frames have it.
    pub(super) fn wheel_motion_to(&self, frame: &ViewObservation) -> Option<Pose> {
        let measured = self.measured.filter(|mark| mark.is_last)?;
        let motion = measured.pose.inv_mul(&frame.measured?.pose);
        log(&motion).is_unique_logarithm().then_some(motion)
    }

    /// Remembers the odometry of a frame.
    pub(super) fn mark_measured(&mut self, frame: &ViewObservation) {
        let now = frame.measured.map(|measured| OdometryMark {
            pose: measured.pose,
            is_last: true,
            translation_share: measured.drift.translation_share,
            rotation_share: measured.drift.rotation_share,
        });
        let before = self.measured.map(|mark| OdometryMark {
            is_last: false,
            ..mark
        });
        self.measured = now.or(before);
    }

    /// `odom_from_camera`. Odometry drift is fully correlated between steps, and `composed` assumes
    /// independence, so the drift is added here.
    pub(super) fn odom_with_drift(&self) -> PoseWithCovariance {
        let drift = self.measured.map_or_else(Matrix6::zeros, |mark| {
            let drift = Drift {
                translation_share: mark.translation_share,
                rotation_share: mark.rotation_share,
            };
            drift.over(self.wheel_motion)
        });
        PoseWithCovariance {
            covariance: self.odom.covariance + drift,
            ..self.odom
        }
    }

    /// All sensors that contradict others or the pose.
    pub(super) fn contradicted_sensors(&self, tilted: Option<Tilted>) -> Vec<Sensor> {
        let of_motions = self.contradicted.sensors();
        let gravity = tilted.map(|_| Sensor::Gravity);
        let is_disputed = self.is_placed && self.candidate.is_some();
        let views = is_disputed.then_some(Sensor::Views);
        of_motions.chain(gravity).chain(views).collect()
    }

    /// Whether a located pose was used at most `seconds` before the newest frame.
    pub(super) fn is_located_within(&self, seconds: f64) -> bool {
        let times = self.last.zip(self.located_ns);
        times.is_some_and(|(last, located_ns)| {
            last.time_ns.abs_diff(located_ns) as f64 * 1e-9 <= seconds
        })
    }

    /// Notes that a view was located.
    pub(super) fn mark_located(&mut self, time_ns: i64) {
        self.located_ns = Some(time_ns);
        self.is_carried = true;
    }

    /// Drops a candidate that no located pose has supported for too long.
    pub(super) fn expire_candidate(&mut self, frame: &ViewObservation, max_s: f64) {
        let is_old = |candidate: &FilterCandidate| {
            frame.time_ns.abs_diff(candidate.time_ns) as f64 * 1e-9 > max_s
        };
        self.candidate = self.candidate.filter(|candidate| !is_old(candidate));
    }

    /// Makes a frame the last one, and counts identical images.
    pub(super) fn advance(&mut self, frame: &ViewObservation) {
        let is_unchanged = self.last.is_some_and(|last| {
            last.fingerprint.is_some() && last.fingerprint == frame.fingerprint
        });
        self.unchanged_frames = if is_unchanged {
            self.unchanged_frames.saturating_add(1)
        } else {
            0
        };
        self.last = Some(LastView {
            time_ns: frame.time_ns,
            sequence: frame.sequence,
            fingerprint: frame.fingerprint,
        });

        // A pose set before the first frame counts as located at the first frame.
        if self.is_placed {
            self.located_ns.get_or_insert(frame.time_ns);
        }
    }

    /// The keyframe of this frame, with the motion since. The frame may become the next keyframe.
    pub(super) fn keyframe_with(
        &mut self,
        frame: &ViewObservation,
        motion: &PoseWithCovariance,
        parameters: &FilterParameters,
    ) -> KeyframeMark {
        let this = KeyframeMark {
            sequence: frame.sequence,
            since: origin(),
        };
        let reported = self.keyframe.map_or(this, |keyframe| KeyframeMark {
            since: keyframe.since.composed(motion),
            ..keyframe
        });

        let frames = frame.sequence - reported.sequence;
        let is_due = frames >= u64::from(parameters.keyframe_frames)
            || log(&reported.since.pose).norm() >= parameters.keyframe_displacement;
        self.keyframe = Some(if is_due { this } else { reported });
        reported
    }
}

impl FilterCandidate {
    /// The candidate as an update reports it.
    pub(super) fn reported(&self) -> Candidate {
        Candidate {
            room: self.room,
            time_ns: self.time_ns,
            sequence: self.sequence,
            map_pose: self.belief.place(),
            agreeing: self.agreeing,
            needed: self.needed,
        }
    }
}

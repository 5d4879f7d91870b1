//! Input, state and output of a tracker.

use nalgebra::Matrix6;
use ndarray::Array1;

use super::health::TrackingHealth;
use super::{
    MeasuredGravity, MeasuredPose, OdometryAccumulator, OtherCamera, OtherView, PoseVelocity,
    PoseWithCovariance, RecentMatches, Status,
};
use seese3_core::geometry::Twist;
use seese3_core::index::Neighbour;
use seese3_core::room::FrameId;

/// One frame of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Timestamp, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number set by the sender. Gaps in the numbers are dropped frames.
    pub sequence: u64,
    /// Latent under the tracker's adapter, shape (k,).
    pub latent: Array1<f64>,
    /// Raw feature of the latent, shape (d,), if known: used to retrieve mapped frames, and by the
    /// [`super::PoseReader`] of a map.
    pub feature: Option<Vec<f32>>,
    /// Pose of the view from keypoints that were matched with a map, if they locate it.
    pub matched: Option<MatchedPose>,
    /// Whether the image is known to be blank: nearly uniform brightness.
    pub is_blank: bool,
    /// Camera pose from wheel or inertial odometry, in the odometry frame of that sensor.
    pub measured: Option<MeasuredPose>,
    /// Direction of gravity, if measured.
    pub gravity: Option<MeasuredGravity>,
    /// Simultaneous views of other cameras on the same robot.
    pub other_views: Vec<OtherView>,
}

impl Observation {
    /// An observation with a latent only.
    pub fn new(time_ns: i64, sequence: u64, latent: Array1<f64>) -> Self {
        Self {
            time_ns,
            sequence,
            latent,
            feature: None,
            matched: None,
            is_blank: false,
            measured: None,
            gravity: None,
            other_views: Vec::new(),
        }
    }
}

/// Pose of a view from keypoints that were matched with a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchedPose {
    /// The map, an index of [`super::Tracker::maps`].
    pub room: usize,
    /// `world_from_camera`.
    pub pose: PoseWithCovariance,
    /// How unlike the view is to the map, relative to the limit; at most 1.
    pub novelty: f64,
    /// The row of the mapped frame with the most matched keypoints.
    pub best_frame: FrameId,
}

impl MatchedPose {
    /// The mapped frame with the most matched keypoints; the distance is `novelty`.
    pub fn best_match(&self) -> Neighbour {
        Neighbour {
            frame: self.best_frame,
            distance: self.novelty,
        }
    }
}

/// Complete state of a tracked stream.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct State {
    /// Map of the camera, an index of [`super::Tracker::maps`]: the only map, or the one in which
    /// the camera was localized.
    pub room: Option<usize>,
    /// Last accepted frame.
    pub last: Option<LastFrame>,
    /// Reference frame of predicted motions.
    pub keyframe: Option<Keyframe>,
    /// Filter state at the last corrected frame, or at a later frame once that is too old.
    pub place: Option<Place>,
    /// Pose set by the client before the first frame, `world_from_camera`.
    pub initial_pose: Option<PoseWithCovariance>,
    /// Whitened latents of the last frames, newest last; used to detect jumps of the view.
    pub recent: Vec<Vec<f64>>,
    /// Whether the frames are continuous and match the room.
    pub health: TrackingHealth,
    /// Hypothesis for the map pose on which recent anchors agree.
    pub candidate: Option<Candidate>,
    /// Number of frames since the last match.
    pub frames_off_map: u32,
    /// Number of consecutive frames identical to their predecessor.
    pub unchanged_frames: u32,
    /// Time of the last correction by an anchor, nanoseconds on the sensor's clock.
    pub corrected_ns: Option<i64>,
    /// Odometry of other sensors since the keyframe and the last place.
    pub measured: OdometryAccumulator,
    /// State of the robot's other cameras.
    pub other_cameras: Vec<OtherCamera>,
    /// Time of the last new image of the stream's own camera, nanoseconds on the sensor's clock.
    pub seen_ns: Option<i64>,
    /// Time of the last gravity measurement, nanoseconds on the sensor's clock.
    pub gravity_ns: Option<i64>,
    /// Running uncertainty of the recent matches of the stream's own camera.
    pub recent_matches: Option<RecentMatches>,
}

/// The last frame of a stream.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LastFrame {
    /// Timestamp, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number set by the sender.
    pub sequence: u64,
    /// Latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera`.
    pub odom: PoseWithCovariance,
}

/// Reference frame of predicted motions.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Keyframe {
    /// Timestamp, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number set by the sender.
    pub sequence: u64,
    /// Latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera` and the velocity at this frame, from dead reckoning alone.
    pub odom: PoseVelocity,
    /// Reported `map_from_camera`, with its calibrated covariance. It is kept after the filter
    /// state is dropped.
    pub reported_pose: Option<PoseWithCovariance>,
}

/// Filter state at an earlier frame: the prior of later anchors.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Place {
    /// Timestamp of the frame, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Latent of the frame; `None` if the camera was covered or frozen and another camera was used.
    pub latent: Option<Vec<f64>>,
    /// `map_from_camera` and the camera's velocity.
    pub belief: PoseVelocity,
    /// Covariance of the time-correlated error of the last anchor, which the filter cannot average
    /// out; zero if that error is uncorrelated.
    #[cfg_attr(
        feature = "serde",
        serde(with = "seese3_core::matrices::upper_triangle")
    )]
    pub lasting: Matrix6<f64>,
}

/// Hypothesis for the map pose on which recent anchors agree.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Candidate {
    /// The map, an index of [`super::Tracker::maps`].
    pub room: usize,
    /// Timestamp of the newest supporting frame, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number of that frame.
    pub sequence: u64,
    /// Latent of that frame; `None` if the camera was covered or frozen and another camera was
    /// used.
    pub latent: Option<Vec<f64>>,
    /// `map_from_camera` at that frame.
    pub map_pose: PoseWithCovariance,
    /// Number of consecutive anchors that agree.
    pub agreeing_anchors: u32,
}

/// Output of a tracker for one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    /// Motion from the keyframe to this frame, in the keyframe's body frame.
    pub motion: Twist,
    /// Covariance of the motion's error on (v, ω), meters and radians.
    pub motion_covariance: Matrix6<f64>,
    /// Sequence number of the keyframe.
    pub keyframe_sequence: u64,
    /// Whether this frame became the new keyframe.
    pub is_keyframe: bool,
    /// `odom_from_camera`.
    pub odom: PoseWithCovariance,
    /// Reported `map_from_camera`; the map frame is the room's world. Check `status` before use: a
    /// stream that is LOST or RELOCALIZING in a single room still reports its last pose, with
    /// growing covariance. So does a stream that is LOST because of its position uncertainty.
    pub map_pose: Option<PoseWithCovariance>,
    /// Camera velocity in its body frame, meters and radians per second; `None` for the first
    /// frame. It is the velocity of the fused map pose, or of dead reckoning if there is none.
    pub velocity: Option<Twist>,
    /// Localization status.
    pub status: Status,
    /// Reason of the status, as text.
    pub reason: String,
    /// Distance to the nearest mapped frame divided by the room's limit: above 1 the frame is out
    /// of distribution.
    pub out_of_distribution: f64,
    /// The only map, or the one in which the camera was localized.
    pub room: Option<usize>,
    /// Map and mapped frame that are most similar to the view, if any is.
    pub best_match: Option<(usize, Neighbour)>,
    /// The other camera of that view; `None` for the stream's own camera.
    pub best_camera: Option<u32>,
    /// Whether that match corrected the map pose.
    pub match_used: bool,
    /// Squared Mahalanobis distance of the anchor from the predicted map pose, if both exist.
    pub surprise: Option<f64>,
    /// Hypothesis for the map pose on which recent anchors agree.
    pub candidate: Option<Candidate>,
    /// Number of anchors that must agree on it.
    pub anchors_needed: u32,
}

/// Why a frame was rejected. A rejected frame does not change the state of the stream.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The frame is not newer than the one before.
    #[error("timestamp {time_ns} ns is not later than that of the previous frame, {last_ns} ns")]
    Late {
        /// Timestamp of the frame.
        time_ns: i64,
        /// Timestamp of the previous frame.
        last_ns: i64,
    },
    /// The frame's sequence number is not larger than the previous one.
    #[error("sequence {sequence} is not larger than that of the previous frame, {last}")]
    Duplicate {
        /// Sequence number of the frame.
        sequence: u64,
        /// Sequence number of the previous frame.
        last: u64,
    },
    /// The latent does not fit the tracker's adapter.
    #[error(transparent)]
    View(#[from] seese3_core::adapter::Error),
}

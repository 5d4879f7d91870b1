//! What a tracker knows of a stream, what it is given for each frame, and what it answers.

use nalgebra::Matrix6;
use ndarray::Array1;

use super::health::TrackingHealth;
use super::{
    MeasuredGravity, MeasuredPose, OdometryAccumulator, OtherCamera, OtherView, PoseVelocity,
    PoseWithCovariance, RecentMatches, Status,
};
use seese3_core::geometry::Twist;
use seese3_core::index::Neighbour;

/// One frame of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// When it was taken, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// The sender's number of the frame. Numbers that are missing are frames that are missing.
    pub sequence: u64,
    /// Its latent under the tracker's adapter, shape (k,).
    pub latent: Array1<f64>,
    /// The raw feature of that latent, shape (d,), if it is known: mapped frames are found by it,
    /// and the [`super::PoseReader`] of a map reads it.
    pub feature: Option<Vec<f32>>,
    /// Whether the image is known to show nothing: it is blank, or all bright or dark.
    pub is_blank: bool,
    /// Where another sensor says that the camera is, in an odometry frame of its own.
    pub measured: Option<MeasuredPose>,
    /// Which way is down, if a sensor tells.
    pub gravity: Option<MeasuredGravity>,
    /// What other cameras on the same robot saw at the same time.
    pub other_views: Vec<OtherView>,
}

impl Observation {
    /// A view with this latent, of which nothing else is known.
    pub fn new(time_ns: i64, sequence: u64, latent: Array1<f64>) -> Self {
        Self {
            time_ns,
            sequence,
            latent,
            feature: None,
            is_blank: false,
            measured: None,
            gravity: None,
            other_views: Vec::new(),
        }
    }
}

/// Everything that a tracker knows of a stream.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct State {
    /// The only map or, of several, the one that the camera was found in; an index of
    /// [`super::Tracker::maps`].
    pub room: Option<usize>,
    /// The last frame that was accepted.
    pub last: Option<LastFrame>,
    /// The frame that motions are read from.
    pub keyframe: Option<Keyframe>,
    /// Where the camera was when its map pose was last corrected, if it is believed.
    pub place: Option<Place>,
    /// The pose that was given from outside, until the first frame arrives: `world_from_camera`.
    pub initial_pose: Option<PoseWithCovariance>,
    /// Whitened latents of the last frames, the newest last: what a jump of the view is told by.
    pub recent: Vec<Vec<f64>>,
    /// Whether the frames follow from one another and match the room.
    pub health: TrackingHealth,
    /// A map pose that recent anchors agree on and that is not believed yet.
    pub candidate: Option<Candidate>,
    /// Frames since the last one that matched the map.
    pub frames_off_map: u32,
    /// Frames in a row that showed exactly what the one before did.
    pub unchanged_frames: u32,
    /// When an anchor last corrected the map pose, nanoseconds on the sensor's clock.
    pub corrected_ns: Option<i64>,
    /// What other sensors measured since the keyframe and the last place.
    pub measured: OdometryAccumulator,
    /// What is remembered of the robot's other cameras.
    pub other_cameras: Vec<OtherCamera>,
    /// When its own camera last showed anything new, nanoseconds on the sensor's clock.
    pub seen_ns: Option<i64>,
    /// When gravity was last measured, nanoseconds on the sensor's clock.
    pub gravity_ns: Option<i64>,
    /// How sure the matches of its own camera lately were.
    pub recent_matches: Option<RecentMatches>,
}

/// The last frame of a stream.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct LastFrame {
    /// When it was taken, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// The sender's number.
    pub sequence: u64,
    /// Its latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera`.
    pub odom: PoseWithCovariance,
}

/// The frame that motions are read from.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Keyframe {
    /// When it was taken, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// The sender's number.
    pub sequence: u64,
    /// Its latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera` at this frame and the camera's velocity, of which nothing is known but
    /// what motions were read.
    pub odom: PoseVelocity,
    /// `map_from_camera` as it is reported: with the covariance that its errors were measured to
    /// have, and also after the tracker stopped believing it.
    pub reported_pose: Option<PoseWithCovariance>,
}

/// Where the camera is believed to have been at a frame: what anchors are compared with.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Place {
    /// When the frame was taken, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Its latent; none if the camera was covered or frozen, and another one told the place.
    pub latent: Option<Vec<f64>>,
    /// `map_from_camera` and the camera's velocity.
    pub belief: PoseVelocity,
    /// The covariance of the lasting error of the anchor that corrected it last, which the filter
    /// cannot average away; zero where its errors do not last.
    #[cfg_attr(
        feature = "serde",
        serde(with = "seese3_core::matrices::upper_triangle")
    )]
    pub lasting: Matrix6<f64>,
}

/// A map pose that recent anchors agree on.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Candidate {
    /// The map, an index of [`super::Tracker::maps`].
    pub room: usize,
    /// When the newest frame was taken that spoke for it, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// That frame's number.
    pub sequence: u64,
    /// That frame's latent; none if the camera was covered or frozen, and another one spoke.
    pub latent: Option<Vec<f64>>,
    /// `map_from_camera` at that frame.
    pub map_pose: PoseWithCovariance,
    /// How many anchors in a row agreed.
    pub agreeing_anchors: u32,
}

/// What a tracker answers to a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    /// The motion from the keyframe to this frame, in the keyframe's body frame.
    pub motion: Twist,
    /// The covariance of that motion's error on (v, ω), metres and radians.
    pub motion_covariance: Matrix6<f64>,
    /// The keyframe's number.
    pub keyframe_sequence: u64,
    /// Whether this frame is the keyframe from now on.
    pub is_keyframe: bool,
    /// `odom_from_camera`.
    pub odom: PoseWithCovariance,
    /// `map_from_camera` as it is reported; the map's frame is the room's world. The last pose is
    /// still given, less and less surely, while a stream is LOST or RELOCALIZING in a single room,
    /// and where it is LOST because its position became too uncertain: look at `status` before
    /// using it.
    pub map_pose: Option<PoseWithCovariance>,
    /// The camera's velocity in its body frame, metres and radians per second: that of the fused
    /// pose where one is believed, else what readings alone tell; none for the first frame.
    pub velocity: Option<Twist>,
    /// Whether the place is known, and confirmed by recent frames.
    pub status: Status,
    /// Why the status is what it is, in words.
    pub reason: String,
    /// The distance to the nearest mapped frame over the room's own limit: above 1 the frame looks
    /// like another place.
    pub out_of_distribution: f64,
    /// The only map or, of several, the one that the camera was found in.
    pub room: Option<usize>,
    /// The map and the mapped frame that the view resembles most.
    pub best_match: (usize, Neighbour),
    /// Which of the robot's other cameras saw that view; none for the stream's own.
    pub best_camera: Option<u32>,
    /// Whether that frame corrected the pose.
    pub match_used: bool,
    /// The squared Mahalanobis distance of the best match from the expected place, if an anchor was
    /// tried and a place was expected.
    pub surprise: Option<f64>,
    /// A map pose that recent anchors agree on and that is not believed yet.
    pub candidate: Option<Candidate>,
}

/// Why a frame was refused. The state of the stream is as if it had never arrived.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The frame is not newer than the one before.
    #[error("timestamp {time_ns} ns is not later than that of the frame before, {last_ns} ns")]
    Late {
        /// The frame's time.
        time_ns: i64,
        /// The time of the frame before.
        last_ns: i64,
    },
    /// The frame's number is not larger than the last one's.
    #[error("sequence {sequence} is not larger than that of the frame before, {last}")]
    Duplicate {
        /// The frame's number.
        sequence: u64,
        /// The number of the frame before.
        last: u64,
    },
    /// The latent does not fit the tracker's adapter.
    #[error(transparent)]
    View(#[from] seese3_core::adapter::Error),
}

//! What a stream answers to a frame.

use nalgebra::Matrix6;

use super::PoseWithCovariance;
use seese3_core::geometry::Twist;
use seese3_core::index::Neighbor;

/// Localization status of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The map pose is known and confirmed by recent frames.
    Tracking,
    /// There is a map pose, but it is unconfirmed, contradicted or too uncertain.
    Degraded,
    /// There is no map pose, or its position is too uncertain to be useful.
    Lost,
    /// Views of the room support a pose, but too few of them agree yet.
    Relocalizing,
}

/// A source of observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sensor {
    /// Wheel odometry, or that of another sensor of the robot.
    Wheels,
    /// Visual odometry.
    Images,
    /// Gyroscope and accelerometer.
    Inertia,
    /// The direction of gravity.
    Gravity,
    /// Located views.
    Views,
}

/// The most similar mapped frame of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BestMatch {
    /// The room, an index of the stream's rooms.
    pub room: usize,
    /// The mapped frame, with its distance.
    pub frame: Neighbor,
    /// The other camera of the view; `None` for the stream's own camera.
    pub camera: Option<u32>,
}

/// Hypothesis for the map pose that some located views support.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The room, an index of the stream's rooms.
    pub room: usize,
    /// Timestamp of the newest supporting frame, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Sequence number of that frame.
    pub sequence: u64,
    /// `map_from_camera` at that frame.
    pub map_pose: PoseWithCovariance,
    /// Number of consecutive located views that agree.
    pub agreeing: u32,
    /// Number of views that must agree.
    pub needed: u32,
}

/// The answer to one frame.
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
    /// `map_from_camera`; the map frame is the room's world. Check `status` before use: a LOST
    /// stream may have a pose, whose covariance says how useless it is.
    pub map_pose: Option<PoseWithCovariance>,
    /// Camera velocity in its body frame, meters and radians per second; `None` for the first
    /// frame.
    pub velocity: Option<Twist>,
    /// Covariance of the velocity's error, on (v, ω) per second.
    pub velocity_covariance: Matrix6<f64>,
    /// Localization status.
    pub status: Status,
    /// Reason of the status, as text.
    pub reason: String,
    /// Sensors that contradict others, or the pose.
    pub contradicted: Vec<Sensor>,
    /// How unlike the view is to the map, relative to the limit: above 1 it looks like another
    /// place.
    pub out_of_distribution: f64,
    /// The only room, or the one in which the camera was located.
    pub room: Option<usize>,
    /// The most similar mapped frame of all views, if there is any.
    pub best_match: Option<BestMatch>,
    /// Whether a located view corrected or replaced the map pose.
    pub match_used: bool,
    /// Squared Mahalanobis length of the innovation of the leading located view, if it is in the
    /// room of the map pose.
    pub surprise: Option<f64>,
    /// Hypothesis for the map pose that recent located views support.
    pub candidate: Option<Candidate>,
}

/// Why a frame was rejected. A rejected frame does not change the state of the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
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
}

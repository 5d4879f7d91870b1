//! What is known of a stream, what comes and what is said.

use ndarray::Array1;

use super::chain::Chain;
use super::{Belief, Status};
use crate::geometry::Twist;
use crate::index::Neighbour;

/// A frame as it comes.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// The sender's number.
    pub sequence: u64,
    /// Of the tracker's adapter.
    pub latent: Array1<f64>,
}

/// All that is known of a stream.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct State {
    /// The map that the camera is thought to be in.
    pub room: Option<usize>,
    /// The last frame that was taken.
    pub last: Option<Last>,
    /// What motions are read from.
    pub keyframe: Option<Keyframe>,
    /// Where the camera was put from outside, until the first frame comes: `world_from_camera`.
    pub initial: Option<Belief>,
    /// Whitened latents of the last frames, the newest last.
    pub recent: Vec<Vec<f64>>,
    /// Whether the frames hang together, and with the room.
    pub chain: Chain,
    /// A place that recent anchors speak for.
    pub candidate: Option<Candidate>,
    /// Frames since the last that looked like a mapped place.
    pub unseen: u32,
    /// Frames since an anchor was looked for.
    pub unlooked: u32,
}

/// The last frame of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct Last {
    /// Nanoseconds.
    pub time_ns: i64,
    /// The sender's number.
    pub sequence: u64,
    /// Its latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera`.
    pub odom: Belief,
}

/// The frame that motions are read from.
#[derive(Debug, Clone, PartialEq)]
pub struct Keyframe {
    /// The sender's number.
    pub sequence: u64,
    /// Its latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera` there.
    pub odom: Belief,
    /// `map_from_camera` there, if it is believed: what anchors are weighed against.
    pub place: Option<Belief>,
    /// `map_from_camera` with the covariance that its errors have: what is told, also of a place
    /// that is not believed any more.
    pub told: Option<Belief>,
}

/// A place that recent anchors agree on.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The map.
    pub room: usize,
    /// The frame's number.
    pub sequence: u64,
    /// The frame's latent.
    pub latent: Vec<f64>,
    /// `map_from_camera` there.
    pub place: Belief,
    /// Anchors that agreed.
    pub agreed: u32,
}

/// What a frame says.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    /// From the keyframe, in its body frame.
    pub motion: Twist,
    /// Of the motion's six numbers.
    pub motion_covariance: nalgebra::Matrix6<f64>,
    /// The keyframe's number.
    pub keyframe_sequence: u64,
    /// Whether this frame is a keyframe from now on.
    pub is_keyframe: bool,
    /// `odom_from_camera`.
    pub odom: Belief,
    /// `map_from_camera`, if a place is known.
    pub place: Option<Belief>,
    /// Metres and radians a second in the camera's body frame since the frame before.
    pub velocity: Option<Twist>,
    /// Whether the place is known, and confirmed.
    pub status: Status,
    /// Why, in words.
    pub reason: String,
    /// Above 1 it looks like another place.
    pub out_of_distribution: f64,
    /// The map that the camera is thought to be in.
    pub room: Option<usize>,
    /// The map and the frame that look most alike.
    pub best: (usize, Neighbour),
    /// Whether that corrected the pose.
    pub used: bool,
    /// Its squared Mahalanobis distance from the expected place, if one was expected.
    pub surprise: Option<f64>,
    /// A place that recent anchors speak for and that is not believed yet.
    pub candidate: Option<Candidate>,
}

/// Why a frame was not taken.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    #[error("timestamp {time_ns} ns is not later than that of the frame before, {last_ns} ns")]
    Late { time_ns: i64, last_ns: i64 },
    #[error("sequence {sequence} is not larger than that of the frame before, {last}")]
    Duplicate { sequence: u64, last: u64 },
    #[error(transparent)]
    View(#[from] crate::adapter::Error),
}

//! Queries to a navigator, and their limits.

use super::{Error, Mode, NavigatorKind, RetrievalMetric, StepKind, check_twist};
use crate::geometry::{Pose, Twist};
use crate::room::FrameId;
use crate::splits::Split;

/// The source of a query.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// A frame of the room.
    Frame(FrameId),
    /// A feature, shape (d,), from the adapter's feature source.
    Feature(Vec<f32>),
    /// A latent of the adapter, shape (k,).
    Latent(Vec<f64>),
}

/// A source and its pose, if known. For a frame, the pose in the room is used.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceAt {
    /// The frame, feature or latent.
    pub source: Source,
    /// `world_from_camera`.
    pub pose: Option<Pose>,
}

/// The requested motion.
#[derive(Debug, Clone, PartialEq)]
pub enum RequestedMotion {
    /// Consecutive motions, each in the body frame at its start; usually one.
    Twists(Vec<Twist>),
    /// The motion to a frame of the room.
    TargetFrame(FrameId),
    /// The motion to a pose, `world_from_camera`.
    TargetPose(Pose),
}

/// Pairs of the room for fitting a refit: the training pairs, or the test pairs for an in-sample
/// refit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FitOn {
    /// Split into training and test frames.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
}

/// How frames are retrieved for a motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// A step in latent space, and the nearest frames under a metric.
    Latent(StepKind, RetrievalMetric),
    /// The likelihood of the motion under the adapter's relational reader.
    Relational,
}

impl Method {
    /// The navigator of this method.
    pub fn navigator(self) -> NavigatorKind {
        match self {
            Self::Latent(step, metric) => NavigatorKind::Step(step, metric),
            Self::Relational => NavigatorKind::Relational,
        }
    }
}

/// A query to a navigator.
#[derive(Debug, Clone, PartialEq)]
pub struct Query {
    /// The source.
    pub source: SourceAt,
    /// The requested motion.
    pub motion: RequestedMotion,
    /// Number of equal steps per motion.
    pub steps: u32,
    /// How the steps are chained.
    pub mode: Mode,
    /// How frames are retrieved for a motion.
    pub method: Method,
    /// Pairs for fitting a refit.
    pub fit_on: FitOn,
    /// Frames retrieved for each step.
    pub top_k: u32,
    /// Excludes the frame that a step starts from, and this many rows to each side of it, from
    /// retrieval; `None` excludes nothing.
    pub exclude_source: Option<u32>,
}

/// Upper limits on one query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Steps of all motions in total.
    pub steps: u32,
    /// Frames per step.
    pub top_k: u32,
    /// Frames in the whole answer. The default keeps it under 4 MiB, the default message limit of
    /// gRPC clients.
    pub frames_in_answer: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            steps: 1_000,
            top_k: 1_000,
            frames_in_answer: 10_000,
        }
    }
}

impl Query {
    /// Validates everything that does not depend on a room.
    ///
    /// # Errors
    /// [`Error::NoTwist`] for an empty list of motions; [`Error::TwistNotFinite`] or
    /// [`Error::TwistBeyondPi`] for an invalid motion; [`Error::Steps`], [`Error::TopK`] or
    /// [`Error::FramesInAnswer`] for a count that is zero or over its limit.
    pub fn check(&self, limits: Limits) -> Result<(), Error> {
        let motions = match &self.motion {
            RequestedMotion::Twists(twists) => {
                if twists.is_empty() {
                    return Err(Error::NoTwist);
                }

                twists
                    .iter()
                    .enumerate()
                    .try_for_each(|(position, &twist)| check_twist(twist, position))?;

                twists.len() as u64
            }
            RequestedMotion::TargetFrame(_) | RequestedMotion::TargetPose(_) => 1,
        };

        // The limits apply to the sum over all motions.
        let actual = u64::from(self.steps).saturating_mul(motions);
        if actual == 0 || actual > u64::from(limits.steps) {
            return Err(Error::Steps {
                actual,
                most: limits.steps,
            });
        }

        if self.top_k == 0 || self.top_k > limits.top_k {
            return Err(Error::TopK {
                actual: self.top_k,
                most: limits.top_k,
            });
        }

        let in_all = actual.saturating_mul(u64::from(self.top_k));
        if in_all > limits.frames_in_answer {
            return Err(Error::FramesInAnswer {
                actual: in_all,
                most: limits.frames_in_answer,
            });
        }

        Ok(())
    }
}

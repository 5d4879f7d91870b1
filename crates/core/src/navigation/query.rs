//! The query that a navigator answers, and the limits on it.

use super::{Error, Mode, RetrievalMetric, StepKind, check_twist};
use crate::geometry::{Pose, Twist};
use crate::room::FrameId;
use crate::splits::Split;

/// What a query starts from.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// A frame of the room.
    Frame(FrameId),
    /// An encoder's feature, from the source that the adapter was trained on, shape (d,).
    Feature(Vec<f32>),
    /// A latent of the adapter, shape (k,).
    Latent(Vec<f64>),
}

/// A source together with its pose, if known; the pose of a frame is taken from the room.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceAt {
    /// The frame, feature or latent.
    pub source: Source,
    /// `world_from_camera`.
    pub pose: Option<Pose>,
}

/// Which motion is wanted.
#[derive(Debug, Clone, PartialEq)]
pub enum Displacement {
    /// Motions one after another, each in the body frame where it begins; one is the usual case.
    Twists(Vec<Twist>),
    /// The motion to a frame of the room.
    TargetFrame(FrameId),
    /// The motion to a pose, `world_from_camera`.
    TargetPose(Pose),
}

/// Which pairs of the room a refit is fitted on: the training pairs, or the test pairs for an
/// in-sample refit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FitOn {
    /// How frames are divided into training and test frames.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
}

/// A question to a navigator.
#[derive(Debug, Clone, PartialEq)]
pub struct Query {
    /// Where it starts.
    pub source: SourceAt,
    /// The motion that is wanted.
    pub displacement: Displacement,
    /// How many equal steps each motion is cut into.
    pub steps: u32,
    /// How the steps are chained.
    pub mode: Mode,
    /// How a motion becomes a latent step.
    pub step: StepKind,
    /// The distance by which frames are retrieved.
    pub metric: RetrievalMetric,
    /// What a refit is fitted on.
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
    /// Steps of all motions together.
    pub steps: u32,
    /// Frames for each step.
    pub top_k: u32,
    /// Frames in the whole answer: this keeps it under the 4 MiB that gRPC clients accept by
    /// default.
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
    /// Checks everything that can be checked without a room.
    ///
    /// # Errors
    /// [`Error::NoTwist`] for an empty list of motions; [`Error::TwistNotFinite`] or
    /// [`Error::TwistBeyondPi`] for a motion that cannot be planned; [`Error::Steps`],
    /// [`Error::TopK`] or [`Error::FramesInAnswer`] for a count that is zero or over its limit.
    pub fn check(&self, limits: Limits) -> Result<(), Error> {
        let motions = match &self.displacement {
            Displacement::Twists(twists) => {
                if twists.is_empty() {
                    return Err(Error::NoTwist);
                }

                twists
                    .iter()
                    .enumerate()
                    .try_for_each(|(position, &twist)| check_twist(twist, position))?;

                twists.len() as u64
            }
            Displacement::TargetFrame(_) | Displacement::TargetPose(_) => 1,
        };

        // The limits bound the work and the size of the answer, so the steps of all motions count.
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

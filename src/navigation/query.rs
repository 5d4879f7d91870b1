//! What a navigator is asked.

use super::{Error, Metric, Mode, StepKind, check_twist};
use crate::geometry::{Pose, Twist};
use crate::pairs::Split;
use crate::room::FrameId;

/// Where a question starts from.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// A frame of the room.
    Frame(FrameId),
    /// A raw feature of the adapter's source, shape (d,).
    Feature(Vec<f32>),
    /// A latent of the adapter, shape (k,).
    Latent(Vec<f64>),
}

/// A source with its pose, `world_from_camera`, where it is known; a frame of the room needs none.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceAt {
    /// What is seen there.
    pub source: Source,
    /// Where it is.
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
    /// How frames are kept apart.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
}

/// A question to a navigator.
#[derive(Debug, Clone, PartialEq)]
pub struct Query {
    /// Where it starts.
    pub source: SourceAt,
    /// Where it wants to go.
    pub displacement: Displacement,
    /// Equal parts of each motion.
    pub steps: u32,
    /// How the steps hang together.
    pub mode: Mode,
    /// How a motion becomes a latent step.
    pub step: StepKind,
    /// By which distance frames are near.
    pub metric: Metric,
    /// What a refit is fitted on.
    pub fit_on: FitOn,
    /// Frames for each step.
    pub hit_count: u32,
    /// Whether the frame that a step starts from may not be retrieved, and how many rows to each
    /// side of it.
    pub exclude_source: Option<u32>,
}

/// What one question may ask for at most.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Steps in all.
    pub steps: u32,
    /// Frames for each step.
    pub hits: u32,
    /// Frames in all: what keeps an answer under the 4 MiB that gRPC clients read unless told
    /// otherwise.
    pub hits_in_all: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            steps: 1_000,
            hits: 1_000,
            hits_in_all: 10_000,
        }
    }
}

impl Query {
    /// Checks what can be checked without a room.
    ///
    /// # Errors
    /// [`Error::Steps`], [`Error::HitCount`], [`Error::HitsInAll`], [`Error::NoTwist`],
    /// [`Error::TwistNotFinite`] or [`Error::TwistBeyondPi`].
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

        let actual = u64::from(self.steps).saturating_mul(motions);
        if actual == 0 || actual > u64::from(limits.steps) {
            return Err(Error::Steps {
                actual,
                most: limits.steps,
            });
        }

        if self.hit_count == 0 || self.hit_count > limits.hits {
            return Err(Error::HitCount {
                actual: self.hit_count,
                most: limits.hits,
            });
        }

        let in_all = actual.saturating_mul(u64::from(self.hit_count));
        if in_all > limits.hits_in_all {
            return Err(Error::HitsInAll {
                actual: in_all,
                most: limits.hits_in_all,
            });
        }

        Ok(())
    }
}

//! The walk: one motion, divided into equal steps in latent space.

use ndarray::{Array1, ArrayView2};
use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::{Error, Search, Stepper};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::geometry::{Pose, Twist, body_twist};
use crate::index::{Exclusion, Neighbor};
use crate::room::FrameId;

/// How the steps of one motion are chained.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
pub enum Mode {
    /// Steps add up in latent space, without feedback.
    ///
    /// Retrieved frames do not affect later steps. The paper's mode.
    OpenLoop,
    /// Each step starts from the frame that the previous step retrieved.
    Snap,
    /// As snap, and the remaining motion to the goal is replanned from the retrieved frame's pose.
    ClosedLoop,
}

impl Mode {
    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// Settings of a walk: division into steps and retrieval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// How the steps are chained.
    pub mode: Mode,
    /// Equal parts of the motion, at least 1.
    pub steps: u32,
    /// Frames retrieved for each step, at least 1.
    pub top_k: usize,
    /// Excludes the frame that a step starts from, and this many rows to each side of it, from
    /// retrieval; `None` excludes nothing.
    pub exclude_source: Option<u32>,
}

/// The data of a walk: latents (n, k) and poses of a room's frames, and the search over the
/// candidates.
#[derive(Clone, Copy)]
pub struct Space<'a> {
    /// The adapter that the latents belong to.
    pub adapter: &'a Adapter,
    /// Turns motions into latent steps.
    pub stepper: &'a Stepper,
    /// Latents, one row per frame.
    pub latents: ArrayView2<'a, f64>,
    /// `world_from_camera`, one per frame.
    pub poses: &'a [Pose],
    /// Nearest-neighbor search over the candidate frames.
    pub search: &'a Search,
}

/// Start of a walk.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// The latent.
    pub latent: Array1<f64>,
    /// The frame, if the start is a frame of the room.
    pub frame: Option<FrameId>,
    /// `world_from_camera`, if known.
    pub pose: Option<Pose>,
}

/// One step of a walk.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// ĝ, the predicted latent.
    pub latent: Array1<f64>,
    /// The frames nearest to ĝ; at least one.
    pub neighbors: Vec<Neighbor>,
}

/// One motion of a query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// The whole motion, in the body frame of the start.
    pub motion: Twist,
    /// The goal pose, `world_from_camera`, if known. Only a closed loop uses it.
    pub goal: Option<Pose>,
}

impl Mode {
    /// Start of the next step, after a step that predicted `latent` and retrieved `frame`.
    ///
    /// An open loop keeps the frame and the pose of the start, so the excluded frame stays the
    /// source. The other modes continue from the nearest retrieved frame.
    pub fn next_start(
        self,
        from: &Start,
        latent: &Array1<f64>,
        frame: FrameId,
        space: Space<'_>,
    ) -> Start {
        match self {
            Self::OpenLoop => Start {
                latent: latent.clone(),
                ..from.clone()
            },
            Self::Snap | Self::ClosedLoop => Start {
                latent: space.latents.row(frame.row()).to_owned(),
                frame: Some(frame),
                pose: Some(space.poses[frame.row()]),
            },
        }
    }
}

/// Walks a leg in `plan.steps` steps. Returns the predicted latent and the retrieved frames of each
/// step.
///
/// # Errors
/// [`Error::PoseNeeded`] for a closed loop without a goal, as when the start has no pose;
/// [`Error::NoCandidates`] when all frames are excluded; [`Error::Adapter`] when the adapter does
/// not support the stepper; [`Error::Cancelled`] when the request was cancelled.
///
/// Source: SeeSE3, Sec. A.12, multi-step navigation.
pub fn walk(
    space: Space<'_>,
    start: &Start,
    leg: Leg,
    plan: Plan,
    cancel: &Cancellation,
) -> Result<Vec<Step>, Error> {
    // Only a closed loop uses poses. The other modes ignore the goal and take equal parts of the
    // motion.
    let goal = match (plan.mode, leg.goal) {
        (Mode::ClosedLoop, None) => {
            return Err(Error::PoseNeeded {
                what: "a closed loop",
            });
        }
        (Mode::ClosedLoop, goal) => goal,
        _ => None,
    };

    let mut at = start.clone();
    let mut steps = Vec::new();
    for done in 0..plan.steps {
        cancel.check()?;

        // A closed loop divides the remaining motion by the remaining steps; the other modes always
        // take the same part of the whole motion.
        let (remaining, steps_left) = match (goal, at.pose) {
            (Some(goal), Some(pose)) => (body_twist(&pose, &goal), plan.steps - done),
            _ => (leg.motion, plan.steps),
        };

        // The fraction of μ, or of a refit's intercept, in this step; the fractions of all steps
        // add up to 1.
        let mean_share = f64::from(plan.steps).recip();
        let step = space.stepper.step(
            space.adapter,
            at.latent.view(),
            remaining.divided(steps_left),
            mean_share,
        )?;
        let latent = &at.latent + &step;

        let exclusion = plan
            .exclude_source
            .zip(at.frame)
            .map(|(radius, center)| Exclusion { center, radius });
        let neighbors = space.search.nearest(latent.view(), plan.top_k, exclusion);

        let Some(first) = neighbors.first() else {
            return Err(Error::NoCandidates {
                frame_count: space.poses.len(),
            });
        };

        at = plan.mode.next_start(&at, &latent, first.frame, space);
        steps.push(Step { latent, neighbors });
    }

    Ok(steps)
}

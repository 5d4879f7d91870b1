//! The walk: one motion, divided into equal steps in latent space.

use ndarray::{Array1, ArrayView2};
use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::{Error, Search, Stepper};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::geometry::{Pose, Twist, body_twist};
use crate::index::{Exclusion, Neighbor};
use crate::room::FrameId;

/// Steps of an open loop whose frames are retrieved between two checks for cancellation.
const TOGETHER: usize = 16;

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
    match (plan.mode, leg.goal) {
        (Mode::OpenLoop, _) => open_loop(space, start, leg, plan, cancel),
        (Mode::Snap, _) => with_feedback(space, start, leg, None, plan, cancel),
        // Only a closed loop uses poses.
        (Mode::ClosedLoop, None) => Err(Error::PoseNeeded {
            what: "a closed loop",
        }),
        (Mode::ClosedLoop, goal) => with_feedback(space, start, leg, goal, plan, cancel),
    }
}

/// Retrieves the frames of all steps together: no step depends on a retrieved frame.
fn open_loop(
    space: Space<'_>,
    start: &Start,
    leg: Leg,
    plan: Plan,
    cancel: &Cancellation,
) -> Result<Vec<Step>, Error> {
    let part = leg.motion.divided(plan.steps);
    let mut latents: Vec<Array1<f64>> = Vec::new();
    for _ in 0..plan.steps {
        cancel.check()?;
        let at = latents.last().unwrap_or(&start.latent);
        let step = space
            .stepper
            .step(space.adapter, at.view(), part, plan.mean_share())?;
        latents.push(at + &step);
    }

    let mut steps = Vec::with_capacity(latents.len());
    for latents in latents.chunks(TOGETHER) {
        cancel.check()?;
        let exclusion = plan.exclusion(start.frame);
        let queries = latents.iter().map(|latent| latent.view());
        let found = space.search.nearest_of_each(queries, plan.top_k, exclusion);
        for (latent, neighbors) in latents.iter().zip(found) {
            steps.push(Step::new(latent.clone(), neighbors, space)?);
        }
    }
    Ok(steps)
}

/// Each step starts from the frame that the last one retrieved. With a goal, the remaining motion is
/// planned anew.
fn with_feedback(
    space: Space<'_>,
    start: &Start,
    leg: Leg,
    goal: Option<Pose>,
    plan: Plan,
    cancel: &Cancellation,
) -> Result<Vec<Step>, Error> {
    let mut at = start.clone();
    let mut steps = Vec::new();
    for done in 0..plan.steps {
        cancel.check()?;

        // A closed loop divides the remaining motion by the remaining steps; snap always takes the
        // same part of the whole motion.
        let (remaining, steps_left) = match (goal, at.pose) {
            (Some(goal), Some(pose)) => (body_twist(&pose, &goal), plan.steps - done),
            _ => (leg.motion, plan.steps),
        };
        let step = space.stepper.step(
            space.adapter,
            at.latent.view(),
            remaining.divided(steps_left),
            plan.mean_share(),
        )?;
        let latent = &at.latent + &step;

        let exclusion = plan.exclusion(at.frame);
        let neighbors = space.search.nearest(latent.view(), plan.top_k, exclusion);
        let step = Step::new(latent, neighbors, space)?;

        at = plan
            .mode
            .next_start(&at, &step.latent, step.neighbors[0].frame, space);
        steps.push(step);
    }

    Ok(steps)
}

impl Plan {
    /// The fraction of μ, or of a refit's intercept, in one step; the fractions of all steps add up to 1.
    fn mean_share(&self) -> f64 {
        f64::from(self.steps).recip()
    }

    /// The frames that a step from `frame` must not retrieve.
    fn exclusion(&self, frame: Option<FrameId>) -> Option<Exclusion> {
        let excluded = self.exclude_source.zip(frame);
        excluded.map(|(radius, center)| Exclusion { center, radius })
    }
}

impl Step {
    fn new(latent: Array1<f64>, neighbors: Vec<Neighbor>, space: Space<'_>) -> Result<Self, Error> {
        if neighbors.is_empty() {
            return Err(Error::NoCandidates {
                frame_count: space.poses.len(),
            });
        }
        Ok(Self { latent, neighbors })
    }
}

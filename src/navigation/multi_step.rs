//! The walk itself: one motion, cut in equal parts, through latent space.

use ndarray::{Array1, ArrayView2};

use super::{Error, Search, Stepper};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::geometry::{Pose, Twist, body_twist};
use crate::index::{Exclusion, Neighbour};
use crate::room::FrameId;

/// How the steps of a motion hang together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// All steps are added up in latent space; frames are looked up only to be shown. The paper's.
    OpenLoop,
    /// Each step starts from the latent of the frame that the last one retrieved.
    Snap,
    /// As [`Mode::Snap`], with the motion left to the goal planned anew from the retrieved frame's
    /// pose.
    ClosedLoop,
}

impl Mode {
    /// Its name on the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::OpenLoop => "open-loop",
            Self::Snap => "snap",
            Self::ClosedLoop => "closed-loop",
        }
    }
}

/// How a motion is walked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// How the steps hang together.
    pub mode: Mode,
    /// Equal parts of the motion, at least 1.
    pub steps: u32,
    /// Frames retrieved for each step, at least 1.
    pub hit_count: usize,
    /// Whether the frame that a step starts from may not be retrieved, and how many rows to each
    /// side of it.
    pub exclude_source: Option<u32>,
}

/// Where frames are looked for: latents (n, k) of a room's frames, their poses, and the candidates.
#[derive(Clone, Copy)]
pub struct Space<'a> {
    /// Whose latents they are.
    pub adapter: &'a Adapter,
    /// Turns motions into latent steps.
    pub stepper: &'a Stepper,
    /// Row by frame.
    pub latents: ArrayView2<'a, f64>,
    /// `world_from_camera`, by frame.
    pub poses: &'a [Pose],
    /// Among the candidates.
    pub search: &'a Search,
}

/// Where a walk begins.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// The latent there.
    pub latent: Array1<f64>,
    /// The frame, if it is one of the room.
    pub frame: Option<FrameId>,
    /// `world_from_camera`, if known.
    pub pose: Option<Pose>,
}

/// One step of a walk.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// ĝ, where the step wanted to arrive.
    pub latent: Array1<f64>,
    /// The frames nearest to it; at least one.
    pub neighbours: Vec<Neighbour>,
}

/// A motion to walk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// In the body frame of the start.
    pub motion: Twist,
    /// Where it should end, `world_from_camera`, if known: what a closed loop steers to.
    pub goal: Option<Pose>,
}

/// Walks a leg.
///
/// # Errors
/// [`Error::PoseNeeded`] for a closed loop from a start without a pose, [`Error::NoCandidates`],
/// [`Error::Adapter`], [`Error::Cancelled`].
///
/// Source: SeeSE3, sec. 2.7, multi-step navigation.
pub fn walk(
    space: Space<'_>,
    start: &Start,
    leg: Leg,
    plan: Plan,
    cancel: &Cancellation,
) -> Result<Vec<Step>, Error> {
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

        let (part, parts) = match (goal, at.pose) {
            (Some(goal), Some(pose)) => (body_twist(&pose, &goal), plan.steps - done),
            _ => (leg.motion, plan.steps),
        };

        let share = f64::from(plan.steps).recip();
        let step =
            space
                .stepper
                .step(space.adapter, at.latent.view(), part.divided(parts), share)?;
        let latent = &at.latent + &step;

        let exclusion = plan
            .exclude_source
            .zip(at.frame)
            .map(|(radius, centre)| Exclusion { centre, radius });
        let neighbours = space
            .search
            .nearest(latent.view(), plan.hit_count, exclusion);

        let Some(first) = neighbours.first() else {
            return Err(Error::NoCandidates {
                frame_count: space.poses.len(),
            });
        };

        at = match plan.mode {
            Mode::OpenLoop => Start {
                latent: latent.clone(),
                ..at
            },
            Mode::Snap | Mode::ClosedLoop => Start {
                latent: space.latents.row(first.frame.row()).to_owned(),
                frame: Some(first.frame),
                pose: Some(space.poses[first.frame.row()]),
            },
        };

        steps.push(Step { latent, neighbours });
    }

    Ok(steps)
}

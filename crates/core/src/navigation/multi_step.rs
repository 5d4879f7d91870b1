//! The walk itself: one motion is cut into equal parts, which are taken one after another in latent
//! space.

use ndarray::{Array1, ArrayView2};

use super::{Error, Search, Stepper};
use crate::adapter::Adapter;
use crate::cancel::Cancellation;
use crate::geometry::{Pose, Twist, body_twist};
use crate::index::{Exclusion, Neighbour};
use crate::room::FrameId;

/// How the steps of one motion are chained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// All steps are added up in latent space; frames are retrieved only to be shown. This is the
    /// paper's mode.
    OpenLoop,
    /// Each step starts from the latent of the frame that the previous step retrieved.
    Snap,
    /// As [`Mode::Snap`], but the motion that remains to the goal is computed anew from the
    /// retrieved frame's pose.
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

/// How a motion is cut into steps, and how each step retrieves frames.
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

/// What a walk takes place in: the latents (n, k) and the poses of a room's frames, and the search
/// over the candidates.
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
    /// Nearest-neighbour search over the candidate frames.
    pub search: &'a Search,
}

/// Where a walk begins.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// The latent there.
    pub latent: Array1<f64>,
    /// The frame, if the walk starts at a frame of the room.
    pub frame: Option<FrameId>,
    /// `world_from_camera`, if known.
    pub pose: Option<Pose>,
}

/// One step of a walk.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// ĝ, the latent that the step aims at.
    pub latent: Array1<f64>,
    /// The frames nearest to it; at least one.
    pub neighbours: Vec<Neighbour>,
}

/// A motion to walk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// The whole motion, in the body frame of the start.
    pub motion: Twist,
    /// The pose where the motion should end, `world_from_camera`, if known; a closed loop steers to
    /// it.
    pub goal: Option<Pose>,
}

impl Mode {
    /// Where the step after one that aimed at `latent` and retrieved `frame` begins.
    ///
    /// An open loop never re-anchors: frame and pose stay those of the start, so that the excluded
    /// frame stays the source too. The other modes continue from the nearest retrieved frame.
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

/// Walks a leg in `plan.steps` steps and returns what each step aimed at and retrieved.
///
/// # Errors
/// [`Error::PoseNeeded`] for a closed loop whose goal is not known, as when the start has no pose;
/// [`Error::NoCandidates`] when the exclusion leaves no frame to retrieve; [`Error::Adapter`] when
/// the adapter lacks what the stepper needs; [`Error::Cancelled`] when nobody waits for the answer
/// any more.
///
/// Source: SeeSE3, Sec. A.12, multi-step navigation.
pub fn walk(
    space: Space<'_>,
    start: &Start,
    leg: Leg,
    plan: Plan,
    cancel: &Cancellation,
) -> Result<Vec<Step>, Error> {
    // Only a closed loop steers by poses. The other modes ignore the goal and take equal parts of
    // the leg's motion.
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

        // A closed loop divides the motion that remains among the steps that remain; the other
        // modes always take the same share of the whole motion.
        let (remaining, steps_left) = match (goal, at.pose) {
            (Some(goal), Some(pose)) => (body_twist(&pose, &goal), plan.steps - done),
            _ => (leg.motion, plan.steps),
        };

        // The share of μ, or of a refit's intercept, that this step takes: the shares of all steps
        // add up to one.
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
            .map(|(radius, centre)| Exclusion { centre, radius });
        let neighbours = space.search.nearest(latent.view(), plan.top_k, exclusion);

        let Some(first) = neighbours.first() else {
            return Err(Error::NoCandidates {
                frame_count: space.poses.len(),
            });
        };

        at = plan.mode.next_start(&at, &latent, first.frame, space);
        steps.push(Step { latent, neighbours });
    }

    Ok(steps)
}

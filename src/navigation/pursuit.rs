//! From where a camera is to a goal in its room, frame by frame, with feedback: what a robot's
//! planner asks for.

use std::collections::BTreeSet;

use super::{Error, Hit, Navigator, Start, Stepper};
use crate::cancel::Cancellation;
use crate::geometry::{Pose, PoseError, body_twist};
use crate::room::FrameId;

/// Frames that a step chooses among.
const CHOICE: usize = 16;

/// Times that a motion is halved where nothing nearer looks like it.
const HALVINGS: u32 = 4;

/// How a goal is pursued.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pursuit {
    /// The longest motion of a step, ‖(v, ω)‖, metres and radians mixed, above 0.
    pub step: f64,
    /// How near is there, metres.
    pub tolerance_m: f64,
    /// How near is there, radians.
    pub tolerance_rad: f64,
    /// The most steps, recoveries among them.
    pub steps: u32,
    /// The most recoveries.
    pub recoveries: u32,
}

/// What is said after each step.
#[derive(Debug, Clone, PartialEq)]
pub struct Feedback {
    /// Counted from 1; 0 before the first.
    pub step: u32,
    /// The frame that the camera would see; none before the first step from a view that is no
    /// frame.
    pub hit: Option<Hit>,
    /// How far its pose is from the goal.
    pub remaining: PoseError,
    /// Steps so far that came no nearer by the nearest frame, and had to take another.
    pub recoveries: u32,
}

/// How a pursuit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The last frame is within the tolerance.
    Reached,
    /// No frame that looks like the way on is nearer to the goal, or that happened too often.
    Stuck,
    /// The steps are spent.
    Spent,
}

/// Walks from `start`, whose pose is known, to a goal in the room's world: each step imagines a
/// part of the motion that is left, takes the frame nearest to it, and goes on from there. A step
/// whose nearest frame is not nearer to the goal recovers: it takes the best of those that look
/// alike and are; without one it tries half the motion.
///
/// # Errors
/// [`Error::PoseNeeded`] for a start without a pose, [`Error::Adapter`], [`Error::Cancelled`].
///
/// Source: the closed loop of SeeSE3, sec. 2.7, with the feedback of Nav2's NavigateToPose.
pub fn pursue(
    navigator: &Navigator,
    stepper: &Stepper,
    start: Start,
    goal: &Pose,
    pursuit: Pursuit,
    cancel: &Cancellation,
    each: &mut dyn FnMut(Feedback),
) -> Result<Outcome, Error> {
    let mut pose = start.pose.ok_or(Error::PoseNeeded { what: "a goal" })?;
    let mut latent = start.latent;
    let mut recoveries = 0;
    let mut halvings = 0;

    let mut at = None;
    let mut seen: BTreeSet<FrameId> = start.frame.into_iter().collect();

    each(Feedback {
        step: 0,
        hit: None,
        remaining: PoseError::between(&pose, goal),
        recoveries,
    });

    let mut step = 0;
    loop {
        step += 1;
        let remaining = PoseError::between(&pose, goal);
        if remaining.translation_m <= pursuit.tolerance_m
            && remaining.rotation_rad <= pursuit.tolerance_rad
        {
            return Ok(Outcome::Reached);
        }

        if recoveries > pursuit.recoveries {
            return Ok(Outcome::Stuck);
        }

        if step > pursuit.steps {
            return Ok(if halvings > 0 {
                Outcome::Stuck
            } else {
                Outcome::Spent
            });
        }

        cancel.check()?;
        let left = body_twist(&pose, goal);
        let parts = (left.norm() / pursuit.step).ceil().max(1.0) * f64::from(1u32 << halvings);

        let wanted = &latent
            + &stepper.step(
                navigator.adapter(),
                latent.view(),
                left.scaled(parts.recip()),
                parts.recip(),
            )?;

        let distance = |hit: &Hit| body_twist(&hit.pose, goal).norm();
        let nearer =
            |hit: &&Hit| distance(hit) < left.norm() && !seen.contains(&hit.neighbour.frame);
        let hits = navigator.nearest(wanted.view(), CHOICE);
        let first = hits.first().filter(nearer);

        let chosen = match first {
            Some(hit) => Some(hit),
            None => {
                recoveries += 1;
                hits.iter()
                    .filter(nearer)
                    .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            }
        };

        match chosen {
            Some(hit) => {
                pose = hit.pose;
                halvings = 0;
                at = Some(*hit);

                latent = navigator
                    .latents()
                    .row(hit.neighbour.frame.row())
                    .to_owned();

                seen.insert(hit.neighbour.frame);

                each(Feedback {
                    step,
                    hit: at,
                    remaining: PoseError::between(&pose, goal),
                    recoveries,
                });
            }
            None if halvings < HALVINGS => {
                halvings += 1;

                each(Feedback {
                    step,
                    hit: at,
                    remaining,
                    recoveries,
                });
            }
            None => return Ok(Outcome::Stuck),
        }
    }
}

impl Pursuit {
    /// Steps as long as the motions that an adapter was trained for.
    pub fn of(navigator: &Navigator) -> Self {
        let scale = navigator.adapter().scale();
        let step = (scale.mean.norm_squared() + scale.deviation.norm_squared()).sqrt();

        Self {
            step,
            tolerance_m: 0.25,
            tolerance_rad: 15_f64.to_radians(),
            steps: 100,
            recoveries: 10,
        }
    }
}

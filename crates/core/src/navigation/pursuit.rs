//! Closed-loop navigation to a goal pose, frame by frame, with feedback after each step.

use std::collections::BTreeSet;

use ndarray::Array1;

use super::{Error, Navigator, RetrievedFrame, Start, Stepper};
use crate::cancel::Cancellation;
use crate::geometry::{Pose, PoseError, Twist, body_twist};
use crate::room::FrameId;

/// Number of candidate frames retrieved per step.
const CHOICE: usize = 16;

/// Maximum number of consecutive halvings of a motion while no retrieved frame is nearer to the
/// goal.
const HALVINGS: u32 = 4;

/// Settings of a pursuit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pursuit {
    /// Maximum motion of one step, ‖(v, ω)‖ with meters and radians mixed; above 0.
    pub step: f64,
    /// Distance tolerance at the goal, meters.
    pub tolerance_m: f64,
    /// Angle tolerance at the goal, radians.
    pub tolerance_rad: f64,
    /// Maximum number of steps, including recoveries.
    pub steps: u32,
    /// Maximum number of recoveries.
    pub recoveries: u32,
}

/// Feedback before the first step and after each step.
#[derive(Debug, Clone, PartialEq)]
pub struct Feedback {
    /// Number of the step, counted from 1; 0 before the first.
    pub step: u32,
    /// The last chosen frame, the one that the camera would see; `None` before the first.
    pub frame: Option<RetrievedFrame>,
    /// The motion of the step, in the body frame of the camera before it; zero if no frame was
    /// chosen.
    pub motion: Twist,
    /// Remaining error between the camera's pose and the goal.
    pub remaining: PoseError,
    /// Number of recoveries so far: steps in which the nearest frame was no progress, so that
    /// another frame or a shorter motion was tried.
    pub recoveries: u32,
}

/// How a pursuit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The pose is within the tolerance of the goal.
    Reached,
    /// No retrieved frame is nearer to the goal even for the shortest motion, the recoveries are
    /// over the limit, or the steps ran out during halvings.
    Stuck,
    /// The steps are used up.
    Spent,
}

/// Walks from `start`, which must have a pose, to a goal pose in the room's world. Each step
/// predicts the latent after a part of the remaining motion, retrieves the nearest frames, and
/// continues from the nearest one. If that frame is not nearer to the goal, or was visited before,
/// the step recovers. It takes the unvisited retrieved frame that is nearest to the goal, if any is
/// nearer than the camera; otherwise the next step tries half the motion.
///
/// # Errors
/// [`Error::PoseNeeded`] for a start without a pose; [`Error::Adapter`] when the adapter does not
/// support the stepper; [`Error::Cancelled`] when the request was cancelled.
///
/// Source: the closed loop of SeeSE3, Sec. A.12, with the feedback of Nav2's NavigateToPose.
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

    // Visited frames are never chosen again, so that the walk cannot loop.
    let mut seen: BTreeSet<FrameId> = start.frame.into_iter().collect();

    each(Feedback {
        step: 0,
        frame: None,
        motion: Twist::default(),
        remaining: PoseError::between(&pose, goal),
        recoveries,
    });

    let mut step = 0;
    loop {
        step += 1;
        let remaining = PoseError::between(&pose, goal);
        if pursuit.is_reached(&remaining) {
            return Ok(Outcome::Reached);
        }

        if recoveries > pursuit.recoveries {
            return Ok(Outcome::Stuck);
        }

        if step > pursuit.steps {
            return Ok(out_of_steps(halvings));
        }

        cancel.check()?;

        // The remaining motion is divided into parts of at most `pursuit.step`; each consecutive
        // failed attempt halves the part.
        let left = body_twist(&pose, goal);
        let parts = (left.norm() / pursuit.step).ceil().max(1.0) * f64::from(1u32 << halvings);
        let wanted = wanted_latent(navigator, stepper, &latent, left, parts)?;
        let frames = navigator.nearest(wanted.view(), CHOICE);
        let chosen = match progress(&frames, goal, left, &seen) {
            Progress::Nearest(frame) => Some(frame),
            Progress::Recovered(frame) => {
                recoveries += 1;
                frame
            }
        };

        // Move to the pose of the chosen frame; without one, stay and try half the motion next.
        match chosen {
            Some(frame) => {
                let motion = body_twist(&pose, &frame.pose);
                pose = frame.pose;
                halvings = 0;
                at = Some(*frame);

                latent = navigator
                    .latents()
                    .row(frame.neighbor.frame.row())
                    .to_owned();

                seen.insert(frame.neighbor.frame);

                each(Feedback {
                    step,
                    frame: at,
                    motion,
                    remaining: PoseError::between(&pose, goal),
                    recoveries,
                });
            }
            None if halvings < HALVINGS => {
                halvings += 1;

                each(Feedback {
                    step,
                    frame: at,
                    motion: Twist::default(),
                    remaining,
                    recoveries,
                });
            }
            None => return Ok(Outcome::Stuck),
        }
    }
}

/// The outcome when the steps are used up: stuck during halvings, otherwise the goal is too far for
/// the steps.
fn out_of_steps(halvings: u32) -> Outcome {
    if halvings > 0 {
        Outcome::Stuck
    } else {
        Outcome::Spent
    }
}

/// The predicted latent after one of `parts` equal parts of a motion.
fn wanted_latent(
    navigator: &Navigator,
    stepper: &Stepper,
    latent: &Array1<f64>,
    motion: Twist,
    parts: f64,
) -> Result<Array1<f64>, Error> {
    let share = parts.recip();
    let step = stepper.step(
        navigator.adapter(),
        latent.view(),
        motion.scaled(share),
        share,
    )?;
    Ok(latent + &step)
}

/// The retrieved frame that brings the camera nearer to the goal.
enum Progress<'a> {
    /// The nearest frame in latent space.
    Nearest(&'a RetrievedFrame),
    /// Another retrieved frame, or `None` if no frame is progress.
    Recovered(Option<&'a RetrievedFrame>),
}

/// Selects a retrieved frame by its stored pose. The nearest frame in latent space is taken if it
/// is nearer to the goal than the camera and unvisited; otherwise the frame nearest to the goal
/// among those that are.
fn progress<'a>(
    frames: &'a [RetrievedFrame],
    goal: &Pose,
    left: Twist,
    seen: &BTreeSet<FrameId>,
) -> Progress<'a> {
    let distance = |frame: &RetrievedFrame| body_twist(&frame.pose, goal).norm();
    let is_nearer = |frame: &&RetrievedFrame| {
        distance(frame) < left.norm() && !seen.contains(&frame.neighbor.frame)
    };

    match frames.first().filter(is_nearer) {
        Some(frame) => Progress::Nearest(frame),
        None => Progress::Recovered(
            frames
                .iter()
                .filter(is_nearer)
                .min_by(|a, b| distance(a).total_cmp(&distance(b))),
        ),
    }
}

impl Pursuit {
    /// Whether the remaining error is within the tolerances.
    pub fn is_reached(&self, remaining: &PoseError) -> bool {
        remaining.translation_m <= self.tolerance_m && remaining.rotation_rad <= self.tolerance_rad
    }

    /// Default settings for a room; the step is the root mean square of the adapter's training
    /// motions.
    pub fn of(navigator: &Navigator) -> Self {
        let scale = navigator.adapter().scale();

        // E‖ξ‖² = ‖μ‖² + ‖σ‖² over the training twists ξ.
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

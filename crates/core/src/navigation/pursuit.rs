//! Closed-loop navigation to a goal pose, frame by frame, with feedback after each step: what a
//! robot's planner asks for.

use std::collections::BTreeSet;

use ndarray::Array1;

use super::{Error, Navigator, RetrievedFrame, Start, Stepper};
use crate::cancel::Cancellation;
use crate::geometry::{Pose, PoseError, Twist, body_twist};
use crate::room::FrameId;

/// Frames retrieved in each step, from which one is chosen.
const CHOICE: usize = 16;

/// How many times in a row a motion is halved while no retrieved frame is nearer to the goal.
const HALVINGS: u32 = 4;

/// How a goal is pursued.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pursuit {
    /// The longest motion of one step, ‖(v, ω)‖ with metres and radians mixed; above 0.
    pub step: f64,
    /// Distance from the goal, metres, within which it counts as reached.
    pub tolerance_m: f64,
    /// Angle from the goal, radians, within which it counts as reached.
    pub tolerance_rad: f64,
    /// The most steps, recoveries included.
    pub steps: u32,
    /// The most recoveries.
    pub recoveries: u32,
}

/// What is reported before the first step and after each one.
#[derive(Debug, Clone, PartialEq)]
pub struct Feedback {
    /// Number of the step, counted from 1; 0 before the first.
    pub step: u32,
    /// The frame chosen last, which is what the camera would see; `None` until a step has chosen
    /// one.
    pub frame: Option<RetrievedFrame>,
    /// The motion of the step, in the body frame of the camera before it; zero if it found no frame.
    pub motion: Twist,
    /// The error that remains between the camera's pose and the goal.
    pub remaining: PoseError,
    /// Steps so far whose nearest frame was no progress, so that another frame or a shorter motion
    /// was tried.
    pub recoveries: u32,
}

/// How a pursuit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The pose is within the tolerance of the goal.
    Reached,
    /// No retrieved frame is nearer to the goal even for the shortest motion, too many steps had to
    /// recover, or the steps ran out while a motion was being halved.
    Stuck,
    /// The steps are used up.
    Spent,
}

/// Walks from `start`, whose pose must be known, to a goal pose in the room's world. Each step aims
/// at a part of the motion that remains, retrieves the frames nearest to the latent it aims at, and
/// continues from the nearest one. If that frame is not nearer to the goal, or was visited before,
/// the step recovers: among the retrieved frames that are nearer and not yet visited it takes the
/// one nearest to the goal, and if there is none, the next step tries half the motion.
///
/// # Errors
/// [`Error::PoseNeeded`] for a start without a pose; [`Error::Adapter`] when the adapter lacks what
/// the stepper needs; [`Error::Cancelled`] when nobody waits for the answer any more.
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

    // Visited frames are never chosen again, so that the walk cannot go round in circles.
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

        // The remaining motion is divided into parts no longer than the longest step, and each
        // failed attempt in a row halves the part once more.
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

        // With a frame the camera moves to its pose. Without one it stays where it is, and the next
        // attempt asks for half the motion.
        match chosen {
            Some(frame) => {
                let motion = body_twist(&pose, &frame.pose);
                pose = frame.pose;
                halvings = 0;
                at = Some(*frame);

                latent = navigator
                    .latents()
                    .row(frame.neighbour.frame.row())
                    .to_owned();

                seen.insert(frame.neighbour.frame);

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

/// If the last attempts were halved motions, there was no way on; otherwise the goal is only too far
/// for so many steps.
fn out_of_steps(halvings: u32) -> Outcome {
    if halvings > 0 {
        Outcome::Stuck
    } else {
        Outcome::Spent
    }
}

/// The latent that one of `parts` equal parts of a motion leads to.
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

/// Which of the retrieved frames brings the camera nearer to the goal.
enum Progress<'a> {
    /// The nearest frame in latent space.
    Nearest(&'a RetrievedFrame),
    /// Not that one; another one, or none.
    Recovered(Option<&'a RetrievedFrame>),
}

/// The latent proposes frames; their stored poses decide. The nearest frame in latent space is
/// taken if it is progress. Otherwise the step recovers with the retrieved frame that is nearest to
/// the goal, if any is nearer than the camera now.
fn progress<'a>(
    frames: &'a [RetrievedFrame],
    goal: &Pose,
    left: Twist,
    seen: &BTreeSet<FrameId>,
) -> Progress<'a> {
    let distance = |frame: &RetrievedFrame| body_twist(&frame.pose, goal).norm();
    let is_nearer = |frame: &&RetrievedFrame| {
        distance(frame) < left.norm() && !seen.contains(&frame.neighbour.frame)
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
    /// Whether a camera this far from the goal has reached it.
    pub fn is_reached(&self, remaining: &PoseError) -> bool {
        remaining.translation_m <= self.tolerance_m && remaining.rotation_rad <= self.tolerance_rad
    }

    /// Default settings for a room; a step is as long as the root mean square of the motions that
    /// the adapter was trained on.
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

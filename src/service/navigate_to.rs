//! NavigationService.NavigateTo: walks frame by frame to a goal and sends feedback after each step.

use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::mpsc;
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::Status;
use tracing::Instrument;

use super::convert;
use super::snapshot::{ServedNavigator, Snapshot};
use super::status::view_error;
use super::workers::Lane;
use super::{Error, Handlers};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::navigate_to_request::Goal;
use seese3_client::proto::v1::navigate_to_response::Event;
use seese3_core::adapter::Reading;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::Pose;
use seese3_core::navigation::{
    Error as E, Feedback, Navigator, Outcome, Pursuit, Source, Start, Stepper, pursue,
};
use seese3_core::room::FrameId;

/// The stream of feedback events and the final result.
pub type Events = Pin<Box<dyn Stream<Item = Result<pb::NavigateToResponse, Status>> + Send>>;

/// A checked request: everything that a pursuit needs.
struct Ready {
    served: Arc<ServedNavigator>,
    start: Start,
    goal: Pose,
    pursuit: Pursuit,
}

impl Handlers {
    /// Checks a request on a worker thread and starts its pursuit.
    pub(super) async fn begin_pursuit(
        &self,
        request: tonic::Request<pb::NavigateToRequest>,
    ) -> Result<Events, Error> {
        let snapshot = self.snapshot(&request)?;
        let most = self.config.limits.steps;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();
        let lane = Lane::of(&request.source);

        let begun = Instant::now();

        // Checking may encode an image, so it runs on a worker thread and uses up part of the
        // request's time.
        let ready = self
            .workers
            .run(lane, budget, move |_| ready(&snapshot, request, most))
            .await?;

        // One feedback event before the first step, one after each, and the result all fit in the
        // channel: none is lost, and no worker thread waits for a slow reader.
        let (events, stream) = mpsc::channel(ready.pursuit.steps as usize + 2);
        let left = budget.saturating_sub(begun.elapsed());
        tokio::spawn(
            self.clone()
                .pursue(ready, left, events)
                .instrument(tracing::Span::current()),
        );

        Ok(Box::pin(ReceiverStream::new(stream)))
    }

    /// Sends feedback and then the result, or the error. Stops when the caller has gone away.
    async fn pursue(
        self,
        ready: Ready,
        budget: Duration,
        events: mpsc::Sender<Result<pb::NavigateToResponse, Status>>,
    ) {
        let heard = events.clone();
        let begun = Instant::now();

        let work = move |cancel: &Cancellation| {
            let Ready {
                served,
                start,
                goal,
                pursuit,
            } = ready;

            let stepper = Stepper::InversePoincare(Reading::Homogeneous);

            let mut each = |feedback: Feedback| {
                let feedback = feedback_to_wire(&feedback, &served, begun);

                // An error means that the caller has gone away; the `select!` below then cancels
                // the work.
                let _ = events.try_send(Ok(pb::NavigateToResponse {
                    event: Some(Event::Feedback(feedback)),
                }));
            };

            let outcome = pursue(
                &served.navigator,
                &stepper,
                start,
                &goal,
                pursuit,
                cancel,
                &mut each,
            )?;

            Ok(result_to_wire(outcome, &served))
        };

        // If the caller closes the stream, `run` is dropped, which cancels the pursuit.
        let finished = tokio::select! {
            finished = self.workers.run(Lane::Short, budget, work) => finished,
            () = heard.closed() => return,
        };
        let last = finished
            .map(|result| pb::NavigateToResponse {
                event: Some(Event::Result(result)),
            })
            .map_err(Status::from);

        // If this fails, the caller has gone away and nobody needs the result.
        let _ = heard.send(last).await;
    }
}

fn ready(
    snapshot: &Snapshot,
    request: pb::NavigateToRequest,
    most_steps: u32,
) -> Result<Ready, Error> {
    // Destructured with no `..`, so that a new field breaks the build here.
    let pb::NavigateToRequest {
        room,
        adapter,
        source,
        source_pose,
        goal,
        step,
        tolerance_m,
        tolerance_rad,
        max_steps,
        max_recoveries,
    } = request;

    let served = snapshot.navigator(&room, &adapter)?;
    let navigator = &served.navigator;
    let source = convert::source("source", source, &served.adapter, snapshot)?;
    let pose = source_pose
        .map(|pose| convert::pose(pose, &room))
        .transpose();
    let pose = pose.map_err(|error| error.within("source_pose"))?;

    // A frame's pose is recorded in the room, so that a second one could only contradict it.
    if matches!(source, Source::Frame(_)) && pose.is_some() {
        return Err(Error::invalid(
            "source_pose",
            "must be left out for a frame: its pose is recorded in the room",
        ));
    }

    let mut start = navigator
        .start(&source, pose)
        .map_err(|error| match error {
            E::Adapter(problem) => view_error(&problem).within("source"),
            other => Error::from(other),
        })?;

    // The distance to the goal needs a start pose. A view that was sent without one is placed at
    // its nearest stored frame.
    start.pose = start.pose.or_else(|| {
        navigator
            .nearest(start.latent.view(), 1)
            .first()
            .map(|frame| frame.pose)
    });

    let goal = goal_pose(goal, navigator, &room)?;
    let pursuit = bounds(
        Pursuit::of(navigator),
        Asked {
            step,
            tolerance_m,
            tolerance_rad,
            max_steps,
            max_recoveries,
        },
        most_steps,
    )?;

    Ok(Ready {
        served,
        start,
        goal,
        pursuit,
    })
}

/// Both kinds of goal, as one pose in the room's world.
fn goal_pose(goal: Option<Goal>, navigator: &Navigator, room: &str) -> Result<Pose, Error> {
    match goal {
        Some(Goal::GoalFrameId(frame)) => {
            let unknown = |_| Error::no_frame("goal_frame_id", FrameId(frame));
            Ok(*navigator.room().pose(FrameId(frame)).map_err(unknown)?)
        }
        Some(Goal::GoalPose(pose)) => {
            convert::pose(pose, room).map_err(|error| error.within("goal_pose"))
        }
        None => Err(Error::invalid(
            "goal",
            "is required: goal_frame_id or goal_pose",
        )),
    }
}

/// What a request says of the bounds of its pursuit.
struct Asked {
    step: Option<f64>,
    tolerance_m: Option<f64>,
    tolerance_rad: Option<f64>,
    max_steps: Option<u32>,
    max_recoveries: Option<u32>,
}

/// The bounds of a pursuit: what was asked for, and the room's own where nothing was.
fn bounds(own: Pursuit, asked: Asked, most_steps: u32) -> Result<Pursuit, Error> {
    let positive_or = |field: &str, given: Option<f64>, own: f64| match given {
        None => Ok(own),
        Some(given) if given.is_finite() && given > 0.0 => Ok(given),
        Some(given) => Err(Error::invalid(
            field,
            format!("must be finite and above 0, got {given}"),
        )),
    };

    // The default is lowered to the server's limit; a number that the caller asks for is refused
    // above it.
    let steps = match asked.max_steps {
        None => own.steps.min(most_steps),
        Some(steps) if (1..=most_steps).contains(&steps) => steps,
        Some(steps) => {
            return Err(Error::invalid(
                "max_steps",
                format!("must be 1 to {most_steps}, got {steps}"),
            ));
        }
    };

    Ok(Pursuit {
        step: positive_or("step", asked.step, own.step)?,
        tolerance_m: positive_or("tolerance_m", asked.tolerance_m, own.tolerance_m)?,
        tolerance_rad: positive_or("tolerance_rad", asked.tolerance_rad, own.tolerance_rad)?,
        steps,
        recoveries: asked.max_recoveries.unwrap_or(own.recoveries),
    })
}

fn feedback_to_wire(
    feedback: &Feedback,
    served: &ServedNavigator,
    begun: Instant,
) -> pb::NavigateToFeedback {
    let Feedback {
        step,
        frame,
        remaining,
        recoveries,
    } = feedback;

    pb::NavigateToFeedback {
        current_step: *step,
        current: frame
            .as_ref()
            .map(|frame| convert::retrieved_to_wire(frame, served.navigator.room())),
        distance_remaining_m: remaining.translation_m,
        rotation_remaining_rad: remaining.rotation_rad,
        number_of_recoveries: *recoveries,
        navigation_time_ns: u64::try_from(begun.elapsed().as_nanos()).unwrap_or(u64::MAX),
    }
}

fn result_to_wire(outcome: Outcome, served: &ServedNavigator) -> pb::NavigateToResult {
    let (outcome, message) = match outcome {
        Outcome::Reached => (
            pb::NavigateToOutcome::Reached,
            "the last frame is within the tolerance",
        ),
        Outcome::Stuck => (
            pb::NavigateToOutcome::Stuck,
            "no matching frame is nearer to the goal: the room may not be mapped in between",
        ),
        Outcome::Spent => (
            pb::NavigateToOutcome::StepsSpent,
            "the limit of steps was reached; allow more with max_steps",
        ),
    };

    pb::NavigateToResult {
        room: Some(convert::room_revision(served)),
        adapter: Some(convert::adapter_revision(served)),
        outcome: outcome as i32,
        message: message.to_owned(),
    }
}

//! NavigationService.NavigateTo: to a goal, with feedback.

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
use super::{Error, Handlers};
use crate::adapter::Reading;
use crate::cancel::Cancellation;
use crate::geometry::Pose;
use crate::navigation::{Error as E, Feedback, Outcome, Pursuit, Source, Start, Stepper, pursue};
use crate::proto::v1 as pb;
use crate::proto::v1::navigate_to_request::Goal;
use crate::proto::v1::navigate_to_response::Event;
use crate::room::FrameId;

/// What a caller hears.
pub type Events = Pin<Box<dyn Stream<Item = Result<pb::NavigateToResponse, Status>> + Send>>;

/// A pursuit that is ready to begin.
struct Ready {
    served: Arc<ServedNavigator>,
    start: Start,
    goal: Pose,
    pursuit: Pursuit,
}

impl Handlers {
    /// Checks a request and begins to answer it.
    pub(super) async fn begin_pursuit(
        &self,
        request: tonic::Request<pb::NavigateToRequest>,
    ) -> Result<Events, Error> {
        let snapshot = self.snapshot()?;
        let most = self.config.limits.steps;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();

        let begun = Instant::now();

        let ready = self
            .workers
            .run(budget, move |_| ready(&snapshot, request, most))
            .await?;

        // Room for every step's feedback, so that none is lost and no thread waits for a listener.
        let (events, stream) = mpsc::channel(ready.pursuit.steps as usize + 2);
        let left = budget.saturating_sub(begun.elapsed());
        tokio::spawn(
            self.clone()
                .pursue(ready, left, events)
                .instrument(tracing::Span::current()),
        );

        Ok(Box::pin(ReceiverStream::new(stream)))
    }

    /// Sends feedback and the result, or the error; stops when nobody listens any more.
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

                // An error means that nobody listens; the work is told elsewhere.
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

        let finished = tokio::select! {
            finished = self.workers.run(budget, work) => finished,
            () = heard.closed() => return,
        };
        let last = finished
            .map(|result| pb::NavigateToResponse {
                event: Some(Event::Result(result)),
            })
            .map_err(Status::from);

        // Without a listener there is nobody to tell.
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

    let served = snapshot.navigator(&room, &adapter)?.clone();
    let navigator = &served.navigator;
    let source = convert::source("source", source, &served.adapter, snapshot)?;
    let pose = source_pose
        .map(|pose| convert::pose(pose, &room))
        .transpose();
    let pose = pose.map_err(|error| error.within("source_pose"))?;

    if matches!(source, Source::Frame(_)) && pose.is_some() {
        return Err(Error::invalid(
            "source_pose",
            "is known for a frame of the room; leave it out",
        ));
    }

    let mut start = navigator
        .start(&source, pose)
        .map_err(|error| match error {
            E::Adapter(problem) => view_error(&problem).within("source"),
            other => Error::from(other),
        })?;

    // A view looks like some frame: it is there, as near as can be told.
    start.pose = start.pose.or_else(|| {
        navigator
            .nearest(start.latent.view(), 1)
            .first()
            .map(|hit| hit.pose)
    });

    let goal = match goal {
        Some(Goal::GoalFrameId(frame)) => {
            let unknown = |_| Error::NotFound {
                field: "goal_frame_id".to_owned(),
                name: FrameId(frame).to_string(),
            };
            *navigator.room().pose(FrameId(frame)).map_err(unknown)?
        }
        Some(Goal::GoalPose(pose)) => {
            convert::pose(pose, &room).map_err(|error| error.within("goal_pose"))?
        }
        None => {
            return Err(Error::invalid(
                "goal",
                "is required: goal_frame_id or goal_pose",
            ));
        }
    };

    let plain = Pursuit::of(navigator);
    let given = |field: &str, given: f64, plain: f64| match given {
        0.0 => Ok(plain),
        given if given.is_finite() && given > 0.0 => Ok(given),
        given => Err(Error::invalid(
            field,
            format!("must be finite and above 0, got {given}"),
        )),
    };

    let steps = if max_steps == 0 {
        plain.steps.min(most_steps)
    } else {
        max_steps
    };

    if steps > most_steps {
        return Err(Error::invalid(
            "max_steps",
            format!("must be at most {most_steps}, got {steps}"),
        ));
    }

    let pursuit = Pursuit {
        step: given("step", step, plain.step)?,
        tolerance_m: given("tolerance_m", tolerance_m, plain.tolerance_m)?,
        tolerance_rad: given("tolerance_rad", tolerance_rad, plain.tolerance_rad)?,
        steps,
        recoveries: max_recoveries.unwrap_or(plain.recoveries),
    };

    Ok(Ready {
        served,
        start,
        goal,
        pursuit,
    })
}

fn feedback_to_wire(
    feedback: &Feedback,
    served: &ServedNavigator,
    begun: Instant,
) -> pb::NavigateToFeedback {
    let Feedback {
        step,
        hit,
        remaining,
        recoveries,
    } = feedback;

    pb::NavigateToFeedback {
        current_step: *step,
        current: hit
            .as_ref()
            .map(|hit| convert::hit_to_wire(hit, served.navigator.room())),
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
            "no frame that looks like the way on is nearer to the goal: the room may not be mapped in between",
        ),
        Outcome::Spent => (
            pb::NavigateToOutcome::StepsSpent,
            "the steps are spent; allow more with max_steps",
        ),
    };

    pb::NavigateToResult {
        room: Some(convert::room_revision(served)),
        adapter: Some(convert::adapter_revision(served)),
        outcome: outcome as i32,
        message: message.to_owned(),
    }
}

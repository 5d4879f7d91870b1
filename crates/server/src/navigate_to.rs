//! NavigationService.NavigateTo: plans a way to a goal, frame by frame, and sends feedback after each
//! step.
//!
//! The default is the shortest way over the room's poses; the paper's latent way is on request.

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
use seese3_core::geometry::{Pose, PoseError};
use seese3_core::navigation::{
    Error as E, Feedback, Navigator, Outcome, Pursuit, Source, Start, Stepper, pursue,
};
use seese3_core::room::FrameId;
use seese3_robot::planning::{
    BelievedStart, Hops, KnownRoom, LEAST_ARRIVAL_PROBABILITY, NoRoute, Planned, Route,
    RouteBounds, StartUnknown, plan,
};
use seese3_robot::tracking::{PoseReader, PoseWithCovariance};

/// The stream of feedback events and the final result.
pub type Events = Pin<Box<dyn Stream<Item = Result<pb::NavigateToResponse, Status>> + Send>>;

/// In rooms of more frames than this, ways are planned beside batches and evaluations: a plan takes
/// some ten milliseconds there.
const MOST_SHORT_FRAMES: usize = 5_000;

/// A checked request: everything that a pursuit needs.
struct CheckedRequest {
    served: Arc<ServedNavigator>,
    /// The view, with the pose that it is believed to have.
    view: Start,
    start: BelievedStart,
    goal: Pose,
    pursuit: Pursuit,
    hops: Hops,
    least_arrival_probability: f64,
    planner: pb::Planner,
}

/// How a planning ended.
enum Ended {
    /// A walk in latent space.
    Walked(Outcome),
    /// A way over poses; of its hops as many were sent as are allowed.
    Planned(Planned),
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
        ready: CheckedRequest,
        budget: Duration,
        events: mpsc::Sender<Result<pb::NavigateToResponse, Status>>,
    ) {
        let heard = events.clone();
        let begun = Instant::now();
        let frame_count = ready.served.navigator.room().frame_count();
        let is_graph = ready.planner != pb::Planner::Latent;

        let work = move |cancel: &Cancellation| {
            let start = start_to_wire(&ready.start, &ready.served);
            let mut each = |feedback: Feedback| {
                let mut feedback = feedback_to_wire(&feedback, &ready.served, begun);
                if feedback.current_step == 0 {
                    feedback.start = Some(start.clone());
                }

                // An error means that the caller has gone away; the `select!` below then cancels
                // the work.
                let _ = events.try_send(Ok(pb::NavigateToResponse {
                    event: Some(Event::Feedback(feedback)),
                }));
            };

            let ended = ready.plan(cancel, &mut each)?;
            Ok(result_to_wire(&ended, &ready))
        };

        // The work of planning grows with the square of the number of frames.
        let lane = if is_graph && frame_count > MOST_SHORT_FRAMES {
            Lane::Long
        } else {
            Lane::Short
        };

        // If the caller closes the stream, `run` is dropped, which cancels the pursuit.
        let finished = tokio::select! {
            finished = self.workers.run(lane, budget, work) => finished,
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

impl CheckedRequest {
    /// Whether the last of some frames is within the tolerance of the goal.
    fn ends_within(&self, frames: &[FrameId]) -> bool {
        let poses = self.served.navigator.room().poses();
        frames.last().is_some_and(|frame| {
            let left = PoseError::between(&poses[frame.row()], &self.goal);
            self.pursuit.is_reached(&left)
        })
    }

    /// Plans the way; `each` hears of every step.
    fn plan(&self, cancel: &Cancellation, each: &mut dyn FnMut(Feedback)) -> Result<Ended, Error> {
        if self.planner == pb::Planner::Latent {
            let stepper = Stepper::InversePoincare(Reading::Homogeneous);
            let outcome = pursue(
                &self.served.navigator,
                &stepper,
                self.view.clone(),
                &self.goal,
                self.pursuit,
                cancel,
                each,
            )?;

            return Ok(Ended::Walked(outcome));
        }

        let navigator = &self.served.navigator;
        let bounds = RouteBounds {
            hops: self.hops,
            tolerance_m: self.pursuit.tolerance_m,
            tolerance_rad: self.pursuit.tolerance_rad,
            least_arrival_probability: self.least_arrival_probability,
        };
        let planned = plan(navigator, &self.start, &self.goal, bounds, cancel).map_err(E::from)?;

        // Where nothing is planned, it is still told where the camera is believed to be.
        let nowhere = Route::default();
        let route = match &planned {
            Planned::Way { route, .. } => route,
            Planned::StartUnknown(_) | Planned::NoRoute(_) => &nowhere,
        };
        let latent = self.view.latent.view();
        route
            .feedback(navigator, latent, &self.start.pose, &self.goal)
            .into_iter()
            .take(self.pursuit.steps as usize + 1)
            .for_each(each);

        Ok(Ended::Planned(planned))
    }
}

fn ready(
    snapshot: &Snapshot,
    request: pb::NavigateToRequest,
    most_steps: u32,
) -> Result<CheckedRequest, Error> {
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
        planner,
        least_arrival_probability,
    } = request;

    let least_arrival_probability = least_probability(least_arrival_probability)?;

    let planner = pb::Planner::try_from(planner)
        .map_err(|_| Error::invalid("planner", format!("has no value {planner}")))?;

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

    let mut view = navigator
        .start(&source, pose)
        .map_err(|error| match error {
            E::Adapter(problem) => view_error(&problem).within("source"),
            other => Error::from(other),
        })?;

    let start = believed_start(&served, &source, &view);
    view.pose = Some(start.pose);

    let goal = goal_pose(goal, navigator, &room)?;
    let own_step = Pursuit::of(navigator).step;
    let hops = step.map_or(Hops::Preferably(own_step), Hops::AtMost);
    let pursuit = bounds(
        Pursuit::of(navigator),
        PursuitOverrides {
            step,
            tolerance_m,
            tolerance_rad,
            max_steps,
            max_recoveries,
        },
        most_steps,
    )?;

    Ok(CheckedRequest {
        served,
        view,
        start,
        goal,
        pursuit,
        hops,
        least_arrival_probability,
        planner,
    })
}

/// Where the camera is believed to be: at its recorded or given pose, else where the view tells.
fn believed_start(served: &ServedNavigator, source: &Source, view: &Start) -> BelievedStart {
    let reader = served.room_reader().map(|reader| reader as &dyn PoseReader);
    let room = KnownRoom {
        navigator: &served.navigator,
        map: served.map.as_deref(),
        reader,
    };

    match (source, view.pose) {
        (Source::Frame(_), Some(pose)) => BelievedStart::recorded(pose),
        (_, Some(pose)) => BelievedStart::given(pose, room, view.latent.view()),
        (Source::Feature(feature), None) => {
            BelievedStart::seen(room, view.latent.view(), Some(feature))
        }
        (_, None) => BelievedStart::seen(room, view.latent.view(), None),
    }
}

fn least_probability(given: Option<f64>) -> Result<f64, Error> {
    let least = given.unwrap_or(LEAST_ARRIVAL_PROBABILITY);
    if (0.0..=1.0).contains(&least) {
        return Ok(least);
    }

    let problem = format!("must be 0 to 1, got {least}");
    Err(Error::invalid("least_arrival_probability", problem))
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
struct PursuitOverrides {
    step: Option<f64>,
    tolerance_m: Option<f64>,
    tolerance_rad: Option<f64>,
    max_steps: Option<u32>,
    max_recoveries: Option<u32>,
}

/// The bounds of a pursuit: what was asked for, and the room's own where nothing was.
fn bounds(own: Pursuit, asked: PursuitOverrides, most_steps: u32) -> Result<Pursuit, Error> {
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
        motion,
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
        motion: Some(convert::twist_to_wire(motion)),
        start: None,
    }
}

fn start_to_wire(start: &BelievedStart, served: &ServedNavigator) -> pb::StartOfWay {
    let room = served.navigator.room().id().as_str();
    let covariance = start.covariance.map(|covariance| {
        let belief = PoseWithCovariance {
            pose: start.pose,
            covariance,
        };
        convert::matrix_to_wire(&belief.ros_covariance())
    });

    pb::StartOfWay {
        pose: Some(convert::pose_to_wire(&start.pose, room)),
        pose_covariance: covariance.unwrap_or_default(),
        out_of_distribution: start.out_of_distribution,
    }
}

fn result_to_wire(ended: &Ended, ready: &CheckedRequest) -> pb::NavigateToResult {
    let mut result = pb::NavigateToResult {
        room: Some(convert::room_revision(&ready.served)),
        adapter: Some(convert::adapter_revision(&ready.served)),
        ..Default::default()
    };

    let most = ready.pursuit.steps as usize;
    let (outcome, message) = match ended {
        Ended::Walked(Outcome::Reached) => reached(),
        Ended::Walked(Outcome::Spent) => (
            pb::NavigateToOutcome::StepsSpent,
            "the limit of steps was reached; allow more with max_steps".to_owned(),
        ),
        Ended::Walked(Outcome::Stuck) => (
            pb::NavigateToOutcome::Stuck,
            "no matching frame is nearer to the goal; PLANNER_POSE_GRAPH may find a way".to_owned(),
        ),
        Ended::Planned(Planned::Way { route, .. })
            if route.frames.len() > most && !ready.ends_within(&route.frames[..most]) =>
        {
            (
                pb::NavigateToOutcome::StepsSpent,
                format!(
                    "the way has {} hops, max_steps is {most}; allow more, or longer ones with step",
                    route.frames.len()
                ),
            )
        }
        Ended::Planned(Planned::Way {
            route,
            arrival_probability,
        }) => {
            result.arrival_probability = *arrival_probability;
            let longest =
                route.longest_hop(&ready.start.pose, ready.served.navigator.room().poses());
            result.needed_step = Some(longest).filter(|longest| *longest > ready.pursuit.step);
            reached()
        }
        Ended::Planned(Planned::StartUnknown(why)) => {
            if let StartUnknown::Unsure {
                arrival_probability,
            } = why
            {
                result.arrival_probability = Some(*arrival_probability);
            }
            (pb::NavigateToOutcome::StartUnknown, start_unknown(why))
        }
        Ended::Planned(Planned::NoRoute(NoRoute::HopTooLong { needed })) => {
            result.needed_step = Some(*needed);
            (
                pb::NavigateToOutcome::Stuck,
                format!(
                    "every way has a hop longer than step, {:.3}; with {needed:.3} there is one",
                    ready.pursuit.step
                ),
            )
        }
        Ended::Planned(Planned::NoRoute(NoRoute::GoalNotMapped { nearest, off })) => (
            pb::NavigateToOutcome::GoalNotMapped,
            format!(
                "frame {nearest} is nearest to the goal, {:.2} m and {:.1} degrees off",
                off.translation_m,
                off.rotation_rad.to_degrees()
            ),
        ),
    };

    result.set_outcome(outcome);
    result.message = message;
    result
}

fn reached() -> (pb::NavigateToOutcome, String) {
    (
        pb::NavigateToOutcome::Reached,
        "the way ends within the tolerance".to_owned(),
    )
}

fn start_unknown(why: &StartUnknown) -> String {
    match why {
        StartUnknown::FarFromRoom {
            out_of_distribution,
        } => format!(
            "the source is {out_of_distribution:.2} times as far from the room as its limit; \
             send another view, or source_pose"
        ),
        StartUnknown::Unsure {
            arrival_probability,
        } => format!(
            "the source does not tell well enough where the camera is: it would arrive with a \
             probability of {arrival_probability:.2}; send another view or source_pose, or allow more with \
             tolerance_m and tolerance_rad"
        ),
    }
}

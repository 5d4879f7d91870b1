//! NavigationService.NavigateTo: plans a route of stored frames to a goal and streams feedback for
//! each step.
//!
//! The default planner finds the shortest path in the pose graph. The paper's latent planner is
//! optional.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::mpsc;
use tokio_stream::{Stream, wrappers::ReceiverStream};
use tonic::Status;
use tracing::Instrument;

use super::convert;
use super::cost::{frame_bytes, lane};
use super::image_view::{ImageView, Searched, ViewFields};
use super::localization::localizer;
use super::memory::MemoryLease;
use super::snapshot::{ServedNavigator, Snapshot};
use super::status::view_error;
use super::workers::{CallContext, Lane};
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
use seese3_robot::localization::{LocatedView, NotLocated, PoseEstimate};
use seese3_robot::planning::{
    BelievedStart, Hops, LEAST_ARRIVAL_PROBABILITY, NoRoute, Planned, Route, RouteBounds,
    StartUnknown, plan,
};
use seese3_robot::tracking::{MapQuery, PoseWithCovariance};

/// Stream of feedback events and the final result.
pub type Events = Pin<Box<dyn Stream<Item = Result<pb::NavigateToResponse, Status>> + Send>>;

/// In rooms with more frames than this, planning runs in the lane of long requests. It
/// takes some 10 ms at this size.
const MOST_SHORT_FRAMES: usize = 5_000;

/// A validated request, with everything that planning needs.
struct CheckedRequest {
    served: Arc<ServedNavigator>,
    /// The source view with its estimated pose.
    view: Start,
    start: BelievedStart,
    goal: Pose,
    pursuit: Pursuit,
    hops: Hops,
    least_arrival_probability: f64,
    planner: pb::Planner,
}

/// Outcome of planning.
enum Ended {
    /// By the latent planner.
    Walked(Outcome),
    /// By the pose-graph planner. At most `max_steps` hops were sent.
    Planned(Planned),
}

/// Memory of the events that the caller has not read: all of them until the response ends.
struct EventMemory {
    lease: Option<MemoryLease>,
    event_bytes: usize,
    event_count: usize,
}

impl EventMemory {
    /// Reserves memory for a route of the maximum length.
    ///
    /// # Errors
    /// [`Error::Full`] if there is no memory for it.
    fn hold(event_count: usize, event_bytes: usize) -> Result<Self, Error> {
        let lease = MemoryLease::current();
        if let Some(lease) = &lease {
            lease.hold(event_count * event_bytes)?;
        }
        Ok(Self {
            lease,
            event_bytes,
            event_count,
        })
    }

    /// Keeps the memory of `event_count` events.
    fn keep(&mut self, event_count: usize) {
        let unused = self.event_count.saturating_sub(event_count);
        if let Some(lease) = &self.lease {
            lease.release(unused * self.event_bytes);
        }
        self.event_count -= unused;
    }
}

impl Handlers {
    /// Validates a request on a worker thread and starts planning.
    pub(super) async fn begin_pursuit(
        &self,
        request: tonic::Request<pb::NavigateToRequest>,
    ) -> Result<Events, Error> {
        let snapshot = self.snapshot(&request)?;
        let most = self.config.limits.steps;
        let context = self.workers.context(&request);
        let request = request.into_inner();
        let lane = Lane::of(&request.source);

        let begun = Instant::now();

        // Validation may encode an image: it runs on a worker thread and uses part of the budget.
        let ready = self
            .workers
            .run(lane, context.clone(), move |_| {
                ready(&snapshot, request, most)
            })
            .await?;

        // All events stay in memory until the caller has read them.
        let event_count = ready.pursuit.steps as usize + 2;
        let room = ready.served.navigator.room();
        let event_bytes = size_of::<pb::NavigateToResponse>() + frame_bytes(room);
        let memory = EventMemory::hold(event_count, event_bytes)?;

        // The channel holds all events: feedback before the first step and after each step, and the
        // result. No event is lost, and no worker thread waits for a slow reader.
        let (events, stream) = mpsc::channel(event_count);
        let left = context.after(begun.elapsed());
        tokio::spawn(
            self.clone()
                .pursue(ready, left, events, memory)
                .instrument(tracing::Span::current()),
        );

        Ok(Box::pin(ReceiverStream::new(stream)))
    }

    /// Sends feedback, then the result or the error. Stops if the caller closes the stream.
    async fn pursue(
        self,
        ready: CheckedRequest,
        context: CallContext,
        events: mpsc::Sender<Result<pb::NavigateToResponse, Status>>,
        mut memory: EventMemory,
    ) {
        let caller = events.clone();
        let begun = Instant::now();
        let frame_count = ready.served.navigator.room().frame_count();
        let lane = match ready.planner {
            // Each step compares all frames.
            pb::Planner::Latent => lane(0, f64::from(ready.pursuit.steps) * frame_count as f64),
            // Planning time grows with the square of the number of frames.
            _ if frame_count > MOST_SHORT_FRAMES => Lane::Long,
            _ => Lane::Short,
        };

        let work = move |cancel: &Cancellation| {
            let start = start_to_wire(&ready.start, &ready.served);
            let mut sent = 0;
            let mut each = |feedback: Feedback| {
                sent += 1;
                let mut feedback = feedback_to_wire(&feedback, &ready.served, begun);
                if feedback.current_step == 0 {
                    feedback.start = Some(start.clone());
                }

                // `try_send` fails if the caller closed the stream; the `select!` below then
                // cancels the work.
                let _ = events.try_send(Ok(pb::NavigateToResponse {
                    event: Some(Event::Feedback(feedback)),
                }));
            };

            let ended = ready.plan(cancel, &mut each)?;
            memory.keep(sent + 1);
            Ok(result_to_wire(&ended, &ready))
        };

        // If the caller closes the stream, `run` is dropped, which cancels planning.
        let finished = tokio::select! {
            finished = self.workers.run(lane, context, work) => finished,
            () = caller.closed() => return,
        };
        let last = finished
            .map(|result| pb::NavigateToResponse {
                event: Some(Event::Result(result)),
            })
            .map_err(Status::from);

        // `send` fails if the caller closed the stream.
        let _ = caller.send(last).await;
    }
}

impl CheckedRequest {
    /// Whether the last of these frames is within the tolerances of the goal.
    fn ends_within(&self, frames: &[FrameId]) -> bool {
        let poses = self.served.navigator.room().poses();
        frames.last().is_some_and(|frame| {
            let left = PoseError::between(&poses[frame.row()], &self.goal);
            self.pursuit.is_reached(&left)
        })
    }

    /// Plans the route; calls `each` with the feedback before the first step and after each step.
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

        // Without a route, still send the feedback of the start.
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
    // Destructured without `..`, so that a new field fails to compile here.
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
        source_camera,
    } = request;

    let least_arrival_probability = least_probability(least_arrival_probability)?;

    let planner = pb::Planner::try_from(planner)
        .map_err(|_| Error::invalid("planner", format!("has no value {planner}")))?;

    let served = snapshot.navigator(&room, &adapter)?;
    let navigator = &served.navigator;
    let matched = match &source_pose {
        None => MatchedSource::of(snapshot, &served, source.as_ref(), source_camera.as_ref())?,
        Some(_) => MatchedSource::default(),
    };
    let source = match matched.feature {
        Some(feature) => Source::Feature(feature),
        None => convert::source("source", source, &served.adapter, snapshot)?,
    };
    let pose = source_pose
        .map(|pose| convert::pose(pose, &room))
        .transpose();
    let pose = pose.map_err(|error| error.within("source_pose"))?;

    // The pose of a stored frame is recorded in the room; a second one could only contradict it.
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

    let start = believed_start(&served, &source, &view, matched.found)?;
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

/// A source image whose keypoints were matched with those of the room.
#[derive(Default)]
struct MatchedSource {
    /// `None` if they were not tried.
    found: Option<Result<LocatedView, NotLocated>>,
    /// The feature of the same encoder pass, if it is that of the adapter.
    feature: Option<Vec<f32>>,
}

impl MatchedSource {
    /// Matches the source if it is an image and its camera is given.
    ///
    /// # Errors
    /// As [`ImageView::of`] and [`ImageView::matched`].
    fn of(
        snapshot: &Snapshot,
        served: &ServedNavigator,
        source: Option<&pb::View>,
        camera: Option<&pb::ViewCamera>,
    ) -> Result<Self, Error> {
        if camera.is_none() {
            return Ok(Self::default());
        }

        let fields = ViewFields {
            view: "source",
            camera: "source_camera",
        };
        let room = snapshot.room(served.navigator.room().id().as_str())?;
        let room = std::slice::from_ref(room);
        let Some(image) = ImageView::of(snapshot, fields, source, camera, room)? else {
            return Ok(Self::default());
        };

        let mut matches = image.matched(room, Searched::Named, &Cancellation::default())?;
        let located = matches.located.pop().map(|(_, view)| Ok(view));
        let unmatched = matches.unmatched.pop().map(|(_, why)| Err(why));
        let found = located.or(unmatched);

        Ok(Self {
            feature: image.feature_for(&served.adapter),
            found,
        })
    }
}

/// The start pose: recorded or given by the caller, else estimated from the view. `tried` is the
/// match of its keypoints, if they were tried.
fn believed_start(
    served: &ServedNavigator,
    source: &Source,
    view: &Start,
    tried: Option<Result<LocatedView, NotLocated>>,
) -> Result<BelievedStart, Error> {
    let query = MapQuery {
        latent: view.latent.view(),
        feature: match source {
            Source::Feature(feature) => Some(feature),
            Source::Frame(_) | Source::Latent(_) => None,
        },
    };

    match (source, view.pose, tried) {
        (Source::Frame(_), Some(pose), _) => Ok(BelievedStart::recorded(pose)),
        (_, Some(pose), _) => Ok(BelievedStart::given(pose, served.map.as_deref(), query)),
        (_, None, tried) => {
            let estimate = PoseEstimate::choose(tried, || Some(localizer(served).estimate(query)));
            BelievedStart::seen(estimate).ok_or(Error::Internal)
        }
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

/// The goal frame or goal pose as a pose in the room's world frame.
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

/// Bounds given in the request; `None` selects the default.
struct PursuitOverrides {
    step: Option<f64>,
    tolerance_m: Option<f64>,
    tolerance_rad: Option<f64>,
    max_steps: Option<u32>,
    max_recoveries: Option<u32>,
}

/// The bounds of planning: the request's overrides, else the defaults in `own`.
fn bounds(own: Pursuit, asked: PursuitOverrides, most_steps: u32) -> Result<Pursuit, Error> {
    let positive_or = |field: &str, given: Option<f64>, own: f64| match given {
        None => Ok(own),
        Some(given) if given.is_finite() && given > 0.0 => Ok(given),
        Some(given) => Err(Error::invalid(
            field,
            format!("must be finite and above 0, got {given}"),
        )),
    };

    // The default is clamped to the server's limit; a request above the limit is refused.
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
            "max_steps was reached before the goal; raise max_steps".to_owned(),
        ),
        Ended::Walked(Outcome::Stuck) => (
            pb::NavigateToOutcome::Stuck,
            "no matching frame is nearer to the goal; try PLANNER_POSE_GRAPH".to_owned(),
        ),
        Ended::Planned(Planned::Way { route, .. })
            if route.frames.len() > most && !ready.ends_within(&route.frames[..most]) =>
        {
            (
                pb::NavigateToOutcome::StepsSpent,
                format!(
                    "the route has {} hops, max_steps is {most}; raise max_steps, or step for longer hops",
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
                    "every route has a hop longer than step, {:.3}; a route exists with step {needed:.3}",
                    ready.pursuit.step
                ),
            )
        }
        Ended::Planned(Planned::NoRoute(NoRoute::GoalNotMapped { nearest, off })) => (
            pb::NavigateToOutcome::GoalNotMapped,
            format!(
                "no frame is within the tolerances of the goal; frame {nearest} is nearest to the goal, {:.2} m \
                 and {:.1} degrees off",
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
        "the route ends within the tolerances of the goal".to_owned(),
    )
}

fn start_unknown(why: &StartUnknown) -> String {
    match why {
        StartUnknown::FarFromRoom {
            out_of_distribution: None,
        } => "the source is not located in the room; send another view, or source_pose".to_owned(),
        StartUnknown::FarFromRoom {
            out_of_distribution: Some(out_of_distribution),
        } => format!(
            "the source looks like another place: out_of_distribution is {out_of_distribution:.2}, the \
             limit is 1; send another view, or source_pose"
        ),
        StartUnknown::Unsure {
            arrival_probability,
        } => format!(
            "the pose estimated from the source is too uncertain: the arrival probability is \
             {arrival_probability:.2}; send another view or source_pose, or raise tolerance_m and \
             tolerance_rad"
        ),
    }
}

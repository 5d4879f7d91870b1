//! NavigationService.PlanRoute: plans a route of stored frames to a goal.
//!
//! The default planner finds the shortest path in the pose graph. The paper's latent planner is
//! optional.

use std::sync::Arc;
use std::time::Instant;

use tonic::{Request, Response, Status};

use super::convert;
use super::cost::{frame_bytes, lane};
use super::image_view::{ImageView, Searched, ViewFields};
use super::localization::localizer;
use super::memory::hold_for_answer;
use super::snapshot::{ServedNavigator, Snapshot};
use super::status::view_error;
use super::workers::{Lane, image_count};
use super::{Error, Handlers};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::plan_route_request::Goal;
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

/// In rooms with more frames than this, planning runs in the lane of long requests. It
/// takes some 10 ms at this size.
const MOST_SHORT_FRAMES: usize = 5_000;
/// Upper bound of the encoded size of a hop without its frame, bytes.
const HOP_BYTES: usize = 100;

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
    /// By the pose-graph planner. A route may have more than `max_hops` hops.
    Planned(Planned),
}

impl Handlers {
    /// Answers a PlanRoute request on a worker thread.
    pub(super) async fn planned_route(
        &self,
        request: Request<pb::PlanRouteRequest>,
    ) -> Result<Response<pb::Route>, Status> {
        let most_hops = self.config.limits.steps;
        self.unary(
            request,
            move |costs, request| {
                let room = costs.snapshot.rooms().get(&request.room);
                let frame_count = room.map_or(0, |room| room.summary.frame_count);
                let images = image_count(&request.source);
                match request.planner() {
                    // Each step compares all frames.
                    pb::Planner::Latent => {
                        let steps = request.max_hops.unwrap_or(100).min(most_hops);
                        lane(images, f64::from(steps) * frame_count as f64)
                    }
                    // Planning time grows with the square of the number of frames.
                    _ if frame_count > MOST_SHORT_FRAMES => Lane::Long,
                    _ => lane(images, 0.0),
                }
            },
            move |snapshot, request, cancel| {
                let begun = Instant::now();
                let request = checked(snapshot, request, most_hops)?;
                let room = request.served.navigator.room();
                let hop_bytes = HOP_BYTES + frame_bytes(room);
                hold_for_answer(request.pursuit.steps as usize * hop_bytes)?;

                let (ended, feedback) = request.plan(cancel)?;
                let mut route = route_to_wire(&ended, &feedback, &request);
                route.planning_time_ns =
                    u64::try_from(begun.elapsed().as_nanos()).unwrap_or(u64::MAX);
                Ok(route)
            },
        )
        .await
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

    /// Plans the route. Also returns the feedback before the first hop and after each hop.
    fn plan(&self, cancel: &Cancellation) -> Result<(Ended, Vec<Feedback>), Error> {
        if self.planner == pb::Planner::Latent {
            let stepper = Stepper::InversePoincare(Reading::Homogeneous);
            let mut feedback = Vec::new();
            let outcome = pursue(
                &self.served.navigator,
                &stepper,
                self.view.clone(),
                &self.goal,
                self.pursuit,
                cancel,
                &mut |step| feedback.push(step),
            )?;

            return Ok((Ended::Walked(outcome), feedback));
        }

        let navigator = &self.served.navigator;
        let bounds = RouteBounds {
            hops: self.hops,
            tolerance_m: self.pursuit.tolerance_m,
            tolerance_rad: self.pursuit.tolerance_rad,
            least_arrival_probability: self.least_arrival_probability,
        };
        let planned = plan(navigator, &self.start, &self.goal, bounds, cancel).map_err(E::from)?;

        // Without a route, there is still the feedback of the start.
        let nowhere = Route::default();
        let route = match &planned {
            Planned::Way { route, .. } => route,
            Planned::StartUnknown(_) | Planned::NoRoute(_) => &nowhere,
        };
        let latent = self.view.latent.view();
        let mut feedback = route.feedback(navigator, latent, &self.start.pose, &self.goal);
        feedback.truncate(self.pursuit.steps as usize + 1);
        Ok((Ended::Planned(planned), feedback))
    }
}

fn checked(
    snapshot: &Snapshot,
    request: pb::PlanRouteRequest,
    most_hops: u32,
) -> Result<CheckedRequest, Error> {
    // Destructured without `..`, so that a new field fails to compile here.
    let pb::PlanRouteRequest {
        room,
        room_revision: _,
        adapter,
        adapter_revision: _,
        source,
        source_pose,
        camera,
        goal,
        max_hop_length,
        tolerance_m,
        tolerance_rad,
        max_hops,
        max_recoveries,
        planner,
        min_arrival_probability,
    } = request;

    let least_arrival_probability = least_probability(min_arrival_probability)?;

    let planner = pb::Planner::try_from(planner)
        .map_err(|_| Error::invalid("planner", format!("has no value {planner}")))?;
    let of_other_planner = match planner {
        pb::Planner::Latent => {
            min_arrival_probability.map(|_| ("min_arrival_probability", "PLANNER_POSE_GRAPH"))
        }
        pb::Planner::PoseGraph | pb::Planner::Unspecified => {
            max_recoveries.map(|_| ("max_recoveries", "PLANNER_LATENT"))
        }
    };
    if let Some((field, planner)) = of_other_planner {
        return Err(Error::invalid(
            field,
            format!("only counts with {planner}; leave it out"),
        ));
    }

    let adapter = convert::stated_adapter(&adapter, &source)?;
    let served = snapshot.navigator(&room, adapter)?;
    let (view, start) = start_of(
        snapshot,
        &served,
        StatedSource {
            view: source,
            pose: source_pose,
            camera,
        },
    )?;
    let navigator = &served.navigator;
    let goal = goal_pose(goal, navigator, &room)?;
    let own_step = Pursuit::of(navigator).step;
    let hops = max_hop_length.map_or(Hops::Preferably(own_step), Hops::AtMost);
    let pursuit = bounds(
        Pursuit::of(navigator),
        PursuitOverrides {
            max_hop_length,
            tolerance_m,
            tolerance_rad,
            max_hops,
            max_recoveries,
        },
        most_hops,
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

/// The source of a request.
struct StatedSource {
    view: Option<pb::View>,
    pose: Option<pb::Pose>,
    camera: Option<pb::ViewCamera>,
}

/// The source view, and the start of the route.
fn start_of(
    snapshot: &Snapshot,
    served: &ServedNavigator,
    stated: StatedSource,
) -> Result<(Start, BelievedStart), Error> {
    let navigator = &served.navigator;
    let matched = match &stated.pose {
        None => MatchedSource::of(
            snapshot,
            served,
            stated.view.as_ref(),
            stated.camera.as_ref(),
        )?,
        Some(_) => MatchedSource::default(),
    };
    let source = match matched.feature {
        Some(feature) => Source::Feature(feature),
        None => convert::source("source", stated.view, &served.adapter, snapshot)?,
    };
    let room = navigator.room().id().as_str();
    let pose = stated
        .pose
        .map(|pose| convert::pose(pose, room))
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

    let start = believed_start(served, &source, &view, matched.found)?;
    view.pose = Some(start.pose);

    Ok((view, start))
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
            camera: "camera",
        };
        let room = snapshot.room(served.navigator.room().id().as_str())?;
        let room = &[room];
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
    Err(Error::invalid("min_arrival_probability", problem))
}

/// The goal frame or goal pose as a pose in the room's world frame.
fn goal_pose(goal: Option<Goal>, navigator: &Navigator, room: &str) -> Result<Pose, Error> {
    match goal {
        Some(Goal::GoalFrameId(frame)) => {
            let frame_count = navigator.room().frame_count();
            let unknown = |_| Error::no_frame("goal_frame_id", FrameId(frame), frame_count);
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
    max_hop_length: Option<f64>,
    tolerance_m: Option<f64>,
    tolerance_rad: Option<f64>,
    max_hops: Option<u32>,
    max_recoveries: Option<u32>,
}

/// The bounds of planning: the request's overrides, else the defaults in `own`.
fn bounds(own: Pursuit, asked: PursuitOverrides, most_hops: u32) -> Result<Pursuit, Error> {
    let positive_or = |field: &str, given: Option<f64>, own: f64| match given {
        None => Ok(own),
        Some(given) if given.is_finite() && given > 0.0 => Ok(given),
        Some(given) => Err(Error::invalid(
            field,
            format!("must be finite and above 0, got {given}"),
        )),
    };

    // The default is clamped to the server's limit; a request above the limit is refused.
    let steps = match asked.max_hops {
        None => own.steps.min(most_hops),
        Some(hops) if (1..=most_hops).contains(&hops) => hops,
        Some(hops) => {
            return Err(Error::invalid(
                "max_hops",
                format!("must be 1 to {most_hops}, got {hops}"),
            ));
        }
    };

    Ok(Pursuit {
        step: positive_or("max_hop_length", asked.max_hop_length, own.step)?,
        tolerance_m: positive_or("tolerance_m", asked.tolerance_m, own.tolerance_m)?,
        tolerance_rad: positive_or("tolerance_rad", asked.tolerance_rad, own.tolerance_rad)?,
        steps,
        recoveries: asked.max_recoveries.unwrap_or(own.recoveries),
    })
}

fn hop_to_wire(feedback: &Feedback, served: &ServedNavigator) -> pb::RouteHop {
    let Feedback {
        step: _,
        frame,
        motion,
        remaining,
        recoveries,
    } = feedback;

    pb::RouteHop {
        motion: Some(convert::twist_to_wire(motion)),
        frame: frame
            .as_ref()
            .map(|frame| convert::retrieved_to_wire(frame, served.navigator.room())),
        distance_remaining_m: remaining.translation_m,
        rotation_remaining_rad: remaining.rotation_rad,
        recoveries: *recoveries,
    }
}

fn start_to_wire(start: &BelievedStart, goal: &Pose, served: &ServedNavigator) -> pb::RouteStart {
    let room = served.navigator.room().id().as_str();
    let covariance = start.covariance.map(|covariance| {
        let pose = PoseWithCovariance {
            pose: start.pose,
            covariance,
        };
        convert::matrix_to_wire(&pose.ros_covariance())
    });
    let remaining = PoseError::between(&start.pose, goal);

    pb::RouteStart {
        pose: Some(pb::PoseWithCovariance {
            pose: Some(convert::pose_to_wire(&start.pose, room)),
            covariance: covariance.unwrap_or_default(),
        }),
        novelty: start.out_of_distribution,
        distance_remaining_m: remaining.translation_m,
        rotation_remaining_rad: remaining.rotation_rad,
    }
}

fn route_to_wire(ended: &Ended, feedback: &[Feedback], request: &CheckedRequest) -> pb::Route {
    let mut wire = pb::Route {
        room: Some(convert::room_revision(&request.served)),
        adapter: Some(convert::adapter_revision(&request.served)),
        start: Some(start_to_wire(
            &request.start,
            &request.goal,
            &request.served,
        )),
        ..Default::default()
    };

    let (outcome, message) = outcome(ended, request, &mut wire);

    // The first feedback is that of the start. A robot must not drive a route that ends elsewhere.
    if outcome == pb::RouteOutcome::Found {
        let hops = feedback.iter().skip(1);
        wire.hops = hops.map(|hop| hop_to_wire(hop, &request.served)).collect();
    }
    wire.set_outcome(outcome);
    wire.message = message;
    wire
}

/// The outcome in words. Also sets the hop length and the arrival probability of `wire`.
fn outcome(
    ended: &Ended,
    request: &CheckedRequest,
    wire: &mut pb::Route,
) -> (pb::RouteOutcome, String) {
    let most = request.pursuit.steps as usize;
    match ended {
        Ended::Walked(Outcome::Reached) => found(),
        Ended::Walked(Outcome::Spent) => (
            pb::RouteOutcome::NoRoute,
            format!("the goal is more than max_hops, {most}, hops away; raise max_hops"),
        ),
        Ended::Walked(Outcome::Stuck) => (
            pb::RouteOutcome::NoRoute,
            "no matching frame is nearer to the goal; try PLANNER_POSE_GRAPH".to_owned(),
        ),
        Ended::Planned(Planned::Way { route, .. })
            if route.frames.len() > most && !request.ends_within(&route.frames[..most]) =>
        {
            (
                pb::RouteOutcome::NoRoute,
                format!(
                    "the route has {} hops, max_hops is {most}; raise max_hops, or max_hop_length for longer hops",
                    route.frames.len()
                ),
            )
        }
        Ended::Planned(Planned::Way {
            route,
            arrival_probability,
        }) => {
            wire.arrival_probability = *arrival_probability;
            let poses = request.served.navigator.room().poses();
            let longest = route.longest_hop(&request.start.pose, poses);
            wire.needed_hop_length =
                Some(longest).filter(|longest| *longest > request.pursuit.step);
            found()
        }
        Ended::Planned(Planned::StartUnknown(why)) => {
            if let StartUnknown::Unsure {
                arrival_probability,
            } = why
            {
                wire.arrival_probability = Some(*arrival_probability);
            }
            (pb::RouteOutcome::StartUnknown, start_unknown(why))
        }
        Ended::Planned(Planned::NoRoute(NoRoute::HopTooLong { needed })) => {
            wire.needed_hop_length = Some(*needed);
            (
                pb::RouteOutcome::NoRoute,
                format!(
                    "every route has a hop longer than max_hop_length, {:.3}; a route exists with {needed:.3}",
                    request.pursuit.step
                ),
            )
        }
        Ended::Planned(Planned::NoRoute(NoRoute::GoalNotMapped { nearest, off })) => (
            pb::RouteOutcome::GoalNotMapped,
            format!(
                "no frame is within the tolerances of the goal; frame {nearest} is nearest to the goal, {:.2} m \
                 and {:.1} degrees off",
                off.translation_m,
                off.rotation_rad.to_degrees()
            ),
        ),
    }
}

fn found() -> (pb::RouteOutcome, String) {
    (
        pb::RouteOutcome::Found,
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
            "the source looks like another place: its novelty is {out_of_distribution:.2}, the \
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

//! Routes over the wire.

use seese3_client::convert;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::plan_route_request::Goal;
use seese3_core::geometry::{Pose, PoseError, Twist, exp};
use seese3_server::Config;
use tonic::Code;

use crate::harness::{Unfit, feature, features_of, frame, refused, room_of, start};
use crate::tracking::start_followed;
use seese3_testing::world::served;

fn question(source: Option<pb::View>, goal: Goal) -> pb::PlanRouteRequest {
    pb::PlanRouteRequest {
        room: "synthetic".to_owned(),
        source,
        goal: Some(goal),
        ..Default::default()
    }
}

fn pose_of(given: Option<&pb::PoseWithCovariance>) -> Pose {
    convert::pose(given.unwrap().pose.as_ref().unwrap()).unwrap()
}

/// Oracle: the recorded poses: every hop's remaining distance is the one between its frame and the
/// goal, and a route that is found ends within the tolerance.
#[tokio::test]
async fn a_route_leads_to_its_goal_frame_by_frame() {
    let server = start(Config::default()).await;
    let room = room_of("synthetic", "synthetic");
    for (from, to) in [(10, 60), (100, 180), (300, 250), (480, 400)] {
        let asked = question(frame(from), Goal::GoalFrameId(to));
        let route = server.client.plan_route(asked).await.unwrap();
        assert_eq!(
            route.outcome(),
            pb::RouteOutcome::Found,
            "a recording is a way from each of its frames to each other"
        );
        assert!(route.planning_time_ns > 0);

        let goal = room.poses()[to as usize];
        for hop in &route.hops {
            let frame = hop.frame.as_ref().unwrap();
            let pose = convert::pose(frame.pose.as_ref().unwrap()).unwrap();
            let error = PoseError::between(&pose, &goal);

            assert!((error.translation_m - hop.distance_remaining_m).abs() < 1e-12);
            assert!((error.rotation_rad - hop.rotation_remaining_rad).abs() < 1e-12);
        }

        let start = route.start.unwrap();
        let off = PoseError::between(&room.poses()[from as usize], &goal);
        assert!((off.translation_m - start.distance_remaining_m).abs() < 1e-12);
        assert!((off.rotation_rad - start.rotation_remaining_rad).abs() < 1e-12);

        let last = route.hops.last().unwrap();
        assert!(last.distance_remaining_m <= 0.25);
        assert!(last.rotation_remaining_rad <= 15_f64.to_radians());
    }
}

/// Oracle: composition: the start moved by the motions of all hops is the pose of the last frame,
/// and no motion is longer than the hop length that was asked for. What cannot be reached in such
/// hops can be in hops as long as the answer says.
#[tokio::test]
async fn a_route_is_driven_by_its_motions() {
    let server = start(Config::default()).await;
    let room = room_of("synthetic", "synthetic");
    let goal = 300;
    let ask = async |max_hop_length: Option<f64>| {
        let asked = pb::PlanRouteRequest {
            max_hop_length,
            ..question(frame(10), Goal::GoalFrameId(goal))
        };
        server.client.plan_route(asked).await.unwrap()
    };

    let none = ask(Some(1e-3)).await;
    let message = &none.message;
    assert_eq!(none.outcome(), pb::RouteOutcome::NoRoute, "{message}");
    assert!(none.hops.is_empty() && none.start.is_some());
    let needed = none.needed_hop_length.unwrap();

    let shorter = ask(Some(needed * 0.999)).await;
    assert_eq!(shorter.outcome(), pb::RouteOutcome::NoRoute);

    let found = ask(Some(needed)).await;
    let message = &found.message;
    assert_eq!(found.outcome(), pb::RouteOutcome::Found, "{message}");
    assert_eq!(found.needed_hop_length, None);

    let start = found.start.unwrap();
    let mut at = pose_of(start.pose.as_ref());
    let begins = PoseError::between(&at, &room.poses()[10]);
    assert!(begins.translation_m < 1e-12 && begins.rotation_rad < 1e-7);
    assert!(start.pose.unwrap().covariance.is_empty() && start.novelty.is_none());
    for hop in &found.hops {
        let motion = convert::twist(&hop.motion.unwrap()).unwrap();
        let motion = Twist {
            linear: motion.linear,
            angular: motion.angular,
        };
        assert!(motion.norm() <= needed);
        at *= exp(&motion);
    }
    let last = found.hops.last().unwrap().frame.clone().unwrap();
    let error = PoseError::between(&at, &room.poses()[last.frame_id as usize]);
    assert!(
        error.translation_m < 1e-9 && error.rotation_rad < 1e-9,
        "{error:?}"
    );
}

/// Oracle: the definitions: a goal beside no frame, and a planner that does not exist.
#[tokio::test]
async fn a_goal_has_to_be_mapped() {
    let server = start(Config::default()).await;
    let room = room_of("synthetic", "synthetic");
    let mut far = room.poses()[0];
    far.translation.vector.x += 100.0;
    let nowhere = convert::pose_to_wire(&far, "rooms/synthetic", "");

    let asked = question(frame(10), Goal::GoalPose(nowhere));
    let route = server.client.plan_route(asked).await.unwrap();
    assert_eq!(route.outcome(), pb::RouteOutcome::GoalNotMapped);
    let message = &route.message;
    assert!(message.contains("nearest to the goal"), "{message}");

    let unknown = pb::PlanRouteRequest {
        planner: 77,
        ..question(frame(1), Goal::GoalFrameId(2))
    };
    let error = server.client.plan_route(unknown).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::InvalidArgument));
    assert!(error.to_string().contains("planner"), "{error}");
}

/// Oracle: the definition: a route that was found without recoveries has none, and some goals are
/// reached only with them.
#[tokio::test]
async fn the_latent_planner_recovers_as_often_as_it_may() {
    let server = start(Config::default()).await;
    let mut found = [0, 0];
    let mut recovered = 0;

    for from in (10..500).step_by(35) {
        for (nth, max_recoveries) in [0, 50].into_iter().enumerate() {
            let asked = pb::PlanRouteRequest {
                max_recoveries: Some(max_recoveries),
                planner: pb::Planner::Latent as i32,
                ..question(frame(from), Goal::GoalFrameId(from + 60))
            };
            let route = server.client.plan_route(asked).await.unwrap();
            let count = route.hops.last().map_or(0, |last| last.recoveries);
            assert!(count <= max_recoveries, "{from}: {count}");

            found[nth] += usize::from(route.outcome() == pb::RouteOutcome::Found);
            recovered += usize::from(count > 0);
        }
    }

    assert!(
        found[1] > found[0] && recovered > 0,
        "{found:?}, {recovered}: the test shows nothing"
    );
}

/// Oracle: the definitions of the bounds.
#[tokio::test]
async fn a_route_keeps_to_its_bounds() {
    let server = start(Config::default()).await;
    let plan = async |request| server.client.plan_route(request).await.unwrap();
    let here = plan(question(frame(10), Goal::GoalFrameId(10))).await;
    assert_eq!(
        here.outcome(),
        pb::RouteOutcome::Found,
        "it is there already"
    );
    assert!(here.hops.is_empty());

    let asked = pb::PlanRouteRequest {
        max_hops: Some(1),
        max_hop_length: Some(0.2),
        tolerance_m: Some(1e-6),
        tolerance_rad: Some(1e-6),
        ..question(frame(10), Goal::GoalFrameId(300))
    };
    let short = plan(asked.clone()).await;
    assert_eq!(short.outcome(), pb::RouteOutcome::NoRoute);
    assert!(short.message.contains("max_hops") && short.hops.is_empty());
    let whole = plan(pb::PlanRouteRequest {
        max_hops: None,
        ..asked
    });
    assert!(whole.await.hops.len() > 1);

    let seen = feature(features_of("synthetic").rows().row(40).to_vec());
    let near = plan(question(seen, Goal::GoalFrameId(40))).await;
    let outcome = near.outcome();
    assert_eq!(
        outcome,
        pb::RouteOutcome::Found,
        "a view is where the frame like it is"
    );

    let request = || question(frame(1), Goal::GoalFrameId(2));
    let cases: [Unfit<pb::PlanRouteRequest>; 9] = [
        (|r| r.goal = None, "goal"),
        (|r| r.source = None, "source"),
        (
            |r| r.goal = Some(Goal::GoalPose(pb::Pose::default())),
            "goal_pose.orientation",
        ),
        (|r| r.max_hop_length = Some(f64::NAN), "max_hop_length"),
        (|r| r.tolerance_m = Some(0.0), "tolerance_m"),
        (|r| r.max_hops = Some(0), "max_hops"),
        (|r| r.max_hops = Some(u32::MAX), "max_hops"),
        (|r| r.max_recoveries = Some(1), "max_recoveries"),
        (
            |r| {
                r.min_arrival_probability = Some(0.5);
                r.set_planner(pb::Planner::Latent);
            },
            "min_arrival_probability",
        ),
    ];
    for (spoil, field) in cases {
        let mut spoiled = request();
        spoil(&mut spoiled);
        let answer = server.client.plan_route(spoiled).await;
        refused(field, answer, Code::InvalidArgument, field);
    }
    let unknown = question(frame(1), Goal::GoalFrameId(99_999));
    let answer = server.client.plan_route(unknown).await;
    refused("unknown frame", answer, Code::NotFound, "goal_frame_id");
}

/// Oracle: the worlds of the test: an attic is not the hall, and a frame of the hall stands where
/// it was recorded.
#[tokio::test]
async fn a_view_of_no_place_starts_no_route() {
    let server = start_followed(Config::default()).await;
    let ask = async |room_seen: &str, source_pose: Option<pb::Pose>| {
        let asked = pb::PlanRouteRequest {
            room: "hall".to_owned(),
            source: feature(served(room_seen).1.rows().row(40).to_vec()),
            source_pose,
            goal: Some(Goal::GoalFrameId(120)),
            ..Default::default()
        };
        server.client.plan_route(asked).await.unwrap()
    };

    let own = ask("hall", None).await;
    assert_eq!(own.outcome(), pb::RouteOutcome::Found, "{}", own.message);
    let probability = own.arrival_probability.unwrap();
    assert!((0.2..=1.0).contains(&probability), "{probability}");

    let start = own.start.unwrap();
    assert_eq!(start.pose.as_ref().unwrap().covariance.len(), 36);
    assert!(start.novelty.unwrap() <= 1.0);
    let off = PoseError::between(&pose_of(start.pose.as_ref()), &served("hall").0.poses()[40]);
    assert!(off.translation_m < 0.05, "{off:?}");

    let other = ask("attic", None).await;
    assert_eq!(other.outcome(), pb::RouteOutcome::StartUnknown);
    assert!(other.hops.is_empty(), "nothing is planned");
    assert!(other.message.contains("source"), "{}", other.message);

    // The caller may know better.
    let given = convert::pose_to_wire(&served("hall").0.poses()[40], "rooms/hall", "");
    let given = ask("attic", Some(given)).await;
    assert_eq!(given.outcome(), pb::RouteOutcome::Found);
    assert_eq!(given.arrival_probability, None);
    assert!(given.start.unwrap().novelty.unwrap() > 1.0);
}

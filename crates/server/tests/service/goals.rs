//! Walking to a goal over the wire.

use seese3_client::convert;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::navigate_to_request::Goal;
use seese3_core::geometry::{PoseError, Twist, exp};
use seese3_server::Config;
use tonic::Code;

use crate::harness::{feature, features_of, frame, room_of, start};
use crate::tracking::start_followed;
use seese3_testing::world::served;

fn question(source: Option<pb::View>, goal: Goal) -> pb::NavigateToRequest {
    pb::NavigateToRequest {
        room: "synthetic".to_owned(),
        source,
        goal: Some(goal),
        ..Default::default()
    }
}

/// Oracle: the recorded poses: every step's distance is the one between its frame and the goal, and
/// what is called reached is within the tolerance.
#[tokio::test]
async fn a_goal_is_reached_frame_by_frame() {
    let server = start(Config::default()).await;
    let room = room_of("synthetic", "synthetic");
    let mut reached = 0;
    for (from, to) in [(10, 60), (100, 180), (300, 250), (480, 400)] {
        let mut steps = Vec::new();
        let asked = question(frame(from), Goal::GoalFrameId(to));
        let result = server
            .client
            .navigate_to(asked, |step| steps.push(step))
            .await
            .unwrap();

        let goal = room.poses()[to as usize];
        for (number, step) in steps.iter().enumerate() {
            assert!(step.current_step as usize >= number && step.navigation_time_ns > 0);

            let Some(hit) = &step.current else { continue };
            let pose = convert::pose(&hit.pose.clone().unwrap()).unwrap();
            let error = PoseError::between(&pose, &goal);

            assert!((error.translation_m - step.distance_remaining_m).abs() < 1e-12);
            assert!((error.rotation_rad - step.rotation_remaining_rad).abs() < 1e-12);
        }

        assert!(steps[0].current.is_none() && steps[0].current_step == 0);

        let last = steps.last().unwrap();
        if result.outcome() == pb::NavigateToOutcome::Reached {
            reached += 1;

            assert!(
                last.distance_remaining_m <= 0.25
                    && last.rotation_remaining_rad <= 15_f64.to_radians()
            );
        } else {
            assert!(!result.message.is_empty());
        }
    }

    assert_eq!(
        reached, 4,
        "a recording is a way from each of its frames to each other"
    );
}

/// Oracle: composition: the start moved by the motions of all steps is the pose of the last frame,
/// and no motion is longer than the step that was asked for. What cannot be reached in such steps
/// can be in steps as long as the answer says.
#[tokio::test]
async fn a_way_is_driven_by_its_motions() {
    let server = start(Config::default()).await;
    let room = room_of("synthetic", "synthetic");
    let goal = 300;
    let ask = async |step: Option<f64>| {
        let asked = pb::NavigateToRequest {
            step,
            ..question(frame(10), Goal::GoalFrameId(goal))
        };
        let mut steps = Vec::new();
        let result = server
            .client
            .navigate_to(asked, |step| steps.push(step))
            .await
            .unwrap();
        (result, steps)
    };

    let (stuck, steps) = ask(Some(1e-3)).await;
    assert_eq!(
        stuck.outcome(),
        pb::NavigateToOutcome::Stuck,
        "{}",
        stuck.message
    );
    assert_eq!(steps.len(), 1, "the start alone");
    let needed = stuck.needed_step.unwrap();

    let (shorter, _) = ask(Some(needed * 0.999)).await;
    assert_eq!(shorter.outcome(), pb::NavigateToOutcome::Stuck);

    let (found, steps) = ask(Some(needed)).await;
    assert_eq!(
        found.outcome(),
        pb::NavigateToOutcome::Reached,
        "{}",
        found.message
    );
    assert_eq!(found.needed_step, None);

    let begun = steps[0].start.clone().unwrap();
    let mut at = convert::pose(&begun.pose.unwrap()).unwrap();
    let begins = PoseError::between(&at, &room.poses()[10]);
    assert!(begins.translation_m < 1e-12 && begins.rotation_rad < 1e-7);
    assert!(begun.pose_covariance.is_empty() && begun.out_of_distribution.is_none());
    for step in &steps[1..] {
        let motion = convert::twist(&step.motion.unwrap()).unwrap();
        let motion = Twist {
            linear: motion.linear,
            angular: motion.angular,
        };
        assert!(motion.norm() <= needed && step.start.is_none());
        at *= exp(&motion);
    }
    let last = steps.last().unwrap().current.clone().unwrap();
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

    let result = server
        .client
        .navigate_to(question(frame(10), Goal::GoalPose(nowhere)), |_| ())
        .await
        .unwrap();
    assert_eq!(result.outcome(), pb::NavigateToOutcome::GoalNotMapped);
    assert!(
        result.message.contains("nearest to the goal"),
        "{}",
        result.message
    );

    let unknown = pb::NavigateToRequest {
        planner: 77,
        ..question(frame(1), Goal::GoalFrameId(2))
    };
    let error = server
        .client
        .navigate_to(unknown, |_| ())
        .await
        .unwrap_err();
    assert_eq!(error.code(), Some(Code::InvalidArgument));
    assert!(error.to_string().contains("planner"), "{error}");
}

/// Oracle: the definition: the first recovery is the last step where none is allowed, and a pursuit
/// that is allowed more goes on.
#[tokio::test]
async fn a_pursuit_recovers_as_often_as_it_may() {
    let server = start(Config::default()).await;
    let mut stopped = 0;
    let mut went_on = 0;

    for (from, to) in [(10, 300), (100, 400), (300, 20), (480, 100), (250, 450)] {
        for max_recoveries in [0, 50] {
            let asked = pb::NavigateToRequest {
                max_recoveries: Some(max_recoveries),
                planner: pb::Planner::Latent as i32,
                ..question(frame(from), Goal::GoalFrameId(to))
            };
            let mut recoveries = Vec::new();
            let result = server
                .client
                .navigate_to(asked, |step| recoveries.push(step.number_of_recoveries))
                .await
                .unwrap();

            let recovered = recoveries.iter().filter(|&&count| count > 0).count();
            if max_recoveries == 0 {
                assert!(recovered <= 1, "{from} to {to}: {recoveries:?}");
                let is_stuck = result.outcome() == pb::NavigateToOutcome::Stuck;
                stopped += usize::from(recovered == 1 && is_stuck);
            } else {
                went_on += usize::from(recovered > 1);
            }
        }
    }

    assert!(
        stopped > 0 && went_on > 0,
        "{stopped} pursuits were stopped by a recovery, {went_on} went on: the test shows nothing"
    );
}

/// Oracle: the definitions of the bounds.
#[tokio::test]
async fn a_pursuit_ends_at_its_bounds() {
    let server = start(Config::default()).await;
    let here = server
        .client
        .navigate_to(question(frame(10), Goal::GoalFrameId(10)), |_| ())
        .await
        .unwrap();

    assert_eq!(
        here.outcome(),
        pb::NavigateToOutcome::Reached,
        "it is there already"
    );

    let asked = pb::NavigateToRequest {
        max_steps: Some(1),
        step: Some(0.2),
        tolerance_m: Some(1e-6),
        tolerance_rad: Some(1e-6),
        ..question(frame(10), Goal::GoalFrameId(300))
    };
    let mut steps = Vec::new();
    let spent = server
        .client
        .navigate_to(asked, |step| steps.push(step.current_step))
        .await
        .unwrap();
    assert_eq!(spent.outcome(), pb::NavigateToOutcome::StepsSpent);
    assert_eq!(steps, [0, 1], "the start, and the one step that is allowed");

    let seen = feature(features_of("synthetic").rows().row(40).to_vec());
    let near = server
        .client
        .navigate_to(question(seen, Goal::GoalFrameId(40)), |_| ())
        .await
        .unwrap();

    assert_eq!(
        near.outcome(),
        pb::NavigateToOutcome::Reached,
        "a view is where the frame like it is"
    );

    for (request, code, word) in [
        (
            pb::NavigateToRequest {
                goal: None,
                ..question(frame(1), Goal::GoalFrameId(2))
            },
            Code::InvalidArgument,
            "goal",
        ),
        (
            question(None, Goal::GoalFrameId(2)),
            Code::InvalidArgument,
            "source",
        ),
        (
            question(frame(1), Goal::GoalFrameId(99_999)),
            Code::NotFound,
            "goal_frame_id",
        ),
        (
            question(frame(1), Goal::GoalPose(pb::Pose::default())),
            Code::InvalidArgument,
            "goal_pose",
        ),
        (
            pb::NavigateToRequest {
                step: Some(f64::NAN),
                ..question(frame(1), Goal::GoalFrameId(2))
            },
            Code::InvalidArgument,
            "step",
        ),
        (
            pb::NavigateToRequest {
                tolerance_m: Some(0.0),
                ..question(frame(1), Goal::GoalFrameId(2))
            },
            Code::InvalidArgument,
            "tolerance_m",
        ),
        (
            pb::NavigateToRequest {
                max_steps: Some(0),
                ..question(frame(1), Goal::GoalFrameId(2))
            },
            Code::InvalidArgument,
            "max_steps",
        ),
        (
            pb::NavigateToRequest {
                max_steps: Some(u32::MAX),
                ..question(frame(1), Goal::GoalFrameId(2))
            },
            Code::InvalidArgument,
            "max_steps",
        ),
    ] {
        let error = server
            .client
            .navigate_to(request, |_| ())
            .await
            .unwrap_err();

        assert_eq!(error.code(), Some(code), "{error}");

        assert!(
            error.to_string().contains(word),
            "{error} does not say {word}"
        );
    }
}

/// Oracle: the worlds of the test: an attic is not the hall, and a frame of the hall stands where
/// it was recorded.
#[tokio::test]
async fn a_view_that_tells_no_place_starts_no_way() {
    let server = start_followed(Config::default()).await;
    let ask = async |room_seen: &str, source_pose: Option<pb::Pose>| {
        let asked = pb::NavigateToRequest {
            room: "hall".to_owned(),
            source: feature(served(room_seen).1.rows().row(40).to_vec()),
            source_pose,
            goal: Some(Goal::GoalFrameId(120)),
            ..Default::default()
        };
        let mut steps = Vec::new();
        let result = server
            .client
            .navigate_to(asked, |step| steps.push(step))
            .await
            .unwrap();
        (result, steps)
    };

    let (own, steps) = ask("hall", None).await;
    assert_eq!(
        own.outcome(),
        pb::NavigateToOutcome::Reached,
        "{}",
        own.message
    );
    let probability = own.arrival_probability.unwrap();
    assert!((0.2..=1.0).contains(&probability), "{probability}");

    let begun = steps[0].start.clone().unwrap();
    assert_eq!(begun.pose_covariance.len(), 36);
    assert!(begun.out_of_distribution.unwrap() <= 1.0);
    let pose = convert::pose(&begun.pose.unwrap()).unwrap();
    let off = PoseError::between(&pose, &served("hall").0.poses()[40]);
    assert!(off.translation_m < 0.05, "{off:?}");

    let (other, steps) = ask("attic", None).await;
    assert_eq!(other.outcome(), pb::NavigateToOutcome::StartUnknown);
    assert_eq!(steps.len(), 1, "nothing is planned");
    assert!(other.message.contains("source"), "{}", other.message);

    // The caller may know better.
    let given = convert::pose_to_wire(&served("hall").0.poses()[40], "rooms/hall", "");
    let (given, steps) = ask("attic", Some(given)).await;
    assert_eq!(given.outcome(), pb::NavigateToOutcome::Reached);
    assert_eq!(given.arrival_probability, None);
    assert!(steps[0].start.clone().unwrap().out_of_distribution.unwrap() > 1.0);
}

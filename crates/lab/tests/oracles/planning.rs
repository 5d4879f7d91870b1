//! Ways to a goal, and streams of disturbed cameras, in made-up places.

use std::sync::Arc;

use ndarray::Axis;
use seese3_core::adapter::Adapter;
use seese3_core::features::Features;
use seese3_core::room::Room;
use seese3_core::splits::HoldOut;
use seese3_core::statistics::coverage;
use seese3_core::training::RoomData;
use seese3_lab::experiments::odometry;
use seese3_lab::experiments::planning::{self, Planner, PlannerScores, PlanningProtocol};
use seese3_lab::experiments::robustness::{Disturbance, DisturbedTracking};
use seese3_lab::experiments::tracked_room::{DisturbedViews, TrackedRoom, TrackingProtocol};
use seese3_robot::pose_filter::FilterParameters;

use seese3_testing::world::{calibrated, served};

fn data<'a>(room: &'a Room, features: &'a Features) -> RoomData<'a> {
    RoomData {
        room,
        revision: 1,
        features,
    }
}

/// Oracle: the definitions of the simple planners. A pose graph takes any view for its room; a
/// robot that stands still says that it is there and mostly is not. Ours refuses some views of
/// other rooms, and no planner is there more often, the pose graph included, which is there more
/// often than a robot that stands still.
#[test]
fn planners_say_what_they_know() {
    let adapter = Arc::new(calibrated().0);
    let rooms = [served("hall"), served("attic")];
    let rooms: Vec<RoomData<'_>> = rooms
        .iter()
        .map(|(room, features)| data(room, features))
        .collect();
    let protocol = PlanningProtocol {
        hold_out: HoldOut::Interleaved,
        questions: 60,
        longest_hop: None,
        seed: 5,
        is_fitted: false,
    };

    let found = planning::evaluate(&rooms, &adapter, &protocol, &|| ()).unwrap();
    let of = |planner: Planner| PlannerScores::sum(found.iter().map(|room| &room.scores[&planner]));
    let ours = of(Planner::Ours);
    let graph = of(Planner::PoseGraph);
    let still = of(Planner::StandingStill);

    assert_eq!(ours.questions, 120);
    assert!(ours.truly_there <= ours.says_reached);
    assert!(
        ours.other_says_reached < graph.other_says_reached,
        "{ours:?}"
    );
    assert_eq!(graph.other_says_reached, graph.other_questions);
    assert_eq!(still.says_reached, 120);
    assert!(still.truly_there < 60 && still.steps == 0, "{still:?}");
    assert!(graph.truly_there > still.truly_there, "{graph:?}");
    for planner in Planner::ALL {
        assert!(of(planner).truly_there <= ours.truly_there, "{planner:?}");
    }
}

fn disturbed(
    room: &TrackedRoom<'_>,
    disturbance: Disturbance,
    is_blank: bool,
) -> DisturbedTracking {
    let tracked = HoldOut::Interleaved.tracked(room.room().timeline());
    let rows: Vec<usize> = tracked.iter().map(|frame| frame.row()).collect();
    let features = room.features().select(Axis(0), &rows);
    let views = DisturbedViews {
        features: features.view(),
        is_blank: &vec![is_blank; rows.len()],
        keypoints: &[],
    };

    room.track_disturbed(disturbance, views).unwrap()
}

fn tracked<'a>(room: &'a (Room, Features), adapter: &Arc<Adapter>) -> Vec<TrackedRoom<'a>> {
    let protocol = TrackingProtocol {
        hold_out: HoldOut::Interleaved,
        parameters: FilterParameters::default(),
        is_fitted: false,
    };
    let data = data(&room.0, &room.1);
    vec![TrackedRoom::by_adapter(&data, adapter, &protocol).unwrap()]
}

/// Oracle: the replay that `evaluate odometry` makes of the same frames.
#[test]
fn an_undisturbed_camera_is_tracked_as_ever() {
    let adapter = Arc::new(calibrated().0);
    let hall = served("hall");
    let rooms = tracked(&hall, &adapter);

    let ever = odometry::evaluate(&rooms, &|_, _| ()).unwrap();
    let plain = disturbed(&rooms[0], Disturbance::None, false);
    assert_eq!(plain.scores, ever[0].scores);
    assert_eq!(plain.statuses, ever[0].statuses);
    assert_eq!(plain.noticed_after, None);
}

/// Oracle: the scores of the same replay, which other code computes.
#[test]
fn intervals_contain_the_scores() {
    let adapter = Arc::new(calibrated().0);
    let hall = served("hall");
    let found = odometry::evaluate(&tracked(&hall, &adapter), &|_, _| ()).unwrap();
    let found = &found[0];
    let intervals = found.intervals_95.unwrap();

    let (scores, velocity) = (&found.scores, found.scores.velocity);
    let covered = coverage(&scores.tracking_surprises);
    let pairs = [
        (scores.ape.fused, intervals.fused_m),
        (scores.ape.nearest_frame, intervals.nearest_frame_m),
        (found.statuses.tracking, intervals.tracking),
        (f64::from(scores.tracking_wrong), intervals.tracking_wrong),
        (covered.within_68, intervals.coverage_68),
        (covered.within_95, intervals.coverage_95),
        (
            velocity.error_m_s / velocity.zero_m_s,
            intervals.velocity_ratio,
        ),
    ];
    for (number, (score, [least, most])) in pairs.into_iter().enumerate() {
        assert!(
            least <= score && score <= most,
            "{number}: {score}, {least} to {most}"
        );
    }
}

/// Oracle: the rules: a blank image is noticed at once, a frozen camera at the sixth image that is
/// the same or before. A camera that takes every fourth frame answers a fourth of them.
#[test]
fn a_disturbance_is_scored_while_it_is_there() {
    let adapter = Arc::new(calibrated().0);
    let hall = served("hall");
    let rooms = tracked(&hall, &adapter);
    let tracked = HoldOut::Interleaved.tracked(hall.0.timeline()).len();

    let black = disturbed(&rooms[0], Disturbance::Blank { brightness: 0 }, true);
    assert_eq!(black.noticed_after, Some(1));
    assert_eq!(black.frames, (tracked / 3).min(60));

    let frozen = disturbed(&rooms[0], Disturbance::Frozen, false);
    assert!(frozen.noticed_after.is_some_and(|frames| frames <= 6));

    let plain = disturbed(&rooms[0], Disturbance::None, false);
    let slow = disturbed(&rooms[0], Disturbance::Rate { every: 4 }, false);
    assert_eq!(slow.frames, plain.frames.div_ceil(4));
}

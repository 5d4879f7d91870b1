//! Following a camera through a made-up place, without a server.

use std::sync::Arc;

use nalgebra::Translation3;
use ndarray::Array1;
use seese3_core::adapter::Adapter;
use seese3_core::cancel::Cancellation;
use seese3_core::features::Features;
use seese3_core::geometry::{Pose, PoseError, body_twist, exp};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Frames, Room, RoomId};
use seese3_core::statistics::root_mean_square;
use seese3_robot::front_end::{ImageReading, MatchedPose, RetrievalFrontEnd, StreamView};
use seese3_robot::pose_filter::{
    FilterParameters, FilterRoom, FilterState, PoseFilter, ViewObservation,
};
use seese3_robot::tracking::{
    Drift, Map, MapQuery, MeasuredPose, PoseReader, PoseWithCovariance, Relocalization, Status,
    Update, joint_map_index, relocalize, relocalize_jointly,
};
use seese3_testing::world::{FRAMES, calibrated, place, served};

/// A map of the even frames of a room of these poses.
fn map(adapter: &Arc<Adapter>, poses: Vec<Pose>, features: &Features) -> Map {
    let room = served("hall").0;

    let frames = Frames {
        poses,
        ..Frames::default()
    };

    let room = Room::new(
        RoomId::new("hall").unwrap(),
        frames,
        room.provenance().clone(),
    )
    .unwrap();
    let navigator =
        Navigator::new(Arc::new(room), features, adapter.clone(), IndexKind::Exact).unwrap();

    let mapped: Vec<FrameId> = (0..FRAMES as u32).step_by(2).map(FrameId).collect();
    Map::new(Arc::new(navigator), &mapped).unwrap()
}

/// A stream of latents in a mapped room.
#[derive(Clone)]
struct Stream {
    map: Arc<Map>,
    filter: PoseFilter,
    state: FilterState,
    front_end: RetrievalFrontEnd,
}

/// A view that a stream sends.
struct Sent {
    latent: Array1<f64>,
    feature: Option<Vec<f32>>,
    is_blank: bool,
    image: ImageReading,
    measured: Option<MeasuredPose>,
}

impl Sent {
    /// A row of the features, without its feature.
    fn latent(adapter: &Adapter, features: &Features, row: usize) -> Self {
        let latent = adapter.embed_one(&features.rows().row(row).to_vec());
        Self {
            latent: latent.unwrap(),
            feature: None,
            is_blank: false,
            image: ImageReading::default(),
            measured: None,
        }
    }
}

impl Stream {
    /// A stream in the room of a map, whose pose may be known.
    fn new(map: Map, initial: Option<PoseWithCovariance>) -> Self {
        let room = map.navigator().room().clone();
        let mapped: Vec<FrameId> = (0..FRAMES as u32).step_by(2).map(FrameId).collect();
        let rooms = vec![FilterRoom::of(&room, &mapped)];
        let filter = PoseFilter::new(rooms, FilterParameters::default()).unwrap();
        Self {
            map: Arc::new(map),
            state: filter.start(initial.as_ref()),
            filter,
            front_end: RetrievalFrontEnd::default(),
        }
    }

    fn send(&mut self, number: usize, sent: Sent) -> Update {
        let view = StreamView {
            other: None,
            latent: sent.latent.view(),
            feature: sent.feature.as_deref(),
            is_blank: sent.is_blank,
        };
        let maps = std::slice::from_ref(&self.map);
        let read = self.front_end.read(&[view], maps, None);
        let time_ns = number as i64 * 33_000_000;
        let observation = ViewObservation {
            measured: sent.measured,
            ..read.observation(&sent.image, time_ns, number as u64)
        };
        self.filter.observe(&mut self.state, &observation).unwrap()
    }
}

fn known(pose: Pose, deviation: f64) -> Option<PoseWithCovariance> {
    Some(PoseWithCovariance::known(pose, deviation, deviation))
}

/// Oracle: the true poses. A part of the map was recorded two meters off: what its frames say is
/// not believed while the camera passes them, and the pose stays where it is.
#[test]
fn a_wrong_match_cannot_pull_the_pose() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let mut poses = room.poses().to_vec();
    for pose in &mut poses[100..108] {
        pose.translation.vector.y += 2.0;
    }

    let map = map(&adapter, poses, &features);
    let mut stream = Stream::new(map, known(room.poses()[41], 0.05));
    let mut refused = 0;
    for row in (41..141).step_by(2) {
        let update = stream.send(row, Sent::latent(&adapter, &features, row));
        let error = PoseError::between(&update.map_pose.unwrap().pose, &room.poses()[row]);
        assert!(error.translation_m < 0.5, "row {row}: {error:?}");

        let best = update.best_match.map(|best| best.frame.frame.0);
        let is_off = best.is_some_and(|row| (100..108).contains(&row));
        if let Some(surprise) = update.surprise.filter(|_| is_off) {
            assert!(
                !update.match_used && surprise > 16.8,
                "row {row}: {surprise}"
            );
            refused += 1;
        }
    }

    assert!(refused > 0, "no wrong match was met");
}

/// Oracle: the true poses, and the same camera without features. Latents that are all off by the
/// same large number look like no place of the room, and tell no motion wrongly. A camera that is
/// known to be in the room is corrected by its features all the same, and is not TRACKING.
#[test]
fn a_known_camera_with_spoiled_latents_is_corrected_by_its_features() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let mapped: Vec<FrameId> = (0..FRAMES as u32).step_by(2).map(FrameId).collect();
    let errors = |with_features: bool, initial_pose: Option<PoseWithCovariance>| {
        let map = map(&adapter, room.poses().to_vec(), &features);
        let map = map.with_features(features.rows(), &mapped);
        let mut stream = Stream::new(map, initial_pose);
        let mut errors = Vec::new();
        for row in (41..141).step_by(2) {
            let feature = features.rows().row(row).to_vec();
            let plain = Sent::latent(&adapter, &features, row);
            let sent = Sent {
                latent: &plain.latent + 50.0,
                feature: with_features.then_some(feature),
                ..plain
            };
            let update = stream.send(row, sent);
            assert!(update.out_of_distribution > 1.0, "row {row}");
            if row > 71 {
                assert_ne!(update.status, Status::Tracking, "row {row}");
            }
            errors.extend(update.map_pose.map(|believed| {
                PoseError::between(&believed.pose, &room.poses()[row]).translation_m
            }));
        }
        errors
    };

    let start = known(room.poses()[41], 0.05);
    let (with, without) = (errors(true, start), errors(false, start));
    assert_eq!((with.len(), without.len()), (50, 50));
    let (with, without) = (root_mean_square(&with), root_mean_square(&without));
    assert!(with < 0.5 * without, "{with} against {without}");

    // Nobody knows where this camera is, and its views do not say.
    assert!(errors(true, None).is_empty());
}

/// Oracle: the definition: odom goes on from frame to frame by no more than the camera moves at
/// most, but for half of that as the error of the motion, also where the pose in the room is found,
/// lost and found elsewhere.
#[test]
fn odom_never_jumps() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let map = map(&adapter, room.poses().to_vec(), &features);
    let mut stream = Stream::new(map, None);

    let mut before: Option<(Pose, Option<Pose>)> = None;
    let mut jumped = false;
    let step = |a: &Pose, b: &Pose| body_twist(a, b).norm();
    let furthest = (2..FRAMES)
        .map(|row| step(&room.poses()[row - 2], &room.poses()[row]))
        .fold(0.0, f64::max);

    // The camera is taken up at row 99 and put down at row 221, and the numbers go on.
    for (number, row) in (1..100)
        .step_by(2)
        .chain((221..FRAMES).step_by(2))
        .enumerate()
    {
        let update = stream.send(number * 2, Sent::latent(&adapter, &features, row));

        if let Some((odom, place)) = before {
            let went = step(&odom, &update.odom.pose);
            let corrected = place
                .zip(update.map_pose)
                .map(|(a, b): (Pose, PoseWithCovariance)| step(&a, &b.pose));
            jumped |= corrected.is_some_and(|corrected| corrected > went + 0.3);

            assert!(
                went < 1.5 * furthest,
                "row {row}: {went}, the camera itself at most {furthest}"
            );
        }

        before = Some((update.odom.pose, update.map_pose.map(|place| place.pose)));
    }

    assert!(jumped, "map did not jump: the test shows nothing");

    let last = before.unwrap().1.unwrap();
    assert!(PoseError::between(&last, &room.poses()[FRAMES - 1]).translation_m < 0.3);
}

/// Oracle: the contract. Views that turn slowly into those of another place correct nothing any
/// more: the status is not TRACKING, and the covariance grows. In the room again, the camera is
/// tracked.
#[test]
fn a_camera_that_leaves_the_room_is_not_tracked() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let elsewhere = place("moon", 77).1;
    let map = map(&adapter, room.poses().to_vec(), &features);
    let mut stream = Stream::new(map, known(room.poses()[1], 0.05));

    for row in (1..41).step_by(2) {
        let update = stream.send(row, Sent::latent(&adapter, &features, row));
        assert_eq!(update.status, Status::Tracking, "{}", update.reason);
    }
    let mut stays = stream.clone();

    let mut deviations = Vec::new();
    for step in 0..50 {
        let share = step as f32 / 50.0;
        let row = 41;
        let own = features.rows().row(row).to_owned();
        let other = elsewhere.rows().row(row).to_owned();
        let view = &own + &((other - &own) * share);
        let plain = Sent::latent(&adapter, &features, row);
        let latent = adapter.embed_one(&view.to_vec()).unwrap();
        let update = stream.send(41 + 2 * step, Sent { latent, ..plain });
        if step >= 45 {
            assert_ne!(update.status, Status::Tracking, "share {share}");
            deviations.push(update.map_pose.unwrap().position_deviation_m());
        }
    }
    assert!(deviations.windows(2).all(|pair| pair[0] < pair[1]));

    let update = stays.send(41, Sent::latent(&adapter, &features, 41));
    assert_eq!(update.status, Status::Tracking, "{}", update.reason);
}

/// A reader that knows where the camera is, to a centimeter and a hundredth of a radian.
struct Knowing(Vec<Pose>);

impl PoseReader for Knowing {
    /// The feature's only number is the frame's row.
    fn read_pose(&self, feature: &[f32]) -> Option<PoseWithCovariance> {
        let pose = *self.0.get(feature[0] as usize)?;
        Some(PoseWithCovariance::known(pose, 0.01, 0.01))
    }
}

/// Oracle: the reader's own poses and covariance: frames that bring their feature are corrected by
/// it and reported about as surely as it is sure, frames without one by the frames that they match.
#[test]
fn the_localizer_of_a_room_gives_the_poses() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let truth = room.poses().to_vec();

    // The map's own poses are off by a meter, so that only the reader can be right.
    let mut shifted = truth.clone();
    for pose in &mut shifted {
        pose.translation.vector.x += 1.0;
    }
    let run = |has_feature: bool| {
        let map = map(&adapter, shifted.clone(), &features);
        let map = map.with_pose_reader(Arc::new(Knowing(truth.clone())));
        let mut stream = Stream::new(map, None);
        let mut last = None;
        for row in (41..101).step_by(2) {
            let sent = Sent {
                feature: has_feature.then(|| vec![row as f32]),
                ..Sent::latent(&adapter, &features, row)
            };
            let update = stream.send(row, sent);
            if update.match_used {
                last = Some((row, update.map_pose.unwrap()));
            }
        }
        last.expect("no match was used")
    };

    let (row, with) = run(true);
    let error = PoseError::between(&with.pose, &truth[row]);
    assert!(error.translation_m < 0.1, "{error:?}");
    let deviation = with.position_deviation_m();
    assert!((0.005..0.02).contains(&deviation), "{deviation}");

    let (row, without) = run(false);
    let error = PoseError::between(&without.pose, &truth[row]);
    assert!(error.translation_m > 0.8, "{error:?}");
}

/// Oracle: the true poses, which the matched keypoints give. They prove the place although the
/// latents are those of no place; two that agree start the tracking; another place is only believed
/// once two agree on it.
#[test]
fn matched_keypoints_prove_the_place_whatever_the_latents_say() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let map = map(&adapter, room.poses().to_vec(), &features);
    let truth = room.poses();

    let observed = |stream: &mut Stream, row: usize, pose: Pose| {
        let plain = Sent::latent(&adapter, &features, row);
        let sent = Sent {
            latent: &plain.latent + 50.0,
            image: ImageReading {
                matched: Some(MatchedPose {
                    room: 0,
                    pose: PoseWithCovariance::known(pose, 0.01, 0.01),
                    novelty: 0.5,
                    best_frame: FrameId(row as u32),
                }),
                ..ImageReading::default()
            },
            ..plain
        };
        stream.send(row, sent)
    };
    let distance = |update: &Update, pose: &Pose| {
        PoseError::between(&update.map_pose.unwrap().pose, pose).translation_m
    };

    let mut stream = Stream::new(map, None);
    assert_eq!(
        observed(&mut stream, 41, truth[41]).status,
        Status::Relocalizing
    );
    for row in (43..101).step_by(2) {
        let update = observed(&mut stream, row, truth[row]);
        assert_eq!(
            update.status,
            Status::Tracking,
            "row {row}: {}",
            update.reason
        );
        assert!(
            update.match_used && update.out_of_distribution == 0.5,
            "row {row}"
        );
        assert!(distance(&update, &truth[row]) < 0.03, "row {row}");
    }

    let moved = |row: usize| Translation3::new(3.0, 0.0, 0.0) * truth[row];
    let first = observed(&mut stream, 101, moved(101));
    assert_eq!(first.status, Status::Degraded, "{}", first.reason);
    assert!(distance(&first, &truth[101]) < 0.1);
    let second = observed(&mut stream, 103, moved(103));
    assert_eq!(second.status, Status::Tracking, "{}", second.reason);
    assert!(distance(&second, &moved(103)) < 0.1);
}

/// Oracle: the true poses of frames that are not mapped: the blend of the frames most like a view
/// is nearer to it than the nearest frame is, and its covariance holds about as many errors as it
/// says.
#[test]
fn a_view_is_placed_between_mapped_frames() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let map = map(&adapter, room.poses().to_vec(), &features);

    let mut blended = Vec::new();
    let mut nearest = Vec::new();
    let mut surprises = Vec::new();
    for row in (1..FRAMES).step_by(2) {
        let latent = adapter
            .embed_one(&features.rows().row(row).to_vec())
            .unwrap();
        let matched = map.match_view(MapQuery::of_latent(latent.view()), 1);
        let anchor = matched.pose;
        let truth = &room.poses()[row];
        let found = &room.poses()[matched.nearest[0].frame.row()];

        blended.push(PoseError::between(&anchor.pose, truth).translation_m);
        nearest.push(PoseError::between(found, truth).translation_m);
        let error = body_twist(&anchor.pose, truth).to_vector();
        let inverse = anchor.covariance.cholesky().unwrap().inverse();
        surprises.push(error.dot(&(inverse * error)));
    }

    let [blended, nearest] = [blended, nearest].map(|errors| root_mean_square(&errors));
    assert!(blended < 0.9 * nearest, "{blended} against {nearest}");

    // 7.04 and 12.59 hold 68.3 % and 95 % of χ² with six degrees of freedom. The errors of left-out
    // frames are larger than those of frames in between, so that more is held.
    let share = |limit: f64| {
        let within = surprises.iter().filter(|&&surprise| surprise < limit);
        within.count() as f64 / surprises.len() as f64
    };
    let shares = (share(7.04), share(12.59));
    assert!(shares.0 > 0.6 && shares.1 > 0.88, "{shares:?}");
}

/// Oracle: the promise: a camera whose images stop changing is noticed within ten frames, and what
/// is said of its pose becomes less and less sure; pairs of the same image are none, and a camera
/// that sees again is followed again. A blank image is noticed at once.
#[test]
fn a_camera_that_sees_nothing_new_is_not_tracked() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let map = map(&adapter, room.poses().to_vec(), &features);
    let mut stream = Stream::new(map, known(room.poses()[1], 0.01));
    let mut number = 0;
    let mut show = |row: usize, is_blank: bool| {
        number += 1;
        let plain = Sent::latent(&adapter, &features, row);
        stream.send(number, Sent { is_blank, ..plain })
    };

    // Every image twice, as where a driver repeats frames.
    for row in (1..61).step_by(2) {
        for _ in 0..2 {
            let update = show(row, false);
            assert_eq!(
                update.status,
                Status::Tracking,
                "row {row}: {}",
                update.reason
            );
        }
    }

    // The camera goes on and its image does not.
    let frozen: Vec<Update> = (0..60).map(|_| show(61, false)).collect();
    let noticed = frozen
        .iter()
        .position(|update| update.status != Status::Tracking)
        .unwrap();
    assert!(noticed < 10, "{noticed}");
    assert!(
        frozen[noticed].reason.contains("frozen"),
        "{}",
        frozen[noticed].reason
    );

    let deviations: Vec<f64> = frozen[noticed..]
        .iter()
        .map(|update| {
            assert!(update.status != Status::Tracking && !update.match_used);
            update.map_pose.unwrap().position_deviation_m()
        })
        .collect();
    assert!(deviations.windows(2).all(|pair| pair[0] < pair[1]));
    let error = PoseError::between(&frozen[59].map_pose.unwrap().pose, &room.poses()[121]);
    let deviation = deviations[deviations.len() - 1];
    assert!(
        error.translation_m < 4.0 * deviation,
        "{} m off, known to {deviation}",
        error.translation_m
    );

    // It sees again, and is tracked where it is.
    let again: Vec<Update> = (121..201).step_by(2).map(|row| show(row, false)).collect();
    let last = &again[again.len() - 1];
    assert_eq!(last.status, Status::Tracking, "{}", last.reason);
    let error = PoseError::between(&last.map_pose.unwrap().pose, &room.poses()[199]);
    assert!(error.translation_m < 0.3, "{error:?}");

    let blank = show(201, true);
    assert_eq!(blank.status, Status::Degraded, "{}", blank.reason);
    assert!(!blank.match_used && blank.reason.contains("blank"));
}

/// Oracle: the true poses. The camera goes blind while it moves on. Wheels that drift by a
/// twentieth of the way carry it, to within what they may have drifted, and the covariance holds
/// the error; without them it is lost sight of.
#[test]
fn wheels_carry_a_blind_camera() {
    let adapter = Arc::new(calibrated().0);
    let (room, features) = served("hall");
    let ride = |has_wheels: bool| {
        let map = map(&adapter, room.poses().to_vec(), &features);
        let mut stream = Stream::new(map, known(room.poses()[41], 0.01));
        // The wheels' own frame is not the room's, and every motion that they report is 3 % too
        // long.
        let mut wheels = Pose::new(
            nalgebra::Vector3::new(5.0, -2.0, 1.0),
            nalgebra::Vector3::new(0.0, 1.0, 0.0),
        );
        let mut worst = 0.0_f64;
        let mut surprises = Vec::new();
        let mut statuses = Vec::new();

        for row in 41..141 {
            if row > 41 {
                let motion = body_twist(&room.poses()[row - 1], &room.poses()[row]);
                wheels *= exp(&motion.scaled(1.03));
            }

            let is_blind = row >= 71;
            let sent = Sent {
                is_blank: is_blind,
                measured: has_wheels.then_some(MeasuredPose {
                    pose: wheels,
                    velocity_covariance: None,
                    drift: Drift {
                        translation_share: 0.05,
                        rotation_share: 0.05,
                    },
                }),
                ..Sent::latent(&adapter, &features, row)
            };
            let update = stream.send(row, sent);
            if is_blind {
                let believed = update.map_pose.unwrap();
                let truth = &room.poses()[row];
                worst = worst.max(PoseError::between(&believed.pose, truth).translation_m);
                surprises.extend(believed.squared_error(truth));
                statuses.push(update.status);
            }
        }

        (worst, surprises, statuses)
    };

    let (blind, ..) = ride(false);
    let (carried, surprises, statuses) = ride(true);
    assert!(blind > 0.5, "the camera hardly moved: {blind} m");
    assert!(carried < 0.1, "{carried} m, {blind} without wheels");

    // 95 % of chi-square with six degrees of freedom.
    let held = surprises
        .iter()
        .filter(|surprise| **surprise <= 12.59)
        .count();
    assert!(
        held * 10 >= surprises.len() * 9,
        "{held} of {}",
        surprises.len()
    );
    assert!(
        statuses.iter().all(|status| *status == Status::Degraded),
        "a blind camera is not TRACKING"
    );
}

/// Oracle: the contract: the map of kept tables answers as the map that gave them, and tables of
/// another room do not fit.
#[test]
fn a_map_of_tables_answers_as_the_first() {
    let (room, features) = served("hall");
    let adapter = Arc::new(calibrated().0);
    let mapped: Vec<FrameId> = (0..FRAMES as u32).map(FrameId).collect();
    let navigator = Navigator::new(Arc::new(room), &features, adapter, IndexKind::Exact).unwrap();
    let navigator = Arc::new(navigator);
    let map = Map::new(navigator.clone(), &mapped).unwrap();
    let alone = map.tables();
    let map = map.with_features(features.rows(), &mapped);
    let tables = map.tables();
    assert!(alone.by_feature.is_none() && tables.by_feature.is_some());

    let again = |tables| Map::of_tables(navigator.clone(), &mapped, tables);
    let by_latent = again(alone).unwrap();
    let by_feature = again(tables.clone()).unwrap();
    for row in [0, 17, 150, 299] {
        let feature = features.rows().row(row).to_vec();
        let latent = navigator.latents().row(row).to_owned();
        let query = |feature| MapQuery {
            latent: latent.view(),
            feature,
        };
        let expected = map.match_view(query(Some(&feature)), 5);
        assert_eq!(by_feature.match_view(query(Some(&feature)), 5), expected);
        let expected = map.match_view(query(None), 5);
        assert_eq!(by_latent.match_view(query(None), 5), expected);
    }

    let mut other = tables.clone();
    other.errors = Some(vec![0.0; 3]);
    assert!(again(other).is_none());
    let mut other = tables;
    let of_feature = other.by_feature.as_mut().unwrap();
    of_feature.coordinates = of_feature
        .coordinates
        .slice(ndarray::s![1.., ..])
        .to_owned();
    assert!(again(other).is_none());
}

/// Oracle: the comparison of the view with one map after the other, of which the best are kept.
#[test]
fn maps_are_searched_together_as_one_by_one() {
    let adapter = Arc::new(calibrated().0);
    let maps: Vec<Arc<Map>> = (1..6)
        .map(|seed| {
            let (room, features) = place("hall", seed);
            Arc::new(map(&adapter, room.poses().to_vec(), &features))
        })
        .collect();
    let index = joint_map_index(&maps).unwrap().unwrap();

    for (which, row) in [(0, 50), (3, 51), (4, 200)] {
        let latent = maps[which].navigator().latents().row(row).to_owned();
        let view = MapQuery::of_latent(latent.view());
        let all = relocalize(&maps, &[view], &Cancellation::default()).unwrap();
        for count in [1, 2, 4, 9] {
            let found = relocalize_jointly(&maps, &index, view, count).unwrap();
            let best = count.max(2).min(maps.len());
            let expected = Relocalization {
                rooms: all.rooms[..best].to_vec(),
                ..all.clone()
            };
            assert_eq!(found, expected, "row {row} of map {which}");
        }
    }
}

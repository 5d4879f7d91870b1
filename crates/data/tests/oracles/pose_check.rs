//! Poses against images, on motions of points that a pinhole camera sees.

use nalgebra::{Matrix4, Point3, UnitQuaternion, Vector2, Vector3, Vector4};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Frames, Provenance, Room, RoomId};
use seese3_data::image_motion::ImageMotion;
use seese3_data::pose_check::{
    Convention, Direction, ObservedPair, PathFacts, PathWarning, PoseWarning, QuaternionOrder,
    RoomImages, Translations, Verdict, check, check_room,
};

/// The focal length of the camera, image widths.
const FOCAL: f64 = 0.8;

/// A camera that looks about in a room of some meters.
fn path() -> Vec<Pose> {
    let wave = |t: f64, period: f64, phase: f64| (t / period + phase).sin();
    let pose = |row: u32| {
        let t = f64::from(row);
        let position = Vector3::new(
            wave(t, 17.0, 0.3),
            0.4 * wave(t, 29.0, 1.0),
            wave(t, 23.0, 2.0),
        );
        let turn = Vector3::new(
            0.3 * wave(t, 13.0, 0.0),
            1.1 * wave(t, 31.0, 0.7),
            0.3 * wave(t, 19.0, 4.0),
        );
        Pose::new(position, turn)
    };
    (0..300).map(pose).collect()
}

/// How the image moves between two poses: the similarity that fits best, by least squares, to where
/// a pinhole camera sees points about three meters before it. It knows nothing of twists. `right`
/// is 1, or -1 in an image that is mirrored.
fn seen(first: &Pose, second: &Pose, right: f64, random: &mut ChaCha8Rng) -> ImageMotion {
    let mut moment = Matrix4::zeros();
    let mut product = Vector4::zeros();
    for _ in 0..60 {
        let depth = random.random_range(2.0..4.0);
        let image = Vector2::new(
            random.random_range(-0.5..0.5),
            random.random_range(-0.4..0.4),
        );
        let point = Point3::new(image.x * depth / FOCAL, image.y * depth / FOCAL, depth);

        let there = second.inverse() * (first * point);
        let seen = Vector2::new(right * there.x, there.y) * (FOCAL / there.z);
        let image = Vector2::new(right * image.x, image.y);
        let moved = seen - image;
        let rows = [
            (Vector4::new(image.x, -image.y, 1.0, 0.0), moved.x),
            (Vector4::new(image.y, image.x, 0.0, 1.0), moved.y),
        ];
        for (row, observed) in rows {
            moment += row * row.transpose();
            product += row * observed;
        }
    }

    let fit = moment.cholesky().unwrap().solve(&product);
    ImageMotion {
        growth: fit[0],
        turn: fit[1],
        shift: Vector2::new(fit[2], fit[3]),
    }
}

fn observed(truth: &[Pose]) -> Vec<ObservedPair> {
    observed_with(truth, 1.0)
}

fn observed_with(truth: &[Pose], right: f64) -> Vec<ObservedPair> {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let pair = |first: u32| ObservedPair {
        first: FrameId(first),
        second: FrameId(first + 3),
        motion: seen(
            &truth[first as usize],
            &truth[first as usize + 3],
            right,
            &mut random,
        ),
        correlation: 0.9,
    };
    (0..290).step_by(5).map(pair).collect()
}

/// The pose as it is stated in a convention: what, read in it, gives the truth. How a convention is
/// read has its own test, by hand.
fn stated_in(convention: Convention, truth: &Pose) -> Pose {
    let upright = Convention {
        direction: Direction::WorldFromCamera,
        quaternions: QuaternionOrder::Stated,
        ..convention
    };
    let turn = upright.to_world_from_camera(&Pose::identity());
    let mut stated = truth * turn.inverse();
    if convention.direction == Direction::CameraFromWorld {
        stated = stated.inverse();
    }
    if convention.quaternions == QuaternionOrder::ScalarFirst {
        // (w, x, y, z) in the places of (x, y, z, w).
        let q = stated.rotation.quaternion();
        let places = nalgebra::Quaternion::from(Vector4::new(q.w, q.i, q.j, q.k));
        stated.rotation = UnitQuaternion::from_quaternion(places);
    }
    stated
}

/// Oracle: the convention that the mistake was made by.
#[test]
fn every_convention_is_named() {
    let truth = path();
    let observed = observed(&truth);
    let usual = Convention::default();
    for convention in Convention::all() {
        let stated: Vec<Pose> = truth
            .iter()
            .map(|pose| stated_in(convention, pose))
            .collect();

        // Read as it is meant, all is well.
        let right = check(&stated, convention, &observed);
        let Verdict::Agrees(seen) = right.verdict else {
            panic!("{convention:?}: {right:?}");
        };
        assert!(right.explained > 0.9, "{right:?}");
        assert!((seen.focal / FOCAL - 1.0).abs() < 0.15, "{seen:?}");
        assert!((seen.depth.unwrap() / 3.0 - 1.0).abs() < 0.25, "{seen:?}");

        let wrong = check(&stated, usual, &observed);
        match wrong.verdict {
            Verdict::Agrees(_) => assert_eq!(convention, usual),
            Verdict::OtherConvention { likely, .. } => assert_eq!(likely[0], convention),
            other => panic!("{convention:?}: {other:?}"),
        }
    }
}

/// Oracle: the mistakes that were made.
#[test]
fn other_mistakes_are_named() {
    let truth = path();
    let observed = observed(&truth);
    let usual = Convention::default();
    let verdict = |poses: &[Pose]| check(poses, usual, &observed).verdict;
    let with = |change: &dyn Fn(&Pose) -> Vector3<f64>| -> Vec<Pose> {
        let changed = truth
            .iter()
            .map(|pose| Pose::from_parts(change(pose).into(), pose.rotation));
        changed.collect()
    };

    // Millimeters: the scene is three kilometers away.
    let large = with(&|pose| pose.translation.vector * 1_000.0);
    let Verdict::Agrees(seen) = verdict(&large) else {
        panic!();
    };
    assert!((2_000.0..4_500.0).contains(&seen.depth.unwrap()));

    // Positions whose last two numbers are exchanged, and those of the inverse.
    let exchanged = with(&|pose| pose.translation.vector.xzy());
    let Verdict::OtherTranslations { likely, .. } = verdict(&exchanged) else {
        panic!();
    };
    assert_eq!(likely, Translations::Axes([(0, 1.0), (2, 1.0), (1, 1.0)]));
    let inverse = with(&|pose| pose.inverse().translation.vector);
    let Verdict::OtherTranslations { likely, .. } = verdict(&inverse) else {
        panic!();
    };
    assert_eq!(likely, Translations::OfTheInverse);

    // Rotations of camera_from_world beside positions of the camera.
    let transposed: Vec<Pose> = truth
        .iter()
        .map(|pose| Pose::from_parts(pose.translation, pose.rotation.inverse()))
        .collect();
    assert!(matches!(
        verdict(&transposed),
        Verdict::TransposedRotations { .. }
    ));

    // Images that were taken in a mirror, with right poses and with inverted ones.
    let in_mirror = observed_with(&truth, -1.0);
    for direction in [Direction::WorldFromCamera, Direction::CameraFromWorld] {
        let convention = Convention { direction, ..usual };
        let stated: Vec<Pose> = truth
            .iter()
            .map(|pose| stated_in(convention, pose))
            .collect();
        let Verdict::MirroredImages { likely, .. } = check(&stated, usual, &in_mirror).verdict
        else {
            panic!();
        };
        assert_eq!(likely[0], convention);
    }

    // Poses of images four rows later: pose 4 stands at row 0.
    let mut late = truth.clone();
    late.rotate_left(4);
    let Verdict::OtherRows { rows, .. } = verdict(&late) else {
        panic!();
    };
    assert_eq!(rows, 4);

    // Poses in another order, and poses of another path.
    let mut mixed = truth.clone();
    let mut random = ChaCha8Rng::seed_from_u64(9);
    for row in (1..mixed.len()).rev() {
        mixed.swap(row, random.random_range(0..=row));
    }
    assert!(matches!(verdict(&mixed), Verdict::Unrelated { .. }));

    // Nothing is said of few pairs, of unlike images, and of a camera that stands.
    let nothing = |observed: &[ObservedPair]| check(&truth, usual, observed).verdict;
    assert_eq!(nothing(&observed[..11]), Verdict::TooFewPairs);
    let unlike: Vec<ObservedPair> = observed
        .iter()
        .map(|pair| ObservedPair {
            correlation: 0.3,
            ..*pair
        })
        .collect();
    assert_eq!(nothing(&unlike), Verdict::TooFewPairs);
    let still: Vec<ObservedPair> = observed
        .iter()
        .map(|pair| {
            let mut pair = *pair;
            pair.motion.shift *= 1e-3;
            pair.motion.turn *= 1e-3;
            pair
        })
        .collect();
    let standing = vec![truth[7]; truth.len()];
    let of_standing = check(&standing, usual, &still).verdict;
    assert_eq!(of_standing, Verdict::TooLittleMotion);
    // The same images, of poses that turn by several degrees from one to the next.
    assert_eq!(nothing(&still), Verdict::Unrelated { explained: 0.0 });
}

/// Oracle: the exchange that was made. The camera moves two meters along x, and half a meter along
/// the axes that are exchanged.
#[test]
fn an_exchange_of_axes_that_hardly_matter_is_named() {
    let mut truth = path();
    for pose in &mut truth {
        pose.translation.y *= 0.7;
        pose.translation.z *= 0.25;
    }
    let observed = observed(&truth);
    let usual = Convention::default();
    let exchanged = truth
        .iter()
        .map(|pose| Pose::from_parts(pose.translation.vector.xzy().into(), pose.rotation));
    let exchanged: Vec<Pose> = exchanged.collect();

    let wrong = check(&exchanged, usual, &observed);
    let Verdict::OtherTranslations { likely, explained } = wrong.verdict else {
        panic!("{wrong:?}");
    };
    assert_eq!(likely, Translations::Axes([(0, 1.0), (2, 1.0), (1, 1.0)]));
    // So little is gained that it is named only since all parts of the recording have it.
    assert!(explained - wrong.explained < 0.05, "{explained} {wrong:?}");

    let right = check(&truth, usual, &observed);
    assert!(matches!(right.verdict, Verdict::Agrees(_)), "{right:?}");
}

fn room(poses: Vec<Pose>, timestamps_ns: Vec<i64>) -> Room {
    let frames = Frames {
        poses,
        timestamps_ns,
        ..Frames::default()
    };
    Room::new(RoomId::new("r").unwrap(), frames, Provenance::default()).unwrap()
}

/// Oracle: by hand, a camera that goes 0.5 m a frame to the right, 10 frames a second.
#[test]
fn the_facts_of_a_path_are_told() {
    let straight: Vec<Pose> = (0..60)
        .map(|row| Pose::translation(0.5 * f64::from(row), 1.0, 0.0))
        .collect();
    let times: Vec<i64> = (0..60).map(|row| row * 100_000_000).collect();
    let facts = PathFacts::of(&room(straight.clone(), times.clone())).unwrap();
    assert_eq!(facts.extent_m, [29.5, 0.0, 0.0]);
    assert!((facts.length_m - 29.5).abs() < 1e-9);
    assert_eq!(facts.median_step_m, 0.5);
    assert!((facts.rate_hz.unwrap() - 10.0).abs() < 1e-9);
    assert_eq!(facts.warnings, []);

    let warnings =
        |poses: Vec<Pose>, times: Vec<i64>| PathFacts::of(&room(poses, times)).unwrap().warnings;
    let still = vec![straight[3]; 60];
    assert_eq!(warnings(still, Vec::new()), [PathWarning::NeverMoves]);

    // A camera on a tripod, or translations that were lost.
    let turning = (0..60).map(|row| {
        let turn = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.01 * f64::from(row), 0.0);
        Pose::from_parts(straight[3].translation, turn)
    });
    assert_eq!(
        warnings(turning.collect(), Vec::new()),
        [PathWarning::OnlyTurns]
    );

    // Tracking is lost in two frames: the identity is written, 10 m off.
    let mut lost = straight.clone();
    lost[30] = Pose::identity();
    lost[31] = Pose::identity();
    assert_eq!(
        warnings(lost, Vec::new()),
        [
            PathWarning::Identities {
                count: 2,
                first: FrameId(30)
            },
            PathWarning::Jumps {
                count: 2,
                first: FrameId(30)
            },
        ]
    );

    let mut large = straight.clone();
    for pose in &mut large {
        pose.translation.vector *= 1_000.0;
    }
    let unit = PathWarning::OtherUnit {
        median_step_m: 500.0,
    };
    assert_eq!(warnings(large.clone(), Vec::new()), [unit]);
    assert_eq!(warnings(large, times.clone()), [unit]);

    let mut back = times;
    back[40] = back[39];
    let falls = PathWarning::TimesFall { first: FrameId(40) };
    assert_eq!(warnings(straight, back), [falls]);
}

/// Oracle: by hand: a recording whose camera never moves is wrong without a look at its images; of
/// three images one has another size and none can be decoded, so the comparison has no pair.
#[test]
fn one_call_checks_path_images_and_verdict() {
    let still = Frames {
        poses: vec![Pose::default(); 3],
        images: ["a.png", "b.png", "c.png"].map(str::to_owned).to_vec(),
        ..Frames::default()
    };
    let room = Room::new(RoomId::new("still").unwrap(), still, Provenance::default()).unwrap();

    let report = check_room(&room, None);
    assert!(report.is_wrong() && report.images.is_none());
    assert_eq!(
        report.warnings,
        [PoseWarning::Path(PathWarning::NeverMoves)]
    );

    let report = check_room(
        &room,
        Some(&RoomImages {
            size: &|image| {
                Ok(if image == "b.png" {
                    (320, 200)
                } else {
                    (320, 240)
                })
            },
            read: &|_| None,
            stated: room.poses(),
            read_as: Convention::default(),
            progress: &|_, _| (),
        }),
    );
    let mixed = PoseWarning::MixedSizes {
        sizes: vec![
            (320, 240, 2, "a.png".to_owned()),
            (320, 200, 1, "b.png".to_owned()),
        ],
    };
    assert_eq!(
        report.warnings,
        [PoseWarning::Path(PathWarning::NeverMoves), mixed]
    );
    assert_eq!(report.images.unwrap().check.verdict, Verdict::TooFewPairs);
}

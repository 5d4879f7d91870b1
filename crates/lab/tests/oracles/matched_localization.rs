//! Matched localization of a small synthetic recording.

use nalgebra::Vector3;
use ndarray::Array2;
use seese3_core::geometry::Pose;
use seese3_core::keypoints::Keypoints;
use seese3_core::room::FrameId;
use seese3_lab::experiments::Error;
use seese3_lab::experiments::localization::LocalizationErrors;
use seese3_lab::experiments::matched_localization::{
    MappedAndAsked, MatchedLocalization, PeerAnswer, PosedRecording, evaluate,
};
use seese3_testing::keypoint_scene::{Random, Scene, camera_path, distorted_camera};
use seese3_testing::near;

/// Number of mapped frames.
const MAPPED: usize = 24;

/// Poses and keypoints of a recording: mapped frames without noise, then ten asked ones.
///
/// - Six views between the mapped frames, exact.
/// - One view of a scene that is not mapped, and one without keypoints: not answered.
/// - One whose true pose is stated 1 m away, and one that is stated 0.5 rad off: answered, wrong.
fn recording() -> (Vec<Pose>, Vec<Keypoints>) {
    let camera = distorted_camera();
    let [scene, other] = [1, 50].map(|seed| Scene::in_box(600, seed));
    let mut random = Random::new(3);
    let mut poses = camera_path(MAPPED);
    let path = camera_path(2 * MAPPED);
    poses.extend((0..10).map(|view| path[4 * view + 1]));

    let mut keypoints: Vec<Keypoints> = poses
        .iter()
        .map(|pose| scene.view(pose, &camera, 0.0, &mut random).keypoints)
        .collect();
    let [strange, empty, shifted, turned] = [6, 7, 8, 9].map(|view| MAPPED + view);
    keypoints[strange] = other
        .view(&poses[strange], &camera, 0.0, &mut random)
        .keypoints;
    keypoints[empty] = Keypoints::default();
    poses[shifted].translation.vector += Vector3::x();
    poses[turned] *= Pose::new(Vector3::zeros(), Vector3::y() * 0.5);
    (poses, keypoints)
}

fn evaluated(mapped: &[FrameId], asked: &[FrameId]) -> Result<MatchedLocalization, Error> {
    evaluated_beside(mapped, asked, &[])
}

/// The evaluation beside a peer.
fn evaluated_beside(
    mapped: &[FrameId],
    asked: &[FrameId],
    peer: &[PeerAnswer],
) -> Result<MatchedLocalization, Error> {
    let (poses, keypoints) = recording();
    let features = Array2::from_shape_fn((poses.len(), 3), |(row, axis)| {
        1.0 + poses[row].translation.vector[axis] as f32
    });
    let recording = PosedRecording {
        poses: &poses,
        keypoints: &keypoints,
        camera: distorted_camera(),
    };
    let frames = MappedAndAsked {
        mapped,
        asked,
        peer,
    };
    evaluate(recording, features.view(), frames, &|| 0.0, &|| ())
}

fn frames(rows: std::ops::Range<usize>) -> Vec<FrameId> {
    rows.map(|row| FrameId(row as u32)).collect()
}

/// Oracle: the counts of the recording. Of ten views eight are answered, and two of the eight are
/// wrong.
#[test]
fn the_shares_of_answered_and_of_wrong_views_are_counted() {
    let mapped = frames(0..MAPPED);
    let scores = evaluated(&mapped, &frames(MAPPED..MAPPED + 10)).unwrap();
    assert_eq!(scores.mapped, MAPPED);
    assert_eq!(scores.all.n, 10);
    near("answered", scores.all.ours.answered, 0.8, 1e-12);
    near("wrong", scores.all.ours.wrong, 0.25, 1e-12);

    // The one view 1 m off determines the root mean square: √(1/8).
    near("rmse", scores.all.ours.rmse_m, 0.125_f64.sqrt(), 1e-2);
    // The two wrong views are outside their ellipsoids.
    let within_95 = scores.all.ours.coverage.unwrap().within_95;
    assert!((0.5..=0.75).contains(&within_95), "{within_95}");

    // Both parts together are the whole.
    let [near_part, far_part] = [scores.near, scores.far].map(Option::unwrap);
    assert_eq!(near_part.n + far_part.n, 10);
    let wrong = |part: &seese3_lab::experiments::matched_localization::MatchedPart| {
        part.ours.wrong * part.ours.answered * part.n as f64
    };
    near(
        "wrong views",
        wrong(&near_part) + wrong(&far_part),
        2.0,
        1e-9,
    );
}

/// Oracle: exact views have no errors, and a mapped frame elsewhere has one.
#[test]
fn exact_views_are_all_answered_right() {
    let scores = evaluated(&frames(0..MAPPED), &frames(MAPPED..MAPPED + 6)).unwrap();
    near("answered", scores.all.ours.answered, 1.0, 1e-12);
    near("wrong", scores.all.ours.wrong, 0.0, 1e-12);
    assert!(scores.all.ours.rmse_m < 1e-3, "{}", scores.all.ours.rmse_m);
    let within_95 = scores.all.ours.coverage.unwrap().within_95;
    assert!(within_95 > 0.6, "{within_95}");
    near(
        "milliseconds of a clock that stands",
        scores.match_ms,
        0.0,
        1e-12,
    );
}

/// Oracle: by hand. The peer is asked for six views and answers five, one of them 0.3 m off, which
/// is wrong. We answer five of the six as well: not view 6, and view 8 1 m off. On the four views
/// that both answer, our errors are 0, 0, 0 and 1 m, and the peer's 0.1, 0.05, 0.3 and 0 m.
#[test]
fn a_peer_is_compared_on_the_views_that_it_is_asked_for() {
    let (poses, _) = recording();
    let off = [
        (0, Some(0.1)),
        (1, Some(0.05)),
        (2, Some(0.3)),
        (3, None),
        (6, Some(0.0)),
        (8, Some(0.0)),
    ];
    let answers = off.map(|(view, off)| PeerAnswer {
        frame: FrameId((MAPPED + view) as u32),
        pose: off.map(|meters: f64| {
            let mut pose = poses[MAPPED + view];
            pose.translation.vector.y += meters;
            pose
        }),
    });
    let [mapped, asked] = [frames(0..MAPPED), frames(MAPPED..MAPPED + 10)];
    let scores = evaluated_beside(&mapped, &asked, &answers).unwrap();

    let found = scores.all.peer.unwrap();
    assert_eq!(found.n, 6);
    for (who, answers) in [("the peer", &found.peer), ("we", &found.ours)] {
        near(who, answers.answered, 5.0 / 6.0, 1e-12);
        near(who, answers.wrong, 0.2, 1e-12);
    }
    let median = |errors: LocalizationErrors| errors.translation_m.median.median;
    near("the peer's median", median(found.peer.errors), 0.05, 1e-9);
    assert!(found.peer.coverage.is_none() && found.ours.coverage.is_some());

    let both = found.both.unwrap();
    assert_eq!(both.n, 4);
    near("the peer's median", median(both.peer), 0.075, 1e-9);
    assert!(median(both.ours) < 1e-3);
    near("difference", both.difference_m.median, -0.075, 1e-3);
    near("ours nearer", both.ours_nearer, 0.75, 1e-12);

    let parts = [scores.near, scores.far].map(|part| part.unwrap().peer.map_or(0, |peer| peer.n));
    assert_eq!(parts.iter().sum::<usize>(), 6);
    let alone = evaluated(&mapped, &asked).unwrap();
    assert!(alone.all.peer.is_none(), "no peer, no comparison");

    let error = evaluated_beside(&mapped, &frames(MAPPED..MAPPED + 8), &answers).unwrap_err();
    assert!(error.to_string().contains("frame 32"), "{error}");
}

/// Oracle: the definition of the input.
#[test]
fn without_mapped_or_asked_frames_there_is_nothing_to_evaluate() {
    let some = frames(0..5);
    for (mapped, asked) in [(&some[..], &[][..]), (&[], &some)] {
        let error = evaluated(mapped, asked).unwrap_err();
        assert!(matches!(error, Error::Input(_)), "{error}");
    }

    let empty = frames(MAPPED + 7..MAPPED + 8);
    let error = evaluated(&empty, &some).unwrap_err();
    assert!(error.to_string().contains("keypoint"), "{error}");
}

//! Keypoints of stored rooms.

use std::path::Path;
use std::sync::Arc;

use ndarray::{Array1, Array2};

use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::Pose;
use seese3_core::keypoints::KeypointSource;
use seese3_core::nalgebra::{Point3, Vector3};
use seese3_core::room::{FrameId, Frames, Provenance, Room, RoomId};
use seese3_core::trajectory::Similarity;
use seese3_robot::matched_views::{COMPRESSED, DescriptorBasis, KeypointMap, MappedKeypoints};
use seese3_robot::pose_filter::{FilterParameters, MotionNoise};
use seese3_store::{EditedRoom, Error, OtherFeatures, RoomContents, RoomKeypoints, Store};

use crate::store::{files, stored};
use seese3_testing::keypoint_map::{UNIT_M, keypoint_map};
use seese3_testing::keypoint_scene::distorted_camera;
use seese3_testing::near;
use seese3_testing::recording::{room, set};

/// Number of frames of `room("a")`.
const FRAMES: usize = 300;

/// Keypoints of random numbers within their ranges: `count` in each frame but every fifth.
fn keypoints(frame_count: usize, count: usize) -> RoomKeypoints {
    let camera = room("a").provenance().camera.unwrap();
    let map = keypoint_map(camera, frame_count, count);
    let source = KeypointSource {
        feature: set("f", 1.0).source().clone(),
        positions: "kpt".to_owned(),
        reliability: "heat".to_owned(),
        descriptors: "fusion".to_owned(),
        model_file: "/models/a.onnx".to_owned(),
    };
    RoomKeypoints {
        source,
        map: Arc::new(map),
    }
}

/// A store with `room("a")`, the features "f" and these keypoints.
async fn begun(keypoints: &RoomKeypoints) -> (tempfile::TempDir, Store) {
    let (folder, store) = stored().await;
    store
        .publish_contents(RoomContents {
            room: &room("a"),
            features: &[set("f", 1.0)],
            keypoints: Some(keypoints),
        })
        .await
        .unwrap();
    (folder, store)
}

/// Frames of `room("a")` with their poses, times and names.
fn part(rows: std::ops::Range<usize>) -> Room {
    let frames = Frames {
        numbers: Vec::new(),
        images: Vec::new(),
        sequences: Vec::new(),
        held_out: Vec::new(),
        ..room("a").frames().select(&rows.collect::<Vec<_>>())
    };
    Room::new(RoomId::new("a").unwrap(), frames, Provenance::default()).unwrap()
}

fn features(name: &str, rows: std::ops::Range<usize>) -> Features {
    set(name, 1.0).select(&rows.collect::<Vec<_>>())
}

/// Oracle: what was published, within half a step of each number: 1/65535 of the image, 16/65535 of
/// an inverse unit, 0.001 of a deviation. Everything else is exact.
#[tokio::test]
async fn keypoints_come_back_within_half_a_step() {
    let sent = keypoints(FRAMES, 20);
    let (_folder, store) = begun(&sent).await;
    let back = store.load_room("a", None).await.unwrap();
    let back = back.keypoints.unwrap();
    assert_eq!(back.source, sent.source);

    let [found, expected] = [&back.map, &sent.map];
    assert_eq!(found.camera, expected.camera);
    assert_eq!(found.noise, expected.noise);
    assert_eq!(found.basis, expected.basis);
    assert_eq!([found.unit_m, found.epipolar_px], [UNIT_M, 0.7]);
    assert_eq!(found.frames.len(), FRAMES);
    for (found, expected) in found.frames.iter().zip(&expected.frames) {
        assert_eq!(found.descriptors, expected.descriptors);
        assert_eq!(found.len(), expected.len());
        for place in 0..found.len() {
            let step = 0.501 / 65_535.0;
            for axis in 0..2 {
                let [a, b] = [found, expected].map(|frame| f64::from(frame.points[place][axis]));
                near("position", a, b, step);
            }
            let [a, b] = [found, expected].map(|frame| f64::from(frame.inverse_depths[place]));
            near("inverse depth", a, b, 16.0 * step / UNIT_M);
            let [a, b] = [found, expected].map(|frame| f64::from(frame.deviations[place]));
            near("deviation", a, b, 0.000_501);
        }
    }
}

/// Oracle: numbers that do not fit are stored as the nearest that does, so that depths stay finite.
#[tokio::test]
async fn numbers_out_of_range_are_clamped() {
    let mut sent = keypoints(FRAMES, 4);
    let map = Arc::make_mut(&mut sent.map);
    map.frames[0].points[0] = [-0.25, 1.5].into();
    map.frames[0].inverse_depths = vec![0.0, 1e-9, 1e9, -1.0];
    map.frames[0].deviations = vec![0.0, 1e-9, 1e9, 0.255];
    let (_folder, store) = begun(&sent).await;

    let back = store.load_room("a", None).await.unwrap().keypoints.unwrap();
    let frame = &back.map.frames[0];
    assert_eq!(frame.points[0], nalgebra::Vector2::new(0.0, 1.0));
    let [least, most] = [16.0 / 65_535.0 / UNIT_M, 16.0 / UNIT_M];
    for (&found, expected) in frame.inverse_depths.iter().zip([least, least, most, least]) {
        near("inverse depth", f64::from(found), expected, 1e-6);
    }
    for (&found, expected) in frame.deviations.iter().zip([0.001, 0.001, 0.255, 0.255]) {
        near("deviation", f64::from(found), expected, 1e-6);
    }
}

/// Oracle: the documented size.
#[tokio::test]
async fn three_hundred_keypoints_take_at_most_12000_bytes() {
    let sizes = |folder: &Path| -> Vec<u64> {
        let files = files(folder, "keypoints-");
        files
            .iter()
            .map(|file| file.metadata().unwrap().len())
            .collect()
    };
    let few = begun(&keypoints(FRAMES, 0)).await;
    let many = begun(&keypoints(FRAMES, 300)).await;
    let [few, many] = [&few, &many].map(|(folder, _)| sizes(folder.path()));
    assert_eq!([few.len(), many.len()], [1, 1]);

    let frames = (FRAMES * 4 / 5) as u64;
    let each = (many[0] - few[0]) / frames;
    assert!((11_000..12_000).contains(&each), "{each} bytes a frame");
}

/// Oracle: the promises of publishing. The same frames keep their keypoints, other frames have none
/// of them, and keypoints of another number of frames are refused.
#[tokio::test]
async fn the_same_frames_keep_their_keypoints() {
    let sent = keypoints(FRAMES, 5);
    let (_folder, store) = begun(&sent).await;
    let known = store.load_room("a", None).await.unwrap().keypoints.unwrap();

    let again = store
        .publish_room(&room("a"), &[set("g", 2.0)])
        .await
        .unwrap();
    assert_eq!((again.revision, again.is_new), (2, true));
    let back = store.load_room("a", None).await.unwrap();
    assert_eq!(back.features.len(), 2);
    assert_eq!(back.keypoints.unwrap().map.frames, known.map.frames);

    let others = store
        .publish_room(&part(0..200), &[features("f", 0..200)])
        .await;
    assert_eq!(others.unwrap().revision, 3);
    let back = store.load_room("a", None).await.unwrap();
    assert!(back.keypoints.is_none());
    assert_eq!(back.room.frame_count(), 200);

    let refused = store
        .publish_contents(RoomContents {
            room: &room("b"),
            features: &[set("f", 1.0)],
            keypoints: Some(&keypoints(FRAMES - 1, 5)),
        })
        .await;
    let message = refused.unwrap_err().to_string();
    assert!(
        message.contains("299") && message.contains("300"),
        "{message}"
    );
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the definition of the source: keypoints and features come from one encoder pass, and
/// features of another encoder under the same name do not.
#[tokio::test]
async fn features_of_another_encoder_drop_the_keypoints_of_the_former() {
    let (_folder, store) = begun(&keypoints(FRAMES, 5)).await;
    let former = set("f", 1.0);
    let source = FeatureSource {
        encoder: "another".to_owned(),
        ..former.source().clone()
    };
    let other = Features::new(source, former.rows().to_owned()).unwrap();
    store.publish_room(&room("a"), &[other]).await.unwrap();

    let back = store.load_room("a", None).await.unwrap();
    assert_eq!(back.features("f").unwrap().source().encoder, "another");
    assert!(back.keypoints.is_none());
}

/// Oracle: the definition of an inverse depth, which depends on the focal length: the same frames
/// with a corrected camera do not have the depths of the former one.
#[tokio::test]
async fn another_camera_drops_the_keypoints_of_the_former() {
    let (_folder, store) = begun(&keypoints(FRAMES, 5)).await;
    let former = room("a");
    let provenance = Provenance {
        camera: Some(distorted_camera()),
        ..former.provenance().clone()
    };
    let frames = former.frames().clone();
    let corrected = Room::new(former.id().clone(), frames, provenance).unwrap();
    store.publish_room(&corrected, &[]).await.unwrap();

    let back = store.load_room("a", None).await.unwrap();
    assert!(back.features("f").is_some() && back.keypoints.is_none());
}

/// Oracle: the promise of an extension. Known frames keep their keypoints, added frames have none;
/// without features of the same encoder pass, the keypoints are left behind.
#[tokio::test]
async fn added_frames_have_no_keypoints() {
    for others in [OtherFeatures::Required, OtherFeatures::LeftBehind] {
        let (_folder, store) = stored().await;
        let whole: Vec<usize> = (0..260).collect();
        let known = room("a").frames().select(&whole);
        let known = Room::new(RoomId::new("a").unwrap(), known, Provenance::default()).unwrap();
        let sent = keypoints(260, 5);
        store
            .publish_contents(RoomContents {
                room: &known,
                features: &[features("f", 0..260), features("g", 0..260)],
                keypoints: Some(&sent),
            })
            .await
            .unwrap();
        let before = store.load_room("a", None).await.unwrap().keypoints.unwrap();

        let added = if others == OtherFeatures::Required {
            vec![features("f", 260..300), features("g", 260..300)]
        } else {
            vec![features("g", 260..300)]
        };
        store
            .extend_room(RoomContents::of(&part(260..300), &added), others)
            .await
            .unwrap();
        let back = store.load_room("a", None).await.unwrap();
        assert_eq!(back.room.frame_count(), 300);
        if others == OtherFeatures::Required {
            let map = back.keypoints.unwrap().map;
            assert_eq!(map.frames[..260], before.map.frames);
            assert!(map.frames[260..].iter().all(|frame| frame.is_empty()));
        } else {
            assert!(back.keypoints.is_none());
        }
        assert!(store.verify(&|_| ()).await.unwrap().is_empty());
    }
}

/// A store whose room has the first 260 frames of `room("a")`, with these keypoints.
async fn begun_with_260(known: Option<&RoomKeypoints>) -> (tempfile::TempDir, Store) {
    let (folder, store) = stored().await;
    let rows: Vec<usize> = (0..260).collect();
    let frames = room("a").frames().select(&rows);
    let provenance = room("a").provenance().clone();
    let begun = Room::new(RoomId::new("a").unwrap(), frames, provenance).unwrap();
    let features = [features("f", 0..260)];
    let contents = RoomContents {
        keypoints: known,
        ..RoomContents::of(&begun, &features)
    };
    store.publish_contents(contents).await.unwrap();
    (folder, store)
}

fn with_basis_of(known: &RoomKeypoints, mut added: RoomKeypoints) -> RoomKeypoints {
    Arc::make_mut(&mut added.map).basis = known.map.basis.clone();
    added
}

/// Oracle: the definition: the frames of both, each with its own keypoints. Both maps have the same
/// basis, so that no descriptor changes.
#[tokio::test]
async fn added_frames_bring_their_keypoints() {
    let known = keypoints(260, 5);
    let added = with_basis_of(&known, keypoints(40, 7));
    for begins_with_keypoints in [true, false] {
        let known = begins_with_keypoints.then_some(&known);
        let (_folder, store) = begun_with_260(known).await;
        let (frames, features) = (part(260..300), [features("f", 260..300)]);
        let contents = RoomContents {
            keypoints: Some(&added),
            ..RoomContents::of(&frames, &features)
        };
        let others = OtherFeatures::Required;
        store.extend_room(contents, others).await.unwrap();

        let joined = store.load_room("a", None).await.unwrap().keypoints.unwrap();
        let counts = |map: &KeypointMap| {
            map.frames
                .iter()
                .map(MappedKeypoints::len)
                .collect::<Vec<_>>()
        };
        let found = counts(&joined.map);
        assert_eq!(
            found[..260],
            known.map_or(vec![0; 260], |known| counts(&known.map))
        );
        assert_eq!(found[260..], counts(&added.map));
        for (found, sent) in joined.map.frames[260..].iter().zip(&added.map.frames) {
            assert_eq!(found.descriptors, sent.descriptors);
        }
        assert!(store.verify(&|_| ()).await.unwrap().is_empty());
    }
}

/// Oracle: the definition: frames that were added without keypoints get those that are sent later.
#[tokio::test]
async fn known_frames_without_keypoints_get_those_that_are_sent_again() {
    let known = keypoints(260, 5);
    let (_folder, store) = begun_with_260(Some(&known)).await;
    let features_of = |rows: std::ops::Range<usize>| features("f", rows);
    let (frames, features) = (part(260..300), [features_of(260..300)]);
    let others = OtherFeatures::Required;
    let without = RoomContents::of(&frames, &features);
    store.extend_room(without, others).await.unwrap();

    // First those of some of the frames, then those of all, which are then sent once more.
    let [some, added] =
        [keypoints(10, 6), keypoints(40, 7)].map(|added| with_basis_of(&known, added));
    let (ten, ten_features) = (part(260..270), [features_of(260..270)]);
    let contents = RoomContents {
        keypoints: Some(&some),
        ..RoomContents::of(&ten, &ten_features)
    };
    assert!(store.extend_room(contents, others).await.unwrap().is_new);
    let with = RoomContents {
        keypoints: Some(&added),
        ..without
    };
    for (revision, is_new) in [(4, true), (4, false)] {
        let published = store.extend_room(with, others).await.unwrap();
        assert_eq!((published.revision, published.is_new), (revision, is_new));
    }
    let room = store.load_room("a", None).await.unwrap();
    assert_eq!(room.room.frame_count(), 300);
    let joined = room.keypoints.unwrap().map;
    let sent = some.map.frames.iter().chain(&added.map.frames[10..]);
    for (found, sent) in joined.frames[260..].iter().zip(sent) {
        // Every fifth frame has no keypoints.
        assert_eq!(found.descriptors, sent.descriptors);
    }
}

/// Oracle: the promise that nothing is lost: keypoints that do not belong to the room are refused
/// with what to change, and nothing is published.
#[tokio::test]
async fn added_keypoints_of_another_kind_are_refused() {
    let known = keypoints(260, 5);
    let (_folder, store) = begun_with_260(Some(&known)).await;
    let (frames, features) = (part(260..300), [features("f", 260..300)]);
    type Change = fn(&mut RoomKeypoints);
    let cases: [(Change, &str); 4] = [
        (|k| k.source.descriptors = "other".into(), "another encoder"),
        (
            |k| Arc::make_mut(&mut k.map).camera = distorted_camera(),
            "another camera",
        ),
        (
            |k| {
                let axes = Array2::zeros((8, COMPRESSED));
                let basis = DescriptorBasis::from_parts(Array1::zeros(8), axes);
                Arc::make_mut(&mut k.map).basis = basis.unwrap();
            },
            "another model",
        ),
        (
            |k| k.source.feature.layer = "other".into(),
            "computed differently",
        ),
    ];
    for (change, expected) in cases {
        let mut added = keypoints(40, 7);
        change(&mut added);
        let contents = RoomContents {
            keypoints: Some(&added),
            ..RoomContents::of(&frames, &features)
        };
        let others = OtherFeatures::Required;
        let refused = store.extend_room(contents, others).await.unwrap_err();
        assert!(matches!(refused, Error::CannotAdd { .. }), "{refused}");
        assert!(refused.to_string().contains(expected), "{refused}");
        assert_eq!(
            store.load_room("a", None).await.unwrap().room.frame_count(),
            260
        );
    }
}

/// Oracle: the checksum of the file's manifest.
#[tokio::test]
async fn a_damaged_file_of_keypoints_is_found() {
    let (folder, store) = begun(&keypoints(FRAMES, 5)).await;
    let file = files(folder.path(), "keypoints-").remove(0);
    let mut bytes = std::fs::read(&file).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&file, &bytes).unwrap();

    let name = file.file_name().unwrap().to_str().unwrap();
    let findings = store.verify(&|_| ()).await.unwrap();
    assert_eq!(findings.len(), 1);
    assert!(
        findings[0].problem.contains(name),
        "{}",
        findings[0].problem
    );
    let refused = store.load_room("a", None).await.unwrap_err();
    assert!(matches!(refused, Error::Damaged { .. }), "{refused}");
}

/// Oracle: the contract of published parameters: they come back in the next revision, with
/// everything else as it was, stay with other features and more frames, and are refused if no
/// filter can have them.
#[tokio::test]
async fn parameters_of_tracking_are_published_with_a_room() {
    let sent = keypoints(FRAMES, 5);
    let (folder, store) = begun(&sent).await;
    let parameters = FilterParameters {
        process_noise_factor: 7.0,
        visual_noise: MotionNoise {
            over_motion: 0.125,
            ..MotionNoise::IMAGES
        },
        // A setting of one stream, which is not stored.
        fuse: false,
        ..FilterParameters::default()
    };
    let stored = FilterParameters {
        fuse: true,
        ..parameters
    };

    let published = store.publish_tracking("a", Some(parameters)).await;
    assert_eq!(published.unwrap().revision, 2);
    let again = store.publish_tracking("a", Some(parameters)).await;
    assert!(!again.unwrap().is_new);
    let back = store.load_room("a", None).await.unwrap();
    assert_eq!(back.tracking, Some(stored));
    assert_eq!(back.features.len(), 1);
    assert!(back.keypoints.is_some());

    let published = store.publish_room(&room("a"), &[set("g", 2.0)]).await;
    assert_eq!(published.unwrap().revision, 3);
    let back = store.load_room("a", None).await.unwrap();
    assert_eq!(back.tracking, Some(stored));
    let former = store.load_room("a", Some(1)).await.unwrap();
    assert_eq!(former.tracking, None);

    let removed = store.publish_tracking("a", None).await.unwrap();
    assert_eq!(removed.revision, 4);
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
    let unknown = store.publish_tracking("nowhere", None).await.unwrap_err();
    assert!(matches!(unknown, Error::Unknown { .. }), "{unknown}");

    let impossible = FilterParameters {
        process_noise_factor: -1.0,
        ..parameters
    };
    store
        .publish_tracking("a", Some(impossible))
        .await
        .unwrap_err();
    let manifests = folder.path().join("rooms/a/revisions");
    assert!(!manifests.join("000005.json").exists());
}

/// Oracle: composition by hand. A crop keeps what belongs to the frames; a similarity moves cameras
/// and the points of the map alike; joined rooms have the frames of both, in sequences of their
/// own.
#[tokio::test]
async fn rooms_are_cropped_moved_and_merged() {
    let sent = keypoints(FRAMES, 5);
    let (_folder, store) = begun(&sent).await;
    let stored = store.load_room("a", None).await.unwrap();
    let name = RoomId::new("b").unwrap();
    let whole = EditedRoom::of(&stored, &name).unwrap();

    let rows = [7, 8, 20];
    let cropped = whole.cropped(&rows).unwrap();
    let contents = cropped.contents();
    assert_eq!(contents.room.id(), &name);
    assert_eq!(contents.room.poses()[2], stored.room.poses()[20]);
    let row = |set: &Features, row: usize| set.rows().row(row).to_vec();
    assert_eq!(row(&contents.features[0], 1), row(&stored.features[0], 8));
    let known = stored.keypoints.as_ref().unwrap();
    let kept = &contents.keypoints.unwrap().map.frames;
    assert_eq!(kept[2], known.map.frames[20]);
    let timeline = contents.room.timeline();
    assert!(timeline.joins(FrameId(0), FrameId(1)) && !timeline.joins(FrameId(1), FrameId(2)));
    assert!(whole.cropped(&[]).is_err());

    let new_from_old = Similarity {
        scale: 2.0,
        reference_from_estimate: Pose::new(
            Vector3::new(1.0, 2.0, 3.0),
            Vector3::new(0.1, 0.2, 0.3),
        ),
    };
    let moved = whole.transformed(&new_from_old).unwrap();
    let moved_map = &moved.contents().keypoints.unwrap().map;
    near("unit", moved_map.unit_m, 2.0 * known.map.unit_m, 1e-9);
    let point = |map: &KeypointMap, pose: &Pose, frame: usize| {
        pose * Point3::from(map.frames[frame].point(0, &map.camera))
    };
    for frame in [1, 2, 3] {
        let before = point(&known.map, &stored.room.poses()[frame], frame);
        let after = point(moved_map, &moved.room().poses()[frame], frame);
        let expected = new_from_old.reference_from_estimate * (before * 2.0);
        assert!(
            (after - expected).norm() < 1e-4 * expected.coords.norm(),
            "{after}"
        );
    }

    let merged = cropped.merged(&moved).unwrap();
    let published = store.publish_contents(merged.contents()).await.unwrap();
    assert!(published.is_new);
    let back = store.load_room("b", None).await.unwrap();
    assert_eq!(back.room.frame_count(), rows.len() + FRAMES);
    assert!(!back.room.timeline().joins(FrameId(2), FrameId(3)));
    let frames = &back.keypoints.as_ref().unwrap().map.frames;
    assert_eq!(frames[0].len(), known.map.frames[7].len());
    assert_eq!(frames[rows.len() + 1].len(), known.map.frames[1].len());
    let off = back.room.poses()[rows.len()].inv_mul(&moved.room().poses()[0]);
    assert!(off.translation.vector.norm() < 1e-9);
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

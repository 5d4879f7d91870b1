//! Keypoints of uploaded rooms.

use std::path::Path;
use std::sync::Arc;

use seese3_client::proto::v1 as pb;
use seese3_core::keypoints::KeypointSource;
use seese3_robot::matched_views::MappedKeypoints;
use seese3_server::{Config, camera_to_wire};
use seese3_store::{RoomContents, RoomKeypoints, Store};
use tonic::Code;

use crate::changes::{Upload, start_writable, writable};
use crate::harness::{Unfit, features_of, filled_store, refused, room_of, start_on};
use seese3_testing::keypoint_map::keypoint_map;
use seese3_testing::keypoint_scene::distorted_camera;

/// Number of frames of the room.
const FRAMES: usize = 600;
/// Size of a part of the file, bytes: not a divisor of any column.
const PART: usize = 10_007;

/// Keypoints of the room, as another machine stores them.
fn keypoints(frame_count: usize) -> RoomKeypoints {
    RoomKeypoints {
        source: KeypointSource {
            feature: features_of("synthetic").source().clone(),
            positions: "kpt".to_owned(),
            reliability: "heat".to_owned(),
            descriptors: "fusion".to_owned(),
            model_file: "/models/a.onnx".to_owned(),
        },
        map: Arc::new(keypoint_map(distorted_camera(), frame_count, 9)),
    }
}

fn parts(file: &[u8]) -> Vec<Vec<u8>> {
    file.chunks(PART).map(<[u8]>::to_vec).collect()
}

/// An upload of the room with its keypoints.
pub fn upload(name: &str) -> Upload {
    let room = room_of("any", "synthetic");
    let mut upload = Upload::of(name, &room, &features_of("synthetic"));
    upload.spec.camera = Some(camera_to_wire(&distorted_camera()));
    upload.spec.keypoints = Some(pb::KeypointsUpload {
        feature_set: "oracle".to_owned(),
        positions: "kpt".to_owned(),
        reliability: "heat".to_owned(),
        descriptors: "fusion".to_owned(),
        unit_m: 2.5,
        epipolar_px: 0.7,
        pose_noise: 0.001,
        relative_error: 0.003,
        design_effect: 12.0,
        gap_scale: 0.3,
    });
    upload.keypoints = parts(&keypoints(FRAMES).to_bytes().unwrap());
    upload
}

async fn stored(store: &Store, room: &str) -> RoomKeypoints {
    let room = store.load_room(room, None).await.unwrap();
    room.keypoints.expect("the room has keypoints")
}

/// Names of the files of keypoints of a room; they contain the hashes of their content.
fn files(folder: &Path, room: &str) -> Vec<String> {
    let objects = folder.join(format!("rooms/{room}/objects"));
    let names = std::fs::read_dir(objects).unwrap();
    let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names
        .filter(|name| name.starts_with("keypoints-"))
        .collect()
}

/// Oracle: the same keypoints, published in the store without a server. The hash in the name of the
/// file is that of all its bytes.
#[tokio::test]
async fn uploaded_keypoints_are_stored_as_those_from_the_disk() {
    let (server, store) = start_writable().await;
    let room = room_of("here", "synthetic");
    let sent = keypoints(FRAMES);
    let features = [features_of("synthetic")];
    let contents = RoomContents {
        room: &room,
        features: &features,
        keypoints: Some(&sent),
    };
    store.publish_contents(contents).await.unwrap();

    let mut checked = upload("there");
    checked.spec.validate_only = true;
    assert_eq!(checked.send(&server.client).await.unwrap().revision, None);
    assert!(!server.folder.path().join("rooms/there").exists());

    for created in [true, false] {
        let answer = upload("there").send(&server.client).await.unwrap();
        assert_eq!(answer.revision.unwrap().revision, 1);
        assert_eq!((answer.created, answer.served), (created, true));
    }
    let [here, there] = ["here", "there"].map(|room| files(server.folder.path(), room));
    assert_eq!((&here, here.len()), (&there, 1));

    let [here, there] = [stored(&store, "here").await, stored(&store, "there").await];
    assert_eq!(here.map.frames, there.map.frames);
    assert_eq!(there.map.camera, distorted_camera());
    assert_eq!((there.map.unit_m, there.map.epipolar_px), (2.5, 0.7));
    assert_eq!(there.map.noise, here.map.noise);
    // The path of the model is that of another machine, and this upload states no encoder.
    let uploaded = store.load_room("there", None).await.unwrap();
    let expected = KeypointSource {
        model_file: String::new(),
        feature: uploaded.features("oracle").unwrap().source().clone(),
        ..sent.source
    };
    assert_eq!(there.source, expected);
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());

    // The same frames without keypoints keep those that are there.
    let mut without = upload("there");
    without.spec.keypoints = None;
    without.keypoints.clear();
    let answer = without.send(&server.client).await.unwrap();
    assert!(!answer.created);
    assert_eq!(stored(&store, "there").await.map.frames, here.map.frames);
}

/// Oracle: the definition of the keypoints of a frame: those of known frames stay; added frames
/// have those that were sent with them, or none.
#[tokio::test]
async fn frames_that_extend_a_room_have_the_keypoints_that_are_sent() {
    let (server, store) = start_writable().await;
    upload("a").send(&server.client).await.unwrap();
    let known = stored(&store, "a").await.map.frames.clone();

    let room = room_of("any", "synthetic_b");
    let mut without = Upload::of("a", &room, &features_of("synthetic_b"));
    without.batches.truncate(1);
    without.spec.mode = pb::UploadMode::Extend.into();
    let mut with = without.clone();
    let whole = upload("a");
    with.spec.camera = whole.spec.camera;
    with.spec.keypoints = whole.spec.keypoints;
    let sent = keypoints(100);
    with.keypoints = parts(&sent.to_bytes().unwrap());

    let mut of_another_camera = with.clone();
    of_another_camera.spec.camera.as_mut().unwrap().fx *= 1.001;
    let answer = of_another_camera.send(&server.client).await;
    refused("camera", answer, Code::InvalidArgument, "keypoints");

    let answer = with.send(&server.client).await.unwrap();
    assert_eq!(answer.revision.unwrap().revision, 2);
    let joined = stored(&store, "a").await.map.frames.clone();
    assert_eq!(joined.len(), FRAMES + 100);
    assert_eq!(joined[..FRAMES], known);
    let counts =
        |frames: &[MappedKeypoints]| frames.iter().map(MappedKeypoints::len).collect::<Vec<_>>();
    assert_eq!(counts(&joined[FRAMES..]), counts(&sent.map.frames));

    without.batches[0]
        .timestamps_ns
        .iter_mut()
        .for_each(|t| *t += 1_000_000_000_000);
    let answer = without.send(&server.client).await.unwrap();
    assert_eq!(answer.revision.unwrap().revision, 3);
    let last = stored(&store, "a").await.map.frames.clone();
    assert_eq!(last[..FRAMES + 100], joined);
    assert!(last[FRAMES + 100..].iter().all(MappedKeypoints::is_empty));
}

/// The stated keypoints of an upload.
fn stated(upload: &mut Upload) -> &mut pb::KeypointsUpload {
    upload.spec.keypoints.as_mut().unwrap()
}

/// Oracle: the protocol. Nothing of a refused upload is in the store.
#[tokio::test]
async fn unfit_keypoints_are_refused_and_leave_nothing() {
    let (server, store) = start_writable().await;
    let good = upload("bad");
    let cases: [Unfit<Upload>; 21] = [
        (|u| u.spec.camera = None, "room.camera"),
        (
            |u| stated(u).feature_set = "other".into(),
            "room.keypoints.feature_set",
        ),
        (
            |u| stated(u).feature_set.clear(),
            "room.keypoints.feature_set",
        ),
        (|u| stated(u).positions.clear(), "room.keypoints.positions"),
        (
            |u| stated(u).reliability.clear(),
            "room.keypoints.reliability",
        ),
        (
            |u| stated(u).descriptors = "x".repeat(2_000),
            "room.keypoints.descriptors",
        ),
        (|u| stated(u).unit_m = 0.0, "room.keypoints.unit_m"),
        (
            |u| stated(u).epipolar_px = f64::NAN,
            "room.keypoints.epipolar_px",
        ),
        (|u| stated(u).pose_noise = -0.1, "room.keypoints.pose_noise"),
        (
            |u| stated(u).relative_error = f64::INFINITY,
            "room.keypoints.relative_error",
        ),
        (
            |u| stated(u).design_effect = 1e300,
            "room.keypoints.design_effect",
        ),
        (|u| stated(u).gap_scale = 1e-300, "room.keypoints.gap_scale"),
        (|u| u.spec.keypoints = None, "keypoints"),
        (|u| u.keypoints.clear(), "keypoints"),
        (|u| u.keypoints = vec![Vec::new()], "keypoints"),
        (
            |u| {
                u.keypoints.pop();
            },
            "keypoints",
        ),
        (|u| u.keypoints.push(vec![0; 8]), "keypoints"),
        (|u| u.keypoints.swap(0, 1), "keypoints"),
        (|u| u.keypoints = vec![vec![0xff; 500]], "keypoints"),
        (
            |u| u.keypoints = parts(&keypoints(FRAMES - 1).to_bytes().unwrap()),
            "keypoints",
        ),
        // The checksum covers the keypoints: this one is of the frames alone.
        (
            |u| {
                let mut frames = u.clone();
                frames.keypoints.clear();
                u.sha256 = Some(frames.digest());
            },
            "end.sha256",
        ),
    ];
    for (alter, field) in cases {
        let mut upload = good.clone();
        alter(&mut upload);
        let answer = upload.send(&server.client).await;
        refused(field, answer, Code::InvalidArgument, field);
    }

    assert!(!server.folder.path().join("rooms/bad").exists());
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());

    // What was altered is what was refused.
    assert!(good.send(&server.client).await.unwrap().served);
}

/// Oracle: the bound itself. The frames fit into the memory of uploads, the keypoints do not.
#[tokio::test]
async fn keypoints_count_toward_the_memory_of_uploads() {
    let (folder, store) = filled_store().await;
    let file: usize = upload("a").keypoints.iter().map(Vec::len).sum();
    let config = Config {
        upload_bytes: 4 * file,
        ..writable()
    };
    let server = start_on(folder, store, config).await;

    let answer = upload("a").send(&server.client).await;
    assert_eq!(answer.unwrap_err().code(), Some(Code::ResourceExhausted));
    assert!(!server.folder.path().join("a").exists());

    let mut without = upload("a");
    without.spec.keypoints = None;
    without.keypoints.clear();
    assert!(without.send(&server.client).await.unwrap().served);
}

//! The keypoints of a room on their way to a server and to other programs.

use std::sync::Arc;

use seese3_core::geometry::PoseError;
use seese3_core::keypoints::KeypointSource;
use seese3_robot::matched_views::MappedKeypoints;
use seese3_store::{RoomContents, RoomKeypoints, Store, StoredRoom};
use seese3_testing::keypoint_map::keypoint_map;
use seese3_testing::npy;
use seese3_testing::recording::{room, set};

use crate::program::Place;

fn block_on<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Runtime::new().unwrap().block_on(work)
}

/// A place with the store `source`, which has room `a` with keypoints, and the store `store` with
/// another room.
fn place() -> Place {
    let here = Place::new();
    here.succeeds(&Place::import("r", "synthetic"));
    let features = [set("f", 1.0)];
    let room = room("a");
    let camera = room.provenance().camera.unwrap();
    let keypoints = RoomKeypoints {
        source: KeypointSource {
            feature: features[0].source().clone(),
            positions: "kpt".to_owned(),
            reliability: "heat".to_owned(),
            descriptors: "fusion".to_owned(),
            model_file: "/models/a.onnx".to_owned(),
        },
        map: Arc::new(keypoint_map(camera, room.frame_count(), 9)),
    };

    let store = Store::create(here.file("source").to_str().unwrap()).unwrap();
    let contents = RoomContents {
        room: &room,
        features: &features,
        keypoints: Some(&keypoints),
    };
    block_on(store.publish_contents(contents)).unwrap();
    here
}

/// Room `a` of a store of the place.
fn loaded(here: &Place, store: &str) -> StoredRoom {
    let store = Store::open(here.file(store).to_str().unwrap()).unwrap();
    block_on(store.load_room("a", None)).unwrap()
}

/// Oracle: the store from which the room is pushed.
#[test]
fn keypoints_are_pushed_and_pulled_with_their_room() {
    let here = place();
    let server = here.serve("--writable");
    let push = format!("push rooms/a --store source --server {}", server.address);
    here.prints(&push, &["rooms/a/revisions/1: published"]);
    here.prints(&push, &["rooms/a/revisions/1: already there, unchanged"]);
    here.prints(&format!("{push} --extend"), &["already has these frames"]);

    let [sent, arrived] = ["source", "store"].map(|store| loaded(&here, store).keypoints.unwrap());
    assert_eq!(arrived.map.frames, sent.map.frames);
    assert_eq!(arrived.map.basis, sent.map.basis);
    let expected = KeypointSource {
        model_file: String::new(),
        ..sent.source.clone()
    };
    assert_eq!(arrived.source, expected);
    let mut stated = arrived.header();
    stated.source.clone_from(&sent.source);
    assert_eq!(stated, sent.header());
    here.succeeds("store verify --store store");

    // And back, into another store.
    let pull = format!("pull rooms/a --store copy --server {}", server.address);
    here.prints(&pull, &["published room 'a' revision 1"]);
    here.prints(&pull, &["already there, unchanged"]);
    let [sent, arrived] = ["store", "copy"].map(|store| loaded(&here, store));
    for (arrived, sent) in arrived.room.poses().iter().zip(sent.room.poses()) {
        // A matrix on the way rounds a rotation.
        let error = PoseError::between(arrived, sent);
        assert!(error.translation_m < 1e-12 && error.rotation_rad < 1e-7);
    }
    assert_eq!(arrived.features[0].rows(), sent.features[0].rows());
    let [sent, arrived] = [sent, arrived].map(|room| room.keypoints.unwrap());
    assert_eq!(arrived.map.frames, sent.map.frames);
    here.succeeds("store verify --store copy");

    // A room of this name with other content stays, unless it is to be replaced.
    let other = format!(
        "pull rooms/r --as a --store copy --server {}",
        server.address
    );
    here.refuses(
        &other,
        &["rooms/a is in the store", "--as NAME", "--replace"],
    );
    here.prints(
        &format!("{other} --replace"),
        &["published room 'a' revision 2"],
    );
    let missing = format!(
        "pull rooms/nobody --store other --server {}",
        server.address
    );
    here.refuses(&missing, &["'nobody' is not served"]);
    assert!(!here.file("other").exists());
}

/// Oracle: the keypoints in the store, frame after frame.
#[test]
fn keypoints_are_exported_as_arrays() {
    let here = place();
    here.succeeds("export numpy --store source --room a --out out");
    let array = |name: &str| here.file(&format!("out/keypoint_{name}.npy"));
    let floats = |name: &str| npy::<f32>(&array(name));
    let map = loaded(&here, "source").keypoints.unwrap().map;

    let counts: Vec<i64> = map.frames.iter().map(|frame| frame.len() as i64).collect();
    assert_eq!(npy::<i64>(&array("counts")).as_slice(), Some(&counts[..]));
    let count: usize = map.frames.iter().map(MappedKeypoints::len).sum();
    assert_eq!(floats("positions").shape(), [count, 2]);
    assert_eq!(floats("inverse_depths").shape(), [count]);
    assert_eq!(floats("deviations").shape(), [count]);
    assert_eq!(npy::<i8>(&array("descriptors")).shape(), [count, 32]);
    assert_eq!(floats("basis_mean").shape(), [64]);
    assert_eq!(floats("basis_axes").shape(), [64, 32]);

    // The frames before the seventh have 9 keypoints each, but for the fifth, which has none.
    let [row, place] = [5 * 9 + 2, 2];
    let frame = &map.frames[6];
    let point = frame.points[place];
    assert_eq!(floats("positions")[[row, 0]], point.x);
    assert_eq!(floats("positions")[[row, 1]], point.y);
    assert_eq!(floats("inverse_depths")[row], frame.inverse_depths[place]);
    assert_eq!(floats("deviations")[row], frame.deviations[place]);
    let descriptor = npy::<i8>(&array("descriptors"));
    assert_eq!(descriptor[[row, 31]], frame.descriptors[place * 32 + 31]);

    here.succeeds("export numpy --store store --room r --out without");
    assert!(here.file("without/poses.npy").is_file());
    assert!(!here.file("without/keypoint_counts.npy").exists());
}

//! Downloads of rooms and adapters, and defaults as a list.

use seese3_client::proto::v1 as pb;
use seese3_client::{Client, Error};
use seese3_server::{CompleteRoom, Config, ReceivedRoom};
use seese3_store::{Store, UploadPolicy};
use tonic::Code;

use crate::harness::{filled_store, frame, question, refused, start, start_on};
use crate::keypoints_upload::upload;
use crate::revisions::shorter;
use seese3_testing::near;

/// A room as a client receives it.
async fn received(
    client: &Client,
    room: &str,
    revision: Option<u64>,
) -> Result<(pb::RoomDownload, CompleteRoom), Error> {
    use pb::download_room_response::Message;

    let request = pb::DownloadRoomRequest {
        room: room.to_owned(),
        room_revision: revision,
    };
    let (mut first, mut room, mut complete) = (None, None, None);
    let take = |received: pb::DownloadRoomResponse| -> Result<(), Error> {
        match received.message.unwrap() {
            Message::Room(described) => {
                room = Some(ReceivedRoom::begin(described.upload.as_ref().unwrap()).unwrap());
                first = Some(described);
            }
            Message::Frames(batch) => room = Some(room.take().unwrap().take(batch).unwrap().0),
            Message::Keypoints(part) => room.as_mut().unwrap().take_keypoints(&part).unwrap(),
            Message::End(end) => complete = Some(room.take().unwrap().finish(&end).unwrap()),
        }
        Ok(())
    };
    client.download_room(request, take).await?;
    Ok((first.unwrap(), complete.unwrap()))
}

/// Oracle: the room in the server's store. Published in another store, it has the same objects.
#[tokio::test]
async fn a_downloaded_room_is_the_stored_one() {
    let (folder, store) = filled_store().await;
    let config = Config {
        writable: true,
        ..Config::default()
    };
    let server = start_on(folder, store.clone(), config).await;
    upload("here").send(&server.client).await.unwrap();

    let (first, room) = received(&server.client, "here", None).await.unwrap();
    assert_eq!(
        first.revision,
        Some(pb::Revision {
            name: "here".to_owned(),
            revision: 1
        })
    );

    let elsewhere = tempfile::tempdir().unwrap();
    let copy = Store::create(elsewhere.path().to_str().unwrap()).unwrap();
    let policy = UploadPolicy::Create;
    copy.upload_contents(room.contents(), policy).await.unwrap();
    let objects = |folder: &std::path::Path| {
        let objects = std::fs::read_dir(folder.join("rooms/here/objects")).unwrap();
        let names = objects.map(|entry| entry.unwrap().file_name());
        let names = names.map(|name| name.into_string().unwrap());
        // A matrix on the way rounds the rotations, which are compared below.
        let mut names: Vec<String> = names.filter(|name| !name.starts_with("frames-")).collect();
        names.sort();
        names
    };
    assert_eq!(objects(elsewhere.path()), objects(server.folder.path()));
    let [known, copied] = [&store, &copy].map(|store| store.load_room("here", None));
    let [known, copied] = [known.await.unwrap(), copied.await.unwrap()];
    // The deviation is of the matrices that were given: here of rounding alone.
    let origin = |room: &seese3_core::room::Room| seese3_core::room::Provenance {
        worst_rotation_deviation: (room.provenance().worst_rotation_deviation / 1e-12).floor(),
        ..room.provenance().clone()
    };
    assert_eq!(origin(&copied.room), origin(&known.room));
    assert_eq!(copied.room.timestamps_ns(), known.room.timestamps_ns());
    for (copied, known) in copied.room.poses().iter().zip(known.room.poses()) {
        assert!((copied.to_homogeneous() - known.to_homogeneous()).amax() < 1e-12);
    }
}

/// Oracle: the contract: a server that takes no changes offers downloads too, of any revision.
#[tokio::test]
async fn an_earlier_revision_can_be_downloaded() {
    let (folder, store) = filled_store().await;
    let (room, features) = shorter(300);
    store.publish_room(&room, &[features]).await.unwrap();
    let server = start_on(folder, store, Config::default()).await;

    let count = async |revision| {
        let (first, room) = received(&server.client, "synthetic", revision)
            .await
            .unwrap();
        (first.revision.unwrap().revision, room.room.frame_count())
    };
    assert_eq!(count(None).await, (2, 300));
    assert_eq!(count(Some(1)).await, (1, 600));

    for (room, revision, code, field) in [
        ("nowhere", None, Code::NotFound, "room"),
        ("synthetic", Some(9), Code::NotFound, "room_revision"),
        ("synthetic", Some(0), Code::NotFound, "room_revision"),
    ] {
        let answer = received(&server.client, room, revision).await.map(drop);
        refused(room, answer, code, field);
    }
}

/// Oracle: the adapter of the server's store. Its weights reproduce their golden outputs.
#[tokio::test]
async fn a_downloaded_adapter_is_the_stored_one() {
    let server = start(Config::default()).await;
    let request = |name: &str| pb::DownloadAdapterRequest {
        adapter: name.to_owned(),
        ..pb::DownloadAdapterRequest::default()
    };
    let (first, weights) = server
        .client
        .download_adapter(request("oracle"))
        .await
        .unwrap();

    let elsewhere = tempfile::tempdir().unwrap();
    let copy = Store::create(elsewhere.path().to_str().unwrap()).unwrap();
    let policy = UploadPolicy::Create;
    let published = copy.upload_adapter_files("copied", &first.manifest, weights, policy);
    assert_eq!(published.await.unwrap().revision, 1);
    let copied = copy.load_adapter("copied", None).await.unwrap();
    let known = crate::harness::oracle_adapter();
    assert_eq!(copied.adapter.latent_dim(), known.latent_dim());

    let unknown = server.client.download_adapter(request("nobody")).await;
    refused("nobody", unknown, Code::NotFound, "adapter");
}

/// Oracle: the calls one by one.
#[tokio::test]
async fn a_batch_is_localized_as_its_requests_alone() {
    let server = start(Config::default()).await;
    let request = |room: &str, at: u32| pb::LocalizeRequest {
        rooms: vec![room.to_owned()],
        view: frame(at),
        top_k: Some(2),
        ..pb::LocalizeRequest::default()
    };
    let requests = vec![
        request("synthetic", 7),
        request("nowhere", 7),
        request("synthetic_b", 9),
    ];
    let results = server
        .client
        .batch_localize(requests.clone())
        .await
        .unwrap();
    for (request, result) in requests.into_iter().zip(results) {
        let alone = server.client.localize(request).await;
        match (result.result.unwrap(), alone) {
            (pb::batch_localize_result::Result::Response(response), Ok(alone)) => {
                assert!(response.exact);
                assert_eq!(response, alone);
            }
            (pb::batch_localize_result::Result::Error(error), Err(alone)) => {
                assert_eq!(Some(Code::from(error.code)), alone.code());
            }
            (result, alone) => panic!("{result:?} is not {alone:?}"),
        }
    }

    let empty = server.client.batch_localize(Vec::new()).await;
    refused("empty", empty, Code::InvalidArgument, "requests");
    let mut pinned = request("synthetic", 7);
    pinned.room_revisions = [("synthetic".to_owned(), 1)].into();
    let mixed = vec![pinned.clone(), request("synthetic", 7)];
    let mixed = server.client.batch_localize(mixed).await;
    refused("mixed", mixed, Code::InvalidArgument, "requests");
    let other = vec![pinned, request("synthetic_b", 7)];
    let other = server.client.batch_localize(other).await.unwrap();
    assert!(other.iter().all(|result| matches!(
        result.result,
        Some(pb::batch_localize_result::Result::Response(_))
    )));
}

/// Oracle: what was set, by hand; a read-only server lists it too.
#[tokio::test]
async fn defaults_are_listed() {
    let (folder, store) = filled_store().await;
    let choice = seese3_store::Choice::Adapter {
        room: "synthetic".to_owned(),
        adapter: "oracle".to_owned(),
    };
    let server = start_on(folder, store.clone(), Config::default()).await;
    assert_eq!(server.client.defaults().await.unwrap(), []);

    store.choose(&choice).await.unwrap();
    let expected = pb::catalog_default::Default::RoomAdapter(pb::RoomAdapter {
        room: "synthetic".to_owned(),
        adapter: "oracle".to_owned(),
    });
    let defaults = server.client.defaults().await.unwrap();
    assert_eq!(defaults[0].default, Some(expected));
    assert_eq!(defaults.len(), 1);
}

/// Oracle: the poses of the room, one by one.
#[tokio::test]
async fn a_room_states_its_extent() {
    let server = start(Config::default()).await;
    let room = server.client.room("synthetic").await.unwrap();
    let extent = room.extent.unwrap();
    let poses = crate::harness::room_of("synthetic", "synthetic");
    let xs = poses.poses().iter().map(|pose| pose.translation.x);
    near(
        "min x",
        extent.min.unwrap().x,
        xs.clone().fold(f64::INFINITY, f64::min),
        1e-12,
    );
    near(
        "max x",
        extent.max.unwrap().x,
        xs.fold(f64::NEG_INFINITY, f64::max),
        1e-12,
    );
    assert!(!room.has_keypoints && room.expected_errors.is_empty());
}

/// Oracle: the comment of Pose: a map pose of Track, in the frame "map", is accepted as it is.
#[tokio::test]
async fn a_map_pose_of_track_is_accepted() {
    let server = start(Config::default()).await;
    let poses = crate::harness::room_of("synthetic", "synthetic");
    let target = |parent: &str| {
        let pose = &poses.poses()[540];
        let q = pose.rotation.quaternion();
        crate::harness::to_pose(pb::Pose {
            parent_frame: parent.to_owned(),
            child_frame: "camera".to_owned(),
            position: Some(pb::Vector3 {
                x: pose.translation.x,
                y: pose.translation.y,
                z: pose.translation.z,
            }),
            orientation: Some(pb::Quaternion {
                w: q.w,
                x: q.i,
                y: q.j,
                z: q.k,
            }),
        })
    };
    let expected = server.client.navigate(question()).await.unwrap();
    for parent in ["", "map", "rooms/synthetic"] {
        let answer = server.navigated(|r| r.motion = target(parent)).await;
        let frames = |answer: &pb::NavigateResponse| answer.steps[0].frames[0].frame_id;
        assert_eq!(frames(&answer), frames(&expected), "{parent}");
    }
    let request = pb::NavigateRequest {
        motion: target("odom"),
        ..question()
    };
    let answer = server.client.navigate(request).await;
    refused(
        "odom",
        answer,
        Code::InvalidArgument,
        "motion.target_pose.parent_frame",
    );
}

/// Oracle: the contract: no change is made in a store that has disappeared, and what was served is
/// still served; nor is anything made in its place.
#[tokio::test]
async fn a_store_that_disappeared_takes_no_changes() {
    let (folder, store) = filled_store().await;
    let config = Config {
        writable: true,
        ..Config::default()
    };
    let server = start_on(folder, store, config).await;
    let root = server.folder.path();
    let away = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(root).unwrap() {
        let entry = entry.unwrap();
        std::fs::rename(entry.path(), away.path().join(entry.file_name())).unwrap();
    }

    let answer = upload("here").send(&server.client).await;
    let error = answer.map(drop).unwrap_err();
    assert!(error.to_string().contains("has disappeared"), "{error}");
    assert!(server.client.room("synthetic").await.is_ok());
    let left: Vec<_> = std::fs::read_dir(root).unwrap().collect();
    assert!(left.is_empty(), "{left:?}");
}

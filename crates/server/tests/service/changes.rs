//! Changes of the catalog over the wire: uploads, defaults, removals, fits, and who may make them.

use std::sync::Arc;

use pb::catalog_default::Default;
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, Error};
use seese3_core::features::Features;
use seese3_core::room::Room;
use seese3_server::{Config, Keyring};
use seese3_store::Store;
use sha2::{Digest, Sha256};
use tonic::Code;

use crate::harness::{
    TestServer, Unfit, code_of, feature, features_of, filled_store, oracle_adapter, publish_oracle,
    question, record, refused, room_of, start_on,
};
use crate::security::{client_with, principal};
use seese3_testing::world;

/// A server that takes changes.
pub async fn start_writable() -> (TestServer, Store) {
    let (folder, store) = filled_store().await;
    let server = start_on(folder, store.clone(), writable()).await;
    (server, store)
}

pub fn writable() -> Config {
    Config {
        writable: true,
        ..Config::default()
    }
}

/// An upload as a test alters it before it is sent.
#[derive(Clone)]
pub struct Upload {
    pub spec: pb::RoomUpload,
    pub batches: Vec<pb::FrameBatch>,
    /// Parts of the keypoints, sent after the batches.
    pub keypoints: Vec<Vec<u8>>,
    /// None to send what was uploaded.
    pub sha256: Option<Vec<u8>>,
    frame_count: Option<u32>,
}

impl Upload {
    /// A room and its features, in batches of 100 frames.
    pub fn of(name: &str, room: &Room, features: &Features) -> Self {
        let source = features.source();
        let bytes = |row: usize| -> Vec<u8> {
            let matrix = room.poses()[row].to_homogeneous().transpose();
            matrix.iter().flat_map(|x| x.to_le_bytes()).collect()
        };
        let rows: Vec<usize> = (0..room.frame_count()).collect();
        let batches = rows
            .chunks(100)
            .map(|rows| pb::FrameBatch {
                poses: rows.iter().flat_map(|&row| bytes(row)).collect(),
                features: vec![
                    rows.iter()
                        .flat_map(|&row| features.rows().row(row).to_vec())
                        .flat_map(f32::to_le_bytes)
                        .collect(),
                ],
                timestamps_ns: rows.iter().map(|&row| row as i64 * 33_000_000).collect(),
                frame_names: rows.iter().map(|row| format!("frame-{row}")).collect(),
                ..pb::FrameBatch::default()
            })
            .collect();

        Self {
            spec: pb::RoomUpload {
                room: name.to_owned(),
                feature_sources: vec![pb::FeatureSource {
                    name: source.name.clone(),
                    dim: source.dim as u32,
                    ..pb::FeatureSource::default()
                }],
                ..pb::RoomUpload::default()
            },
            batches,
            keypoints: Vec::new(),
            sha256: None,
            frame_count: None,
        }
    }

    fn synthetic(name: &str) -> Self {
        let room = room_of("any", "synthetic");
        Self::of(name, &room, &features_of("synthetic"))
    }

    /// SHA-256 of what is sent.
    pub fn digest(&self) -> Vec<u8> {
        let mut digest = Sha256::new();
        for batch in &self.batches {
            digest.update(&batch.poses);
            batch.features.iter().for_each(|rows| digest.update(rows));
            batch.images.iter().for_each(|image| digest.update(image));
        }
        self.keypoints.iter().for_each(|part| digest.update(part));
        digest.finalize().to_vec()
    }

    fn messages(self) -> Vec<pb::UploadRoomRequest> {
        use pb::upload_room_request::Message;

        let poses = self.batches.iter().map(|batch| batch.poses.len());
        let frame_count = poses.sum::<usize>() as u32 / 128;
        let digest = self.digest();
        let end = pb::UploadEnd {
            frame_count: self.frame_count.unwrap_or(frame_count),
            sha256: self.sha256.unwrap_or(digest),
        };
        let batches = self.batches.into_iter().map(Message::Frames);
        std::iter::once(Message::Room(self.spec))
            .chain(batches)
            .chain(self.keypoints.into_iter().map(Message::Keypoints))
            .chain([Message::End(end)])
            .map(|message| pb::UploadRoomRequest {
                message: Some(message),
            })
            .collect()
    }

    pub async fn send(self, client: &Client) -> Result<pb::UploadRoomResponse, Error> {
        client
            .upload_room(tokio_stream::iter(self.messages()))
            .await
    }
}

/// Oracle: a room that was published from the disk with the same frames and features.
#[tokio::test]
async fn an_uploaded_room_answers_as_one_from_the_disk() {
    let (server, store) = start_writable().await;
    let uploaded = async |is_new: bool| {
        let upload = Upload::synthetic("uploaded");
        let answer = upload.send(&server.client).await.unwrap();
        assert_eq!(answer.revision.unwrap().revision, 1);
        assert_eq!((answer.created, answer.served), (is_new, true));
    };
    uploaded(true).await;

    // It is served as soon as the upload is answered.
    let asked = |room: &str| {
        let room = room.to_owned();
        server.navigated(|r| (r.room, r.top_k) = (room, Some(5)))
    };
    let (here, there) = (asked("uploaded").await, asked("synthetic").await);
    assert_eq!(here.steps[0].frames.len(), 5);
    for (here, there) in here.steps[0].frames.iter().zip(&there.steps[0].frames) {
        assert_eq!(here.frame_id, there.frame_id);
        assert!((here.distance - there.distance).abs() < 1e-9);
        assert_eq!(here.frame_name, format!("frame-{}", here.frame_id));
        let taken_at = i64::from(here.frame_id) * 33_000_000;
        assert_eq!(here.timestamp_ns, Some(taken_at));
    }

    // The same again is the same revision.
    uploaded(false).await;
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the protocol. Nothing of a refused upload is in the store.
#[tokio::test]
async fn unfit_uploads_are_refused_and_leave_nothing() {
    let (server, store) = start_writable().await;
    let good = Upload::synthetic("bad");

    let cases: [Unfit<Upload>; 26] = [
        (|u| u.spec.room = "../x".into(), "room.room"),
        (|u| u.spec.room = "rooms/bad".into(), "room.room"),
        (|u| u.spec.room = String::new(), "room.room"),
        (|u| u.spec.mode = 77, "room.mode"),
        (|u| u.spec.feature_sources.clear(), "room.feature_sources"),
        (
            |u| u.spec.feature_sources[0].dim = 0,
            "room.feature_sources.dim",
        ),
        (
            |u| u.spec.feature_sources[0].dim = u32::MAX,
            "room.feature_sources.dim",
        ),
        (
            |u| u.spec.feature_sources[0].name = "a/b".into(),
            "room.feature_sources.name",
        ),
        (|u| u.spec.encode_for = "oracle".into(), "room.encode_for"),
        (|u| u.spec.license = "x".repeat(2_000), "room.license"),
        (
            |u| {
                u.spec.camera = Some(pb::CameraIntrinsics {
                    width: 640.0,
                    height: 480.0,
                    fx: f64::NAN,
                    ..pb::CameraIntrinsics::default()
                });
            },
            "room.camera",
        ),
        (
            |u| u.batches[1].poses[..8].copy_from_slice(&f64::NAN.to_le_bytes()),
            "frames.poses",
        ),
        // The translation of the first frame moves into its last row.
        (
            |u| u.batches[0].poses[96..104].copy_from_slice(&1.0_f64.to_le_bytes()),
            "frames.poses",
        ),
        (|u| u.batches[0].poses.truncate(127), "frames.poses"),
        (|u| u.batches[0].poses.clear(), "frames.poses"),
        (
            |u| {
                u.batches[0].features[0].pop();
            },
            "frames.features",
        ),
        (|u| u.batches[0].features.clear(), "frames.features"),
        (|u| u.batches[0].images.push(vec![1]), "frames.images"),
        (
            |u| {
                u.batches[1].timestamps_ns.pop();
            },
            "frames.timestamps_ns",
        ),
        (|u| u.batches[1].frame_names.clear(), "frames.frame_names"),
        (|u| u.batches[1].segments = vec![0; 100], "frames.segments"),
        (
            |u| u.batches[2].features[0][..4].copy_from_slice(&f32::NAN.to_le_bytes()),
            "frames.features",
        ),
        (|u| u.batches.clear(), "frames"),
        (|u| u.frame_count = Some(3), "end.frame_count"),
        (|u| u.sha256 = Some(vec![0; 32]), "end.sha256"),
        (|u| u.sha256 = Some(Vec::new()), "end.sha256"),
    ];
    for (alter, field) in cases {
        let mut upload = good.clone();
        alter(&mut upload);
        refused(
            field,
            upload.send(&server.client).await,
            Code::InvalidArgument,
            field,
        );
    }

    // Messages in the wrong order, and an upload that is broken off.
    let messages = good.clone().messages();
    for (sent, field) in [
        (messages[1..].to_vec(), "room"),
        ([&messages[..1], &messages[..1]].concat(), "room"),
        (messages[..2].to_vec(), "end"),
        (Vec::new(), "room"),
        (
            vec![messages[0].clone(), pb::UploadRoomRequest { message: None }],
            "message",
        ),
        ([&messages[..], &messages[1..2]].concat(), "message"),
    ] {
        let answer = server.client.upload_room(tokio_stream::iter(sent)).await;
        refused(field, answer, Code::InvalidArgument, field);
    }

    let mut checked = good.clone();
    checked.spec.validate_only = true;
    let checked = checked.send(&server.client).await.unwrap();
    assert_eq!(checked.revision, None);

    assert!(!server.folder.path().join("rooms/bad").exists());
    let defaults = store.defaults().await.unwrap();
    assert_eq!(store.current_rooms(&defaults).await.unwrap().len(), 2);

    // What was altered is what was refused.
    assert!(good.send(&server.client).await.unwrap().served);
}

/// Oracle: the bound itself.
#[tokio::test]
async fn uploads_together_hold_no_more_than_they_may() {
    let (folder, store) = filled_store().await;
    let config = Config {
        upload_bytes: 200_000,
        ..writable()
    };
    let server = start_on(folder, store, config).await;

    let refused = Upload::synthetic("large").send(&server.client).await;
    assert_eq!(refused.unwrap_err().code(), Some(Code::ResourceExhausted));

    // What the refused one held is free again.
    let mut small = Upload::synthetic("small");
    small.batches.truncate(1);
    assert!(small.send(&server.client).await.unwrap().served);
}

/// Oracle: the definition of an idempotent request.
#[tokio::test]
async fn a_change_that_is_sent_again_is_made_once() {
    let (server, _) = start_writable().await;
    let upload = |name: &str| {
        let mut upload = Upload::synthetic(name);
        upload.spec.request_id = "first".to_owned();
        upload
    };

    let first = upload("new").send(&server.client).await.unwrap();
    let again = upload("new").send(&server.client).await.unwrap();
    assert_eq!(first, again);
    assert!(again.created);

    let other = upload("other").send(&server.client).await;
    refused(
        "another room",
        other,
        Code::InvalidArgument,
        "room.request_id",
    );

    let delete = pb::DeleteRoomRequest {
        room: "new".to_owned(),
        request_id: "second".to_owned(),
        ..pb::DeleteRoomRequest::default()
    };
    for _ in 0..2 {
        let deleted = server.client.delete_room(delete.clone()).await;
        assert_eq!(deleted.unwrap(), [1]);
    }
    let gone = pb::DeleteRoomRequest {
        request_id: "third".to_owned(),
        ..delete
    };
    let gone = server.client.delete_room(gone).await;
    assert_eq!(code_of(gone), Code::NotFound);
}

/// Oracle: by hand. The newest adapter answers until another one is chosen, and again after that
/// choice is cleared; a chosen one cannot be removed.
#[tokio::test]
async fn defaults_are_set_and_cleared() {
    use pb::clear_default_request::Default as Cleared;

    let (server, store) = start_writable().await;
    publish_oracle(&store, "trial").await;

    let answering = async || server.navigated(|_| ()).await.adapter.unwrap().name;
    let set = |default: Option<Default>| {
        server.client.set_default(pb::SetDefaultRequest {
            default: default.map(|default| pb::CatalogDefault {
                default: Some(default),
            }),
            ..pb::SetDefaultRequest::default()
        })
    };
    let clear = |default: Option<Cleared>| {
        server.client.clear_default(pb::ClearDefaultRequest {
            default,
            ..pb::ClearDefaultRequest::default()
        })
    };
    let adapter = |name: &str| {
        Some(Default::RoomAdapter(pb::RoomAdapter {
            room: "synthetic".to_owned(),
            adapter: name.to_owned(),
        }))
    };
    let room = || Some(Cleared::AdapterOfRoom("synthetic".to_owned()));

    let defaults = set(adapter("trial")).await.unwrap();
    let expected = pb::CatalogDefault {
        default: adapter("trial"),
    };
    assert_eq!(defaults, [expected]);
    assert_eq!(answering().await, "trial");

    set(adapter("oracle")).await.unwrap();
    assert_eq!(answering().await, "oracle");
    let served = server.client.room("synthetic").await.unwrap();
    assert_eq!(served.adapters, ["oracle", "trial"]);

    let delete = |name: &str| {
        server.client.delete_adapter(pb::DeleteAdapterRequest {
            adapter: name.to_owned(),
            ..pb::DeleteAdapterRequest::default()
        })
    };
    let chosen = delete("oracle").await;
    assert_eq!(code_of(chosen), Code::FailedPrecondition);

    // Nothing chosen: the newest, and not what was chosen last. Another default stays.
    let first = pb::Revision {
        name: "synthetic".to_owned(),
        revision: 1,
    };
    set(Some(Default::RoomRevision(first.clone())))
        .await
        .unwrap();
    let left = clear(room()).await.unwrap();
    let expected = pb::CatalogDefault {
        default: Some(Default::RoomRevision(first)),
    };
    assert_eq!(left, [expected]);
    assert_eq!(answering().await, "trial");
    let cleared = Some(Cleared::RevisionOfRoom("synthetic".to_owned()));
    assert_eq!(clear(cleared.clone()).await.unwrap(), []);
    assert_eq!(
        clear(cleared).await.unwrap(),
        [],
        "nothing is left to clear"
    );
    assert_eq!(delete("trial").await.unwrap(), [1]);
    assert_eq!(answering().await, "oracle");

    // A request that names nothing changes nothing.
    set(adapter("oracle")).await.unwrap();
    refused("set", set(None).await, Code::InvalidArgument, "default");
    refused("clear", clear(None).await, Code::InvalidArgument, "default");
    let unstated = Some(Default::RoomRevision(pb::Revision::default()));
    let answer = set(unstated).await;
    refused(
        "unstated",
        answer,
        Code::InvalidArgument,
        "default.room_revision",
    );
    let unknown = Some(Default::RoomRevision(pb::Revision {
        name: "synthetic".to_owned(),
        revision: 7,
    }));
    for unknown in [adapter("nobody"), unknown] {
        assert_eq!(code_of(set(unknown).await), Code::NotFound);
    }
    assert_eq!(
        store.defaults().await.unwrap().adapter("synthetic"),
        Some("oracle")
    );
}

/// Oracle: the protocol: no upload replaces what is stored unless it says so, and nothing is
/// written then.
#[tokio::test]
async fn an_upload_replaces_nothing_unasked() {
    let (server, store) = start_writable().await;
    let newest = async || store.load_room("synthetic", None).await.unwrap().revision;
    let shorter = |mode: pb::UploadMode, is_checked_only| {
        let mut upload = Upload::synthetic("synthetic");
        upload.batches.truncate(2);
        upload.spec.mode = mode.into();
        upload.spec.validate_only = is_checked_only;
        upload
    };

    for mode in [pb::UploadMode::Unspecified, pb::UploadMode::Create] {
        for is_checked_only in [true, false] {
            let answer = shorter(mode, is_checked_only).send(&server.client).await;
            let error = answer.unwrap_err();
            assert_eq!(error.code(), Some(Code::AlreadyExists), "{error}");
            assert_eq!(error.reason().as_deref(), Some("ALREADY_EXISTS"));
            assert_eq!(newest().await, 1);
        }
    }

    let checked = shorter(pb::UploadMode::Replace, true);
    assert!(
        checked
            .send(&server.client)
            .await
            .unwrap()
            .revision
            .is_none()
    );
    assert_eq!(newest().await, 1);
    let replaced = shorter(pb::UploadMode::Replace, false);
    let replaced = replaced.send(&server.client).await.unwrap();
    assert_eq!(replaced.revision.unwrap().revision, 2);

    // The same content again changes nothing, so it needs no permission.
    let again = shorter(pb::UploadMode::Create, false);
    let again = again.send(&server.client).await.unwrap();
    assert_eq!(
        (again.revision.unwrap().revision, again.created),
        (2, false)
    );

    // There is nothing to replace or to extend.
    for mode in [pb::UploadMode::Replace, pb::UploadMode::Extend] {
        let mut upload = shorter(mode, false);
        upload.spec.room = "nowhere".to_owned();
        let answer = upload.send(&server.client).await;
        assert_eq!(code_of(answer), Code::NotFound, "{mode:?}");
    }
    assert_eq!(store.rooms().await.unwrap().len(), 2);
}

/// Oracle: the adapter in the store that it came from; damage that the test does.
#[tokio::test]
async fn an_adapter_moves_from_store_to_server() {
    let (server, _) = start_writable().await;
    let (_folder, other) = filled_store().await;
    let (manifest, weights) = other.adapter_files("oracle", None).await.unwrap();

    let send_as =
        async |mode: pb::UploadMode, name: &str, manifest: Vec<u8>, parts: Vec<Vec<u8>>| {
            use pb::upload_adapter_request::Message;

            let upload = pb::AdapterUpload {
                adapter: name.to_owned(),
                mode: mode.into(),
                manifest,
                ..pb::AdapterUpload::default()
            };
            let parts = parts.into_iter().map(Message::Weights);
            let messages = std::iter::once(Message::Adapter(upload)).chain(parts);
            let messages = messages.map(|message| pb::UploadAdapterRequest {
                message: Some(message),
            });
            let messages: Vec<_> = messages.collect();
            server
                .client
                .upload_adapter(tokio_stream::iter(messages))
                .await
        };
    let send = async |name: &str, manifest, parts| {
        send_as(pb::UploadMode::Create, name, manifest, parts).await
    };

    let halves = weights.chunks(weights.len() / 2 + 1);
    let halves: Vec<Vec<u8>> = halves.map(<[u8]>::to_vec).collect();
    let answer = send("copy", manifest.clone(), halves.clone()).await;
    let answer = answer.unwrap();
    assert!(answer.created && answer.served);

    // Another adapter of the same name is not replaced unasked.
    let (_folder, third) = filled_store().await;
    let features = features_of("synthetic");
    let (adapter, mut record) = (oracle_adapter(), record());
    record.config.seed += 1;
    let published = third.publish_adapter("other", &adapter, &record, features.rows());
    published.await.unwrap();
    let (other_manifest, other_weights) = third.adapter_files("other", None).await.unwrap();
    let parts = || vec![other_weights.clone()];
    let answer = send("copy", other_manifest.clone(), parts()).await;
    assert_eq!(code_of(answer), Code::AlreadyExists);
    for (mode, name, code) in [
        (pb::UploadMode::Replace, "nobody", Code::NotFound),
        (pb::UploadMode::Extend, "copy", Code::InvalidArgument),
        (pb::UploadMode::Replace, "copy", Code::Ok),
    ] {
        let answer = send_as(mode, name, other_manifest.clone(), parts()).await;
        assert_eq!(code_of(answer), code, "{name}");
    }
    let back = send_as(
        pb::UploadMode::Replace,
        "copy",
        manifest.clone(),
        halves.clone(),
    )
    .await;
    assert_eq!(back.unwrap().revision.unwrap().revision, 3);

    let original = server.navigated(|r| r.adapter = "oracle".to_owned()).await;
    let copy = server.navigated(|r| r.adapter = "copy".to_owned()).await;
    // Only the adapters of the latents differ.
    let unnamed = |mut step: pb::NavigationStep| {
        step.latent.as_mut().unwrap().adapter = None;
        step
    };
    let [original, copy] = [original, copy].map(|answer| answer.steps);
    let original = original.into_iter().map(unnamed);
    assert!(original.eq(copy.into_iter().map(unnamed)));

    let mut altered = weights.clone();
    let middle = altered.len() / 2;
    altered[middle] ^= 1;
    let mut altered_manifest = manifest.clone();
    let at = altered_manifest.len() / 2;
    altered_manifest[at] ^= 1;
    let short = vec![weights[..9].to_vec()];
    let long = vec![[&weights[..], &[0]].concat()];
    let whole = &manifest[..];
    for (name, manifest, parts, field) in [
        ("x", whole, &vec![altered], "adapter.manifest"),
        ("x", &altered_manifest, &halves, "adapter.manifest"),
        ("x", b"{}", &halves, "adapter.manifest"),
        ("x", whole, &short, "weights"),
        ("x", whole, &long, "weights"),
        ("adapters/x", whole, &halves, "adapter.adapter"),
        ("..", whole, &halves, "adapter.adapter"),
    ] {
        let answer = send(name, manifest.to_vec(), parts.clone()).await;
        refused(name, answer, Code::InvalidArgument, field);
    }
    assert_eq!(server.client.adapters().await.unwrap().len(), 2);
}

/// Oracle: the recorded poses: the adapter that was fitted on the server locates views of its room.
#[tokio::test]
async fn a_room_is_fitted_on_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let (hall, features) = world::served("hall");
    store
        .publish_room(&hall, std::slice::from_ref(&features))
        .await
        .unwrap();
    let server = start_on(folder, store, writable()).await;

    let request = pb::FitAdapterRequest {
        room: "hall".to_owned(),
        request_id: "fit".to_owned(),
        ..pb::FitAdapterRequest::default()
    };
    let mut steps = 0;
    let counted = |step: pb::FitProgress| {
        steps += 1;
        assert!((0..=step.total).contains(&step.done));
    };
    let result = server.client.fit_adapter(request.clone(), counted).await;
    let result = result.unwrap();
    assert!(result.created && result.served && steps > 0);
    let revision = result.revision.as_ref().unwrap();
    assert_eq!(revision.name, "hall.made-up.fitted");

    let located = server.localized(|r| {
        r.rooms = vec!["hall".to_owned()];
        r.view = feature(features.rows().row(100).to_vec());
    });
    assert!(located.await.fitted.is_some());

    // The same again is answered from memory, without a fit.
    let mut steps = 0;
    let again = server.client.fit_adapter(request.clone(), |_| steps += 1);
    assert_eq!((again.await.unwrap(), steps), (result, 0));

    let seeded = pb::FitAdapterRequest {
        seed: u64::MAX,
        ..request.clone()
    };
    let answer = server.client.fit_adapter(seeded, |_| ()).await;
    refused("another seed", answer, Code::InvalidArgument, "seed");

    let cases: [(fn(&mut pb::FitAdapterRequest), _, _); 3] = [
        (|r| r.room = "nowhere".into(), Code::NotFound, "room"),
        (
            |r| r.feature_set = "none".into(),
            Code::InvalidArgument,
            "feature_set",
        ),
        (
            |r| r.base_adapter = "hall.made-up.fitted".into(),
            Code::InvalidArgument,
            "base_adapter",
        ),
    ];
    for (spoil, code, field) in cases {
        let mut request = pb::FitAdapterRequest {
            request_id: String::new(),
            ..request.clone()
        };
        spoil(&mut request);
        let answer = server.client.fit_adapter(request, |_| ()).await;
        refused(field, answer, code, field);
    }
}

/// Oracle: the meaning of the flag and of the file of credentials.
#[tokio::test]
async fn only_those_who_may_change_what_they_may() {
    let (folder, store) = filled_store().await;
    let closed = start_on(folder, store, Config::default()).await;
    let refused = Upload::synthetic("new").send(&closed.client).await;
    assert_eq!(refused.unwrap_err().code(), Some(Code::FailedPrecondition));

    let (folder, store) = filled_store().await;
    let file = folder.path().join("auth.toml");
    let callers = [
        principal("reader", "\"catalog\", \"navigate\"", "\"*\""),
        principal("writer", "\"write\", \"catalog\"", "\"*\""),
        principal("mover", "\"write\", \"catalog\"", "\"new-*\""),
    ];
    std::fs::write(&file, callers.concat()).unwrap();
    let config = Config {
        keyring: Some(Arc::new(Keyring::open(file).unwrap())),
        ..writable()
    };
    let server = start_on(folder, store, config).await;

    let outcome = async |caller: Option<&str>, room: &str| {
        let client = client_with(&server, caller).await;
        code_of(Upload::synthetic(room).send(&client).await)
    };
    for (caller, room, expected) in [
        (None, "new-1", Code::Unauthenticated),
        (Some("reader"), "new-1", Code::PermissionDenied),
        (Some("mover"), "new-1", Code::Ok),
        (Some("mover"), "old", Code::PermissionDenied),
        (Some("writer"), "old", Code::Ok),
    ] {
        assert_eq!(outcome(caller, room).await, expected, "{caller:?} {room}");
    }

    // Adapters answer everywhere, so they are for those who see every room.
    let delete = pb::DeleteAdapterRequest {
        adapter: "oracle".to_owned(),
        ..pb::DeleteAdapterRequest::default()
    };
    for (caller, expected) in [("mover", Code::PermissionDenied), ("writer", Code::Ok)] {
        let client = client_with(&server, Some(caller)).await;
        let code = code_of(client.delete_adapter(delete.clone()).await);
        assert_eq!(code, expected, "{caller}");
    }
}

/// Oracle: the bound on waiting changes of one caller, half of 64: each is made or refused as one
/// too many, and the server goes on. More than one blocking thread each would be more than there
/// are.
#[tokio::test]
async fn many_changes_at_once_are_made_or_refused() {
    let (server, store) = start_writable().await;
    let mut changes = tokio::task::JoinSet::new();

    for number in 0..600 {
        let client = server.client.clone();
        changes.spawn(async move {
            let revision = pb::Revision {
                name: "synthetic".to_owned(),
                revision: 1,
            };
            if number % 2 == 0 {
                let cleared = pb::clear_default_request::Default::RevisionOfRoom(revision.name);
                return code_of(
                    client
                        .clear_default(pb::ClearDefaultRequest {
                            default: Some(cleared),
                            ..pb::ClearDefaultRequest::default()
                        })
                        .await,
                );
            }
            let default = Default::RoomRevision(revision);
            let request = pb::SetDefaultRequest {
                default: Some(pb::CatalogDefault {
                    default: Some(default),
                }),
                ..pb::SetDefaultRequest::default()
            };
            code_of(client.set_default(request).await)
        });
    }

    let codes = changes.join_all().await;
    let count = |code: Code| codes.iter().filter(|found| **found == code).count();
    assert_eq!(count(Code::Ok) + count(Code::ResourceExhausted), 600);
    assert!(count(Code::Ok) >= 32, "{} were made", count(Code::Ok));

    assert!(server.client.navigate(question()).await.is_ok());
    assert!(store.verify(&|_| ()).await.unwrap().is_empty());
}

/// Oracle: the promise: a change that was admitted is made, whoever waits for it, and the same
/// change that is sent again meanwhile is the same change.
#[tokio::test]
async fn a_caller_that_goes_away_leaves_its_change() {
    let (server, store) = start_writable().await;
    let upload = || {
        let mut upload = Upload::synthetic("left");
        upload.spec.request_id = "left".to_owned();
        upload
    };

    let client = server.client.clone();
    let leaving = tokio::spawn(async move { upload().send(&client).await });
    let sent_again = upload().send(&server.client).await.unwrap();
    leaving.abort();
    let _ = leaving.await;

    assert_eq!(sent_again.revision.unwrap().revision, 1);
    assert_eq!(store.load_room("left", None).await.unwrap().revision, 1);
}

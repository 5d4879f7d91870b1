//! A robot adds frames to the room that it drives in.

use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::track_response::Answer;
use seese3_client::proto::v1::upload_room_request::Message;
use seese3_core::geometry::PoseError;
use seese3_server::{Config, TokenKey};
use sha2::{Digest, Sha256};
use tonic::Code;

use crate::harness::{TestServer, feature};
use crate::tracking::{answers, config, followed, resume, start_followed};
use seese3_testing::world::served;

async fn server() -> TestServer {
    start_followed(Config {
        writable: true,
        token_key: TokenKey::new(b"a secret of the tests").unwrap(),
        ..Config::default()
    })
    .await
}

/// What adds frames to the hall.
fn extension() -> pb::RoomUpload {
    pb::RoomUpload {
        room: "hall".to_owned(),
        feature_sources: vec![pb::FeatureSource {
            name: "made-up".to_owned(),
            dim: served("hall").1.source().dim as u32,
            ..pb::FeatureSource::default()
        }],
        mode: pb::UploadMode::Extend.into(),
        ..pb::RoomUpload::default()
    }
}

/// Sends some rows of a place.
async fn send(
    server: &TestServer,
    upload: pb::RoomUpload,
    place: &str,
    rows: std::ops::Range<usize>,
) -> Result<pb::UploadRoomResponse, seese3_client::Error> {
    let (room, features) = served(place);
    let poses = rows.clone().flat_map(|row| {
        let matrix = room.poses()[row].to_homogeneous().transpose();
        matrix
            .iter()
            .flat_map(|x| x.to_le_bytes())
            .collect::<Vec<u8>>()
    });
    let numbers = rows
        .clone()
        .flat_map(|row| features.rows().row(row).to_vec());
    let batch = pb::FrameBatch {
        poses: poses.collect(),
        features: vec![numbers.flat_map(f32::to_le_bytes).collect()],
        ..pb::FrameBatch::default()
    };

    let digest = Sha256::new()
        .chain_update(&batch.poses)
        .chain_update(&batch.features[0]);
    let end = pb::UploadEnd {
        frame_count: rows.len() as u32,
        sha256: digest.finalize().to_vec(),
    };
    let messages = [
        Message::Room(upload),
        Message::Frames(batch),
        Message::End(end),
    ];
    let messages = messages.map(|message| pb::UploadRoomRequest {
        message: Some(message),
    });
    server
        .client
        .upload_room(tokio_stream::iter(messages))
        .await
}

/// Oracle: the contract (docs/defaults.md): the fitted adapter locates the views of another one, and
/// is named with its revision; a request that states the other one's revision is answered by that
/// one.
async fn a_stated_adapter_answers_alone(server: &TestServer) {
    let localized = async |adapter: &str, adapter_revision| {
        let request = pb::LocalizeRequest {
            rooms: vec!["hall".to_owned()],
            adapter: adapter.to_owned(),
            adapter_revision,
            view: feature(served("attic").1.rows().row(40).to_vec()),
            ..pb::LocalizeRequest::default()
        };
        server.client.localize(request).await.unwrap()
    };
    let fitted = |answer: &pb::LocalizeResponse| {
        let fitted = answer.fitted.as_ref()?;
        assert_eq!(answer.method(), pb::LocalizationMethod::FittedAdapter);
        let adapter = fitted.adapter.clone().unwrap();
        Some((adapter.name, adapter.revision))
    };

    let by_fitted = Some(("hall.made-up.fitted".to_owned(), 2));
    assert_eq!(fitted(&localized("followed", None).await), by_fitted);
    let stated = localized("followed", Some(1)).await;
    assert_eq!(fitted(&stated), None);
    assert_eq!(stated.method(), pb::LocalizationMethod::SimilarFrames);
    let stated = localized("hall.made-up.fitted", Some(2)).await;
    assert_eq!(fitted(&stated), by_fitted);
}

/// Oracle: the recorded poses. A stream that began before the room grew goes on at its token, in
/// the grown room; the frames that were added are found; and an adapter is fitted to all of them.
#[tokio::test]
async fn streams_and_tokens_survive_the_growth_of_a_room() {
    let server = server().await;
    let before = followed(config(), 0..60);
    let first = answers(&server, before).await.unwrap();
    let token = first[60].resume_token.clone();

    let fit = || pb::FitAdapterRequest {
        room: "hall".to_owned(),
        ..pb::FitAdapterRequest::default()
    };
    server.client.fit_adapter(fit(), |_| ()).await.unwrap();

    // The attic's frames stand for a part of the hall that was not mapped.
    let answer = send(&server, extension(), "attic", 0..80).await.unwrap();
    assert_eq!(answer.revision.unwrap().revision, 2);
    assert!(answer.created && answer.served);
    let room = server.client.room("hall").await.unwrap();
    assert_eq!(room.frame_count, 380);

    // Rules that were measured in the smaller room tell nothing of the larger one, until the next
    // fit.
    let located = || async {
        let request = pb::LocalizeRequest {
            rooms: vec!["hall".to_owned()],
            adapter: "hall.made-up.fitted".to_owned(),
            view: feature(served("attic").1.rows().row(40).to_vec()),
            ..pb::LocalizeRequest::default()
        };
        server.client.localize(request).await.unwrap().fitted
    };
    assert!(located().await.is_none());
    server.client.fit_adapter(fit(), |_| ()).await.unwrap();
    assert!(located().await.is_some());

    let localized = server
        .client
        .localize(pb::LocalizeRequest {
            rooms: vec!["hall".to_owned()],
            adapter: "followed".to_owned(),
            view: feature(served("attic").1.rows().row(40).to_vec()),
            ..pb::LocalizeRequest::default()
        })
        .await
        .unwrap();
    assert_eq!(localized.frames[0].frame.as_ref().unwrap().frame_id, 340);
    a_stated_adapter_answers_alone(&server).await;

    let rest = followed(resume(token), 60..120);
    let rest = answers(&server, rest).await.unwrap();
    let (hall, _) = served("hall");
    for (row, answer) in (60..120).zip(&rest[1..]) {
        let Some(Answer::Update(update)) = &answer.answer else {
            panic!("{answer:?}");
        };
        assert_eq!(update.status, pb::TrackStatus::Tracking as i32, "{row}");
        assert_eq!(update.room.as_ref().unwrap().revision, 2);

        let pose = update.map_from_camera().cloned().unwrap();
        let pose = seese3_client::convert::pose(&pose).unwrap();
        let error = PoseError::between(&hall.poses()[row], &pose);
        assert!(error.translation_m < 0.1, "{row}: {error:?}");
    }
}

/// Oracle: the protocol. Nothing of a refused extension is in the room.
#[tokio::test]
async fn unfit_extensions_are_refused_and_leave_the_room() {
    let server = server().await;
    let upload = extension;
    let cases = [
        (
            pb::RoomUpload {
                room: "cellar".to_owned(),
                ..upload()
            },
            Code::NotFound,
            "room.room",
        ),
        (
            pb::RoomUpload {
                license: "CC0".to_owned(),
                ..upload()
            },
            Code::InvalidArgument,
            "room.license",
        ),
        (
            pb::RoomUpload {
                mode: pb::UploadMode::Replace.into(),
                drop_other_features: true,
                ..upload()
            },
            Code::InvalidArgument,
            "room.drop_other_features",
        ),
        (
            pb::RoomUpload {
                feature_sources: vec![pb::FeatureSource {
                    name: "other".to_owned(),
                    ..upload().feature_sources[0].clone()
                }],
                ..upload()
            },
            Code::InvalidArgument,
            "room.feature_sources",
        ),
    ];

    for (upload, code, field) in cases {
        let error = send(&server, upload, "attic", 0..10).await.unwrap_err();
        let found = (error.code(), error.field().unwrap_or_default());
        assert_eq!(found, (Some(code), field.to_owned()), "{error}");
    }

    // What is only checked changes nothing; what is there already is not added again.
    let checked = pb::RoomUpload {
        validate_only: true,
        ..upload()
    };
    send(&server, checked, "attic", 0..10).await.unwrap();
    for created in [true, false] {
        let answer = send(&server, upload(), "attic", 0..10).await.unwrap();
        assert_eq!(
            (answer.revision.unwrap().revision, answer.created),
            (2, created)
        );
    }
}

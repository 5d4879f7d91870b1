//! Following a camera over the wire: answers, refusals, and going on elsewhere.

use std::ops::Range;

use prost::Message as _;
use seese3_client::convert;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::track_request::Message;
use seese3_client::proto::v1::track_response::Answer;
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera, Pose, PoseError};
use seese3_core::room::{Provenance, Room};
use seese3_server::{Config, TokenKey};
use seese3_store::Store;
use tonic::Code;

use crate::harness::{TestServer, Unfit, feature, frame, of_intrinsics, start_on};
use seese3_testing::world::{FRAMES, calibrated, place, served};

/// Two places, and an adapter that can be followed with; `key` seals tokens.
async fn server(key: &[u8]) -> TestServer {
    start_followed(Config {
        token_key: TokenKey::new(key).unwrap(),
        ..Config::default()
    })
    .await
}

/// Two places, and an adapter that can be followed with.
pub async fn start_followed(config: Config) -> TestServer {
    let (folder, store) = store_of_places().await;
    start_on(folder, store, config).await
}

async fn store_of_places() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    for name in ["hall", "attic"] {
        let (room, features) = served(name);
        store.publish_room(&room, &[features]).await.unwrap();
    }

    let (adapter, record) = calibrated();
    store
        .publish_adapter("followed", &adapter, &record, served("hall").1.rows())
        .await
        .unwrap();

    (folder, store)
}

const KEY: &[u8] = b"a secret of the tests";

pub fn config() -> pb::TrackConfig {
    pb::TrackConfig {
        room: "hall".to_owned(),
        ..pb::TrackConfig::default()
    }
}

pub fn begin(config: pb::TrackConfig) -> pb::TrackRequest {
    pb::TrackRequest {
        message: Some(Message::Config(config)),
    }
}

/// Configures a stream that goes on from a token.
pub fn resume(resume_token: Vec<u8>) -> pb::TrackConfig {
    pb::TrackConfig {
        resume_token,
        ..pb::TrackConfig::default()
    }
}

/// A stream that is configured so and sees these rows of the hall.
pub fn followed(config: pb::TrackConfig, rows: Range<usize>) -> Vec<pb::TrackRequest> {
    std::iter::once(begin(config))
        .chain(rows.map(seen))
        .collect()
}

/// Row `row` of the hall, as a camera's frame with that number and time.
pub fn seen(row: usize) -> pb::TrackRequest {
    seen_of("hall", row)
}

fn seen_of(room: &str, row: usize) -> pb::TrackRequest {
    let view = feature(served(room).1.rows().row(row).to_vec());
    message(pb::TrackFrame {
        timestamp_ns: row as i64 * 33_000_000,
        sequence_number: row as u64 + 1,
        view,
        ..pb::TrackFrame::default()
    })
}

fn message(frame: pb::TrackFrame) -> pb::TrackRequest {
    pb::TrackRequest {
        message: Some(Message::Frame(frame)),
    }
}

/// All answers of a stream; an error ends it.
pub async fn answers(
    server: &TestServer,
    requests: Vec<pb::TrackRequest>,
) -> Result<Vec<pb::TrackResponse>, tonic::Status> {
    let mut stream = match server.client.track(tokio_stream::iter(requests)).await {
        Ok(stream) => stream,
        Err(seese3_client::Error::Refused(status)) => return Err(*status),
        Err(other) => panic!("{other}"),
    };

    let mut answers = Vec::new();
    while let Some(mut answer) = stream.message().await? {
        if let Some(Answer::Update(update)) = &mut answer.answer {
            // The one thing that two runs may differ in.
            update.timing = None;
        }

        answers.push(answer);
    }

    Ok(answers)
}

fn update(answer: &pb::TrackResponse) -> &pb::TrackUpdate {
    match &answer.answer {
        Some(Answer::Update(update)) => update,
        other => panic!("no update: {other:?}"),
    }
}

fn matrix(numbers: &[f64]) -> nalgebra::Matrix6<f64> {
    nalgebra::Matrix6::from_row_slice(numbers)
}

fn initial_pose(row: usize) -> Option<pb::InitialPose> {
    let pose = convert::pose_to_wire(&served("hall").0.poses()[row], "", "");
    Some(pb::InitialPose {
        pose: Some(pose),
        ..pb::InitialPose::default()
    })
}

/// Oracle: the recorded poses, and the definitions: odom begins at the origin, map is odom seen
/// from map, covariances are symmetric and positive definite.
#[tokio::test]
async fn a_camera_in_a_mapped_room_is_followed() {
    let server = server(KEY).await;

    let answers = answers(&server, followed(config(), 0..120)).await.unwrap();

    assert_eq!(answers.len(), 121);
    assert!(matches!(&answers[0].answer, Some(Answer::Started(started)) if started.room.is_some()));

    let poses = served("hall").0.poses().to_vec();

    for (row, answer) in answers[1..].iter().enumerate() {
        let update = update(answer);
        assert_eq!(update.sequence_number, row as u64 + 1);
        assert_eq!(update.timestamp_ns, row as i64 * 33_000_000);

        let camera = update.camera.as_ref().unwrap();
        let keyframe = update.keyframe.as_ref().unwrap();
        let velocity = camera.velocity.as_ref();
        let covariances = [
            &camera.odom_pose.as_ref().unwrap().covariance,
            &keyframe.motion.as_ref().unwrap().covariance,
        ];
        for numbers in covariances
            .into_iter()
            .chain(velocity.map(|velocity| &velocity.covariance))
        {
            let covariance = matrix(numbers);
            assert!(
                (covariance - covariance.transpose()).amax() < 1e-12,
                "{row}"
            );
            assert!(covariance.cholesky().is_some(), "{row}");
        }
    }

    let searching = update(&answers[1]);
    let candidate = searching.hypothesis.as_ref().unwrap();
    assert_eq!((candidate.sequence_number, candidate.agreed), (1, 1));
    assert_eq!(candidate.needed, 10);

    // It is reported, not believed.
    assert!(searching.map_from_camera().is_none());

    let last = update(&answers[120]);
    assert!(last.hypothesis.is_none());
    assert_eq!(last.status(), pb::TrackStatus::Tracking, "{}", last.reason);

    let of = |pose: Option<&pb::Pose>| convert::pose(pose.unwrap()).unwrap();

    let error = PoseError::between(&of(last.map_from_camera()), &poses[119]);
    assert!(error.translation_m < 0.2, "{error:?}");
    assert!(error.rotation_rad < 0.2, "{error:?}");

    let through = of(last.map_from_odom.as_ref()) * of(last.odom_from_camera());
    assert!(PoseError::between(&through, &of(last.map_from_camera())).translation_m < 1e-9);
    assert_eq!(last.map_from_odom.as_ref().unwrap().parent_frame, "map");
    assert_eq!(last.odom_from_camera().unwrap().parent_frame, "odom");

    let first = update(&answers[1]);
    let begins_at = of(first.odom_from_camera()).translation.vector;
    assert!(begins_at.norm() < 1e-12 && first.camera.as_ref().unwrap().velocity.is_none());
}

/// Oracle: the contract. A token holds the map pose to the bit: two servers with the same content
/// and key answer the same from it, bit by bit, tokens and all. The answers are nearly those of the
/// stream that was never cut. The odometry begins anew.
#[tokio::test]
async fn a_stream_goes_on_at_another_server() {
    let one = server(KEY).await;
    let two = server(KEY).await;

    let whole = answers(&one, followed(config(), 0..60)).await.unwrap();
    for cut in [1, 15, 31, 60] {
        let first = answers(&one, followed(config(), 0..cut)).await.unwrap();
        assert!(first == whole[..=cut], "up to {cut}");
        assert!(first[cut].resume_token.len() < 600, "{cut}");

        let rest = followed(resume(first[cut].resume_token.clone()), cut..60);
        let here = answers(&one, rest.clone()).await.unwrap();
        let there = answers(&two, rest).await.unwrap();
        assert!(here == there, "from {cut}");
        is_nearly(&here[1..], &whole[cut + 1..]);
        if let Some(next) = here.get(1) {
            let odom = pose_of(update(next).odom_from_camera());
            assert!(odom.translation.vector.norm() < 0.05, "{cut}");
        }
    }
}

fn pose_of(given: Option<&pb::Pose>) -> Pose {
    convert::pose(given.unwrap()).unwrap()
}

/// Checks that updates have the map poses of others to 1 cm, if both have one.
pub fn is_nearly(found: &[pb::TrackResponse], expected: &[pb::TrackResponse]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        let [found, expected] = [found, expected].map(update);
        assert_eq!(found.sequence_number, expected.sequence_number);
        let both = (found.map_from_camera(), expected.map_from_camera());
        if let (Some(found), Some(expected)) = both {
            let [found, expected] = [found, expected].map(|pose| pose_of(Some(pose)));
            let error = PoseError::between(&found, &expected);
            assert!(error.translation_m < 0.01, "{error:?}");
        }
    }
}

/// Oracle: the stream that brings a token with every answer: the others answer the same, with
/// tokens where they were asked for, and are resumed from them.
#[tokio::test]
async fn tokens_come_when_they_are_asked_for() {
    let server = server(KEY).await;
    let frames = |asking: usize| -> Vec<pb::TrackRequest> {
        (0..20)
            .map(seen)
            .enumerate()
            .map(|(row, mut request)| {
                if let Some(Message::Frame(frame)) = &mut request.message {
                    frame.with_token = row == asking;
                }
                request
            })
            .collect()
    };
    let stream = async |token_every: Option<u32>| {
        let config = pb::TrackConfig {
            token_every,
            ..config()
        };
        let requests = [vec![begin(config)], frames(12)].concat();
        answers(&server, requests).await.unwrap()
    };

    let whole = stream(None).await;
    for (every, expected) in [(Some(0), vec![12]), (Some(5), vec![4, 9, 12, 14, 19])] {
        let thin = stream(every).await;
        let rows = 0..20;
        let with_token: Vec<usize> = rows
            .filter(|row| !thin[row + 1].resume_token.is_empty())
            .collect();
        assert_eq!(with_token, expected, "{every:?}");
        assert!(!thin[0].resume_token.is_empty(), "the first answer has one");
        for (thin, whole) in thin.iter().zip(&whole) {
            assert_eq!(thin.answer, whole.answer);
        }

        let resumed = resume(thin[13].resume_token.clone());
        let rest = [vec![begin(resumed)], (13..20).map(seen).collect()].concat();
        let rest = answers(&server, rest).await.unwrap();
        assert_eq!(rest.len(), 8);
        is_nearly(&rest[1..], &whole[14..]);
    }
}

/// Oracle: the promise: forged, altered, foreign and outdated tokens are refused by name.
#[tokio::test]
async fn tokens_that_are_not_genuine_are_refused() {
    let other = self::server(b"another secret, long enough").await;
    let server = server(KEY).await;
    let first = answers(&server, followed(config(), 0..1)).await.unwrap();
    let token = first[1].resume_token.clone();
    let mut altered = token.clone();

    altered[40] ^= 1;

    for (what, server, token) in [
        ("altered", &server, altered),
        ("forged", &server, vec![7; 300]),
        ("another server's", &other, token.clone()),
    ] {
        let error = answers(server, followed(resume(token), 1..2))
            .await
            .unwrap_err();
        assert_eq!(error.code(), Code::InvalidArgument, "{what}: {error:?}");
        assert!(
            error.message().contains("resume_token"),
            "{what}: {error:?}"
        );
    }

    let both = pb::TrackConfig {
        resume_token: token.clone(),
        ..config()
    };

    let error = answers(&server, vec![begin(both)]).await.unwrap_err();
    assert_eq!(error.code(), Code::InvalidArgument);

    let (room, features) = place("hall", 99);
    let store = Store::open(other.folder.path().to_str().unwrap()).unwrap();
    store.publish_room(&room, &[features]).await.unwrap();

    let config = Config {
        token_key: TokenKey::new(KEY).unwrap(),
        ..Config::default()
    };
    let newer = start_on(tempfile::tempdir().unwrap(), store, config).await;

    let error = answers(&newer, vec![begin(resume(token))])
        .await
        .unwrap_err();
    assert_eq!(error.code(), Code::FailedPrecondition, "{error:?}");
}

/// Oracle: the same stream without them: what is refused leaves no trace.
#[tokio::test]
async fn late_and_duplicate_frames_are_refused_and_leave_no_trace() {
    let server = server(KEY).await;
    let plain = answers(&server, followed(config(), 0..20)).await.unwrap();

    let bad = |timestamp_ns, sequence_number, view| {
        message(pb::TrackFrame {
            timestamp_ns,
            sequence_number,
            view,
            ..pb::TrackFrame::default()
        })
    };
    let bad = [
        bad(0, 100, feature(vec![0.0; 48])),
        bad(i64::MAX, 3, feature(vec![0.0; 48])),
        bad(i64::MAX, 100, feature(vec![0.0; 47])),
        bad(i64::MAX, 100, feature(vec![f32::NAN; 48])),
        bad(i64::MAX, 100, frame(3)),
        bad(i64::MAX, 100, None),
    ];
    let requests = [begin(config())]
        .into_iter()
        .chain((0..10).map(seen))
        .chain(bad)
        .chain((10..20).map(seen));

    let found = answers(&server, requests.collect()).await.unwrap();
    assert_eq!(found[..11], plain[..11]);
    assert_eq!(found[17..], plain[11..]);

    use pb::TrackRefusalReason as Reason;

    let reasons = [
        Reason::Late,
        Reason::Duplicate,
        Reason::View,
        Reason::View,
        Reason::View,
        Reason::View,
    ];

    for (answer, reason) in found[11..17].iter().zip(reasons) {
        let Some(Answer::Refusal(refusal)) = &answer.answer else {
            panic!("{answer:?}")
        };

        assert_eq!(refusal.reason(), reason, "{refusal:?}");
        assert!(!refusal.message.is_empty());
    }
}

/// Oracle: the contract: views of another place are not TRACKING after 0.1 s. The pose is
/// continued, and is less certain than before.
#[tokio::test]
async fn a_camera_in_another_place_is_not_tracked() {
    let server = server(KEY).await;
    let moon = place("moon", 77).1;

    let elsewhere = |row: usize| {
        // Nothing like any of the places.
        let strange = |column: usize| 4.0 * (column as f32 * 1.7).sin();
        let seen = moon.rows().row(row).to_vec();

        let numbers = seen.into_iter().enumerate();
        let view = feature(numbers.map(|(column, x)| x + strange(column)).collect());
        message(pb::TrackFrame {
            timestamp_ns: row as i64 * 33_000_000,
            sequence_number: row as u64 + 1,
            view,
            ..pb::TrackFrame::default()
        })
    };

    let known = pb::TrackConfig {
        initial_pose: initial_pose(0),
        ..config()
    };
    let requests = [begin(known)]
        .into_iter()
        .chain((0..20).map(seen))
        .chain((20..40).map(elsewhere));

    let found = answers(&server, requests.collect()).await.unwrap();
    assert_eq!(update(&found[20]).status(), pb::TrackStatus::Tracking);

    for answer in &found[25..] {
        let update = update(answer);
        let reason = &update.reason;
        assert_eq!(update.status(), pb::TrackStatus::Degraded, "{reason}");
        let novelty = update.r#match.as_ref().unwrap().novelty;
        assert!(novelty.unwrap() > 1.0, "{reason}");
    }
    let volume = |row: usize| {
        let camera = update(&found[row]).camera.as_ref().unwrap();
        matrix(&camera.map_pose.as_ref().unwrap().covariance).determinant()
    };
    assert!(volume(40) > volume(20));
}

/// Oracle: the order of messages, by hand.
#[tokio::test]
async fn a_stream_is_configured_once_and_first() {
    let server = server(KEY).await;
    let with_camera = |focal: f64| {
        begin(pb::TrackConfig {
            camera: of_intrinsics(pb::CameraIntrinsics {
                width: 1280.0,
                height: 960.0,
                fx: focal,
                ..pb::CameraIntrinsics::default()
            }),
            ..config()
        })
    };

    // The hall was mapped with 585 pixels in images 640 wide, which see 57 degrees across. 1,100 in
    // images 1,280 wide see 60; 1,000 see 65.
    answers(&server, vec![with_camera(1_100.0)]).await.unwrap();

    let refuses = async |requests: Vec<pb::TrackRequest>, word: &str| {
        let error = answers(&server, requests).await.unwrap_err();
        let is_right = [Code::InvalidArgument, Code::NotFound].contains(&error.code());
        assert!(is_right, "{error:?}");
        assert!(
            error.message().contains(word),
            "{error:?} does not say {word}"
        );
    };
    for (requests, word) in [
        (vec![seen(0)], "config"),
        (vec![], "config"),
        (vec![with_camera(1_000.0)], "config.camera"),
        (vec![with_camera(-5.0)], "config.camera"),
        (vec![begin(config()), begin(config())], "config"),
        (
            vec![begin(config()), pb::TrackRequest { message: None }],
            "message",
        ),
    ] {
        refuses(requests, word).await;
    }

    fn keyframes(
        motion_norm: Option<f64>,
        sequence_interval: Option<u32>,
    ) -> Option<pb::KeyframePolicy> {
        Some(pb::KeyframePolicy {
            motion_norm,
            sequence_interval,
        })
    }
    let cases: [Unfit<pb::TrackConfig>; 8] = [
        (|c| c.room = "nowhere".into(), "config.room"),
        (|c| c.rooms = vec!["hall".into()], "config.rooms"),
        (|c| c.fusion = 9, "config.fusion"),
        (|c| c.back_pressure = 9, "config.back_pressure"),
        (
            |c| c.keyframes = keyframes(Some(f64::NAN), None),
            "config.keyframes.motion_norm",
        ),
        (
            |c| c.keyframes = keyframes(None, Some(0)),
            "config.keyframes.sequence_interval",
        ),
        (
            |c| c.initial_pose = Some(pb::InitialPose::default()),
            "config.initial_pose.pose",
        ),
        (
            |c| {
                c.frame_names = Some(pb::FrameNames {
                    map: "x".to_owned(),
                    odom: "x".to_owned(),
                    ..pb::FrameNames::default()
                });
            },
            "config.frame_names",
        ),
    ];
    for (spoil, word) in cases {
        let mut config = config();
        spoil(&mut config);
        refuses(vec![begin(config)], word).await;
    }
}

/// Oracle: the contract: where no room is named, those that are too small to track in, or that
/// another camera has mapped, are left out; and they are refused by name.
#[tokio::test]
async fn rooms_that_cannot_be_tracked_in_do_not_stop_a_search() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::create(folder.path().to_str().unwrap()).unwrap();
    let (adapter, record) = calibrated();
    for name in ["hall", "attic", "small"] {
        let (room, features) = served(name);
        let rows: Vec<usize> = (0..if name == "small" { 2 } else { FRAMES }).collect();
        let wide = PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: [320.0, 320.0].into(),
            center: None,
            distortion: Distortion::None,
        };
        let provenance = match name {
            "attic" => Provenance {
                camera: Some(CameraIntrinsics::new(wide).unwrap()),
                ..Provenance::default()
            },
            _ => room.provenance().clone(),
        };
        let room = Room::new(room.id().clone(), room.frames().select(&rows), provenance);
        store
            .publish_room(&room.unwrap(), &[features.select(&rows)])
            .await
            .unwrap();
    }
    store
        .publish_adapter("followed", &adapter, &record, served("hall").1.rows())
        .await
        .unwrap();
    let server = start_on(folder, store, Config::default()).await;

    let anywhere = pb::TrackConfig {
        camera: of_intrinsics(pb::CameraIntrinsics {
            width: 640.0,
            height: 480.0,
            fx: 585.0,
            ..pb::CameraIntrinsics::default()
        }),
        ..pb::TrackConfig::default()
    };
    let found = answers(&server, followed(anywhere.clone(), 0..30));
    let found = found.await.unwrap();
    assert_eq!(update(&found[30]).room.as_ref().unwrap().name, "hall");

    for (room, code, word) in [
        ("small", Code::FailedPrecondition, "too few"),
        ("attic", Code::InvalidArgument, "config.camera"),
    ] {
        let named = pb::TrackConfig {
            room: room.to_owned(),
            ..anywhere.clone()
        };
        let error = answers(&server, vec![begin(named)]).await.unwrap_err();
        assert_eq!(error.code(), code, "{error:?}");
        assert!(error.message().contains(word), "{error:?}");
    }
}

/// Oracle: the recorded poses: a camera that is put somewhere is there at its last frame, however
/// old its keyframe is.
#[tokio::test]
async fn a_camera_is_put_where_it_is_not_where_its_keyframe_was() {
    let server = server(KEY).await;

    let config = pb::TrackConfig {
        initial_pose: initial_pose(0),
        fusion: pb::Fusion::None as i32,
        ..config()
    };

    let requests = [followed(config, 0..9), vec![put(8), seen(9)]].concat();
    let found = answers(&server, requests).await.unwrap();
    let keyframe = update(&found[9]).keyframe.as_ref().unwrap().sequence_number;
    assert_eq!(keyframe, 1, "the keyframe is old");

    let named = update(&found[11]).map_from_camera().cloned().unwrap();
    let plain = pb::Pose {
        parent_frame: String::new(),
        child_frame: String::new(),
        ..named
    };
    let plain = convert::pose(&plain).unwrap();
    let error = PoseError::between(&plain, &served("hall").0.poses()[9]);
    assert!(error.translation_m < 0.05, "{error:?}");
    assert!(error.rotation_rad < 0.05, "{error:?}");
}

/// Oracle: the recorded rooms: a room that is not named is found, the first one by name as well as
/// the second, also when the stream is cut before that.
#[tokio::test]
async fn a_room_that_is_not_named_is_found() {
    let server = server(KEY).await;
    let nowhere = pb::TrackConfig::default();

    for room in ["attic", "hall"] {
        let whole = [begin(nowhere.clone())]
            .into_iter()
            .chain((0..40).map(|row| seen_of(room, row)))
            .collect();
        let found = answers(&server, whole).await.unwrap();

        let last = update(&found[40]);
        let reason = &last.reason;
        assert_eq!(last.status(), pb::TrackStatus::Tracking, "{room}: {reason}");
        assert_eq!(last.room.as_ref().unwrap().name, room);

        let map_from_camera = convert::pose(last.map_from_camera().unwrap()).unwrap();
        let error = PoseError::between(&map_from_camera, &served(room).0.poses()[39]);
        assert!(error.translation_m < 0.2, "{room}: {error:?}");

        let resumed = resume(found[4].resume_token.clone());
        let rest = [begin(resumed)]
            .into_iter()
            .chain((4..40).map(|row| seen_of(room, row)))
            .collect();
        let rest = answers(&server, rest).await.unwrap();
        let last = update(&rest[36]);
        assert_eq!(last.status(), pb::TrackStatus::Tracking, "{}", last.reason);
        assert_eq!(last.room.as_ref().unwrap().name, room);
    }
}

/// Puts the camera where it saw row `row` of the hall.
fn put(row: usize) -> pb::TrackRequest {
    pb::TrackRequest {
        message: Some(Message::SetInitialPose(pb::SetInitialPose {
            initial_pose: initial_pose(row),
        })),
    }
}

/// Oracle: the definitions of both verbs.
#[tokio::test]
async fn a_camera_can_be_put_and_forgotten() {
    let server = server(KEY).await;

    let reset = pb::TrackRequest {
        message: Some(Message::Reset(pb::Reset {})),
    };
    let rest = vec![put(5), seen(5), reset, seen(0)];
    let requests = [followed(config(), 0..5), rest].concat();
    let found = answers(&server, requests).await.unwrap();
    assert!(matches!(found[6].answer, Some(Answer::Acknowledged(_))));

    let after = update(&found[7]);
    assert_eq!(
        after.status(),
        pb::TrackStatus::Tracking,
        "{}",
        after.reason
    );
    assert!(after.map_from_camera().is_some());

    let fresh = update(&found[9]);
    assert_eq!(fresh.keyframe.as_ref().unwrap().sequence_number, 1);
    assert!(fresh.camera.as_ref().unwrap().velocity.is_none());
    assert_eq!(found[9], found[1], "as if nothing had been");
}

/// Oracle: the recorded rooms and poses; what looks like no room is called ambiguous.
#[tokio::test]
async fn a_view_is_found_among_rooms_or_called_ambiguous() {
    let server = server(KEY).await;
    let before = server.client.rooms().await.unwrap();

    for (room, row) in [("hall", 50), ("attic", 250)] {
        let view = feature(served(room).1.rows().row(row).to_vec()).unwrap();
        let request = pb::RelocalizeRequest {
            views: vec![view],
            top_k: Some(2),
            ..Default::default()
        };
        let found = server.client.relocalize(request).await.unwrap();

        assert!(!found.ambiguous, "{found:?}");
        assert!(found.margin.is_none_or(|margin| margin > 1.1), "{found:?}");
        assert_eq!((found.room_count, found.rooms.len()), (2, 2));

        let best = &found.rooms[0];
        assert_eq!(best.room.as_ref().unwrap().name, room);
        assert_eq!(best.frames.len(), 2);
        assert_eq!(best.frames[0].frame_id, row as u32);

        let pose = best.pose.as_ref().unwrap();
        let covariance = matrix(&pose.covariance);
        let pose = convert::pose(pose.pose.as_ref().unwrap()).unwrap();
        let error = PoseError::between(&pose, &served(room).0.poses()[row]);
        assert!(error.translation_m < 1e-9, "{error:?}");
        assert!(covariance.cholesky().is_some());
    }

    let strange = feature((0..48).map(|column| (column as f32).sin() * 9.0).collect()).unwrap();
    let request = pb::RelocalizeRequest {
        views: vec![strange.clone(), strange],
        ..Default::default()
    };
    let found = server.client.relocalize(request).await.unwrap();

    assert!(found.ambiguous && !found.reason.is_empty(), "{found:?}");

    let after = server.client.rooms().await.unwrap();
    assert_eq!(after, before, "nothing changes");

    let cases: [Unfit<pb::RelocalizeRequest>; 4] = [
        (|_| (), "views"),
        (|r| r.views.push(frame(1).unwrap()), "views[0].frame_id"),
        (|r| r.views.push(pb::View::default()), "views[0]"),
        (|r| r.max_rooms = Some(0), "max_rooms"),
    ];
    for (spoil, field) in cases {
        let mut request = pb::RelocalizeRequest::default();
        spoil(&mut request);
        let error = server.client.relocalize(request).await.unwrap_err();
        assert_eq!(error.field().as_deref(), Some(field), "{error}");
    }
}

/// Oracle: searches of the same rooms by name, which compare the view with one room after the
/// other. Some rooms have equal frames.
#[tokio::test]
async fn a_search_of_all_rooms_answers_as_one_of_each() {
    let (folder, store) = store_of_places().await;
    for number in 0..40 {
        let (room, features) = place(&format!("room-{number:02}"), 20 + number / 2);
        store.publish_room(&room, &[features]).await.unwrap();
    }
    let server = start_on(folder, store, Config::default()).await;
    let rooms = server.client.rooms().await.unwrap();
    let names: Vec<String> = rooms.into_iter().map(|room| room.name).collect();
    assert_eq!(names.len(), 42);

    // The first searches are made one by one, until the index of all rooms is there.
    for round in 0..20 {
        let number = 2 * (round % 10) + 1;
        let (_, features) = place("seen", 20 + number / 2);
        let view = feature(features.rows().row(7 * round as usize).to_vec()).unwrap();

        for max_rooms in [1, 3] {
            let all = pb::RelocalizeRequest {
                views: vec![view.clone()],
                max_rooms: Some(max_rooms),
                top_k: Some(3),
                ..Default::default()
            };
            let named = pb::RelocalizeRequest {
                rooms: names.clone(),
                ..all.clone()
            };
            let one_by_one = server.client.relocalize(named).await.unwrap();
            let together = server.client.relocalize(all).await.unwrap();
            assert_eq!(
                together.encode_to_vec(),
                one_by_one.encode_to_vec(),
                "round {round}"
            );
        }

        let all = pb::LocalizeRequest {
            view: Some(view),
            top_k: Some(20),
            ..Default::default()
        };
        let named = pb::LocalizeRequest {
            rooms: names.iter().rev().cloned().collect(),
            ..all.clone()
        };
        let one_by_one = server.client.localize(named).await.unwrap();
        let together = server.client.localize(all).await.unwrap();
        assert_eq!(
            together.encode_to_vec(),
            one_by_one.encode_to_vec(),
            "round {round}"
        );
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}

/// Oracle: composition, and the stream without a base. The base's poses are the camera's, moved by
/// the mounting; odometry begins at the base; the camera's map poses and motions are what they
/// were.
#[tokio::test]
async fn a_robot_gets_the_poses_of_its_base() {
    let server = server(KEY).await;
    let mounting = Pose::new(
        nalgebra::Vector3::new(0.3, 0.1, 0.5),
        nalgebra::Vector3::new(0.2, -1.4, 0.3),
    );
    let on_base = pb::TrackConfig {
        base_from_camera: Some(convert::pose_to_wire(&mounting, "base_link", "camera")),
        ..config()
    };

    let plain = answers(&server, followed(config(), 0..40)).await.unwrap();
    let based = answers(&server, followed(on_base, 0..40)).await.unwrap();

    let pose = |given: Option<&pb::Pose>| convert::pose(given.unwrap()).unwrap();
    let near = |a: Pose, b: Pose| {
        let apart = PoseError::between(&a, &b);
        assert!(apart.translation_m < 1e-9, "{apart:?}");
        assert!(apart.rotation_rad < 1e-7, "{apart:?}");
    };

    let first = update(&based[1]);
    near(pose(first.odom_from_base()), Pose::identity());
    assert!(update(&plain[1]).base.is_none());

    let (plain, based) = (update(&plain[40]), update(&based[40]));
    assert_eq!(plain.keyframe, based.keyframe);
    let map_pose = |of: &pb::TrackUpdate| of.camera.clone().unwrap().map_pose;
    assert_eq!(map_pose(plain), map_pose(based));

    let map_from_base = pose(based.map_from_base());
    let odom_from_base = pose(based.odom_from_base());
    near(map_from_base * mounting, pose(based.map_from_camera()));
    near(
        pose(based.map_from_odom.as_ref()) * odom_from_base,
        map_from_base,
    );
    let moved = mounting * pose(plain.odom_from_camera());
    near(pose(based.odom_from_camera()), moved);
    let child_frame = &based.map_from_base().unwrap().child_frame;
    assert_eq!(child_frame, "base_link");

    // The base's covariances: a rotation about the camera moves the base by the mounting's arm.
    let [camera, base] = [&based.camera, &based.base].map(|body| body.as_ref().unwrap());
    let [camera_pose, base_pose] =
        [camera, base].map(|body| body.map_pose.as_ref().unwrap().covariance.clone());
    let arm = map_from_base.translation.vector
        - convert::pose(based.map_from_camera().unwrap())
            .unwrap()
            .translation
            .vector;
    let mut moved_by = nalgebra::Matrix6::identity();
    moved_by
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-arm.cross_matrix());
    let expected = moved_by * matrix(&camera_pose) * moved_by.transpose();
    assert!((matrix(&base_pose) - expected).amax() < 1e-9);

    // A point that is fixed to the base moves with the base's velocity and with the camera's.
    let velocity_of = |body: &pb::TrackedBody| body.velocity.clone().unwrap();
    let moved = |body| convert::twist(&velocity_of(body).twist.unwrap()).unwrap();
    let of_camera = moved(camera);
    let of_base = moved(base);
    let turn = mounting.rotation * of_camera.angular;
    assert!((turn - of_base.angular).norm() < 1e-9);
    let at_camera = of_base.linear + of_base.angular.cross(&mounting.translation.vector);
    assert!((at_camera - mounting.rotation * of_camera.linear).norm() < 1e-9);
}

/// Oracle: the rules of TrackFrame.odometry: what is wrong with it refuses the frame by its name,
/// and the next frame is answered as if it had not been sent.
#[tokio::test]
async fn odometry_that_is_none_is_refused() {
    let server = server(KEY).await;
    let with = |row: usize, odometry: pb::MeasuredOdometry| {
        let mut request = seen(row);
        if let Some(Message::Frame(frame)) = &mut request.message {
            frame.odometry = Some(odometry);
        }
        request
    };
    let good = pb::MeasuredOdometry {
        pose: Some(convert::pose_to_wire(&Pose::identity(), "wheels", "")),
        ..Default::default()
    };
    let cases: [Unfit<pb::MeasuredOdometry>; 4] = [
        (|o| o.pose = None, "odometry.pose"),
        (|o| o.pose = Some(pb::Pose::default()), "odometry.pose"),
        (
            |o| o.translation_share = Some(f64::NAN),
            "translation_share",
        ),
        (|o| o.rotation_share = Some(0.0), "rotation_share"),
    ];

    for (spoil, word) in cases {
        let mut bad = good.clone();
        spoil(&mut bad);
        let begun = vec![begin(config()), with(0, good.clone())];
        let sent = [begun.clone(), vec![with(1, bad), seen(2)]].concat();
        let heard = answers(&server, sent).await.unwrap();
        match &heard[2].answer {
            Some(Answer::Refusal(refusal)) => {
                assert_eq!(refusal.reason(), pb::TrackRefusalReason::Odometry);
                assert!(refusal.message.contains(word), "{}", refusal.message);
            }
            other => panic!("{other:?}"),
        }

        let plain = [begun, vec![seen(2)]].concat();
        let plain = answers(&server, plain).await.unwrap();
        assert_eq!(heard[3], plain[2]);
    }
}

/// A view between the mapped ones, as a frame of the stream.
fn seen_beside(row: usize) -> pb::TrackRequest {
    let features = served("hall").1;
    let values = features.rows().row(row).mapv(|x| x + 0.02).to_vec();
    message(pb::TrackFrame {
        timestamp_ns: row as i64 * 33_000_000,
        sequence_number: row as u64 + 1,
        view: feature(values),
        ..pb::TrackFrame::default()
    })
}

/// What a server of this store answers to a stream, and the folder of the store. The server ends.
async fn answered_by_a_new_server(
    folder: tempfile::TempDir,
    store: &Store,
) -> (Vec<pb::TrackUpdate>, tempfile::TempDir) {
    let server = start_on(folder, store.clone(), Config::default()).await;
    let requests = std::iter::once(begin(config())).chain((0..20).map(seen_beside));
    let answers = answers(&server, requests.collect()).await.unwrap();

    // The first answer has no update. The tokens of two servers differ.
    let updates = answers[1..].iter().map(|answer| update(answer).clone());
    server.stop.send(()).unwrap();
    server.ended.await.unwrap().unwrap();
    (updates.collect(), server.folder)
}

/// Oracle: the contract: a server that finds what another has derived answers as that one did, and a
/// damaged file costs only time. That the file is used shows when it holds another typical distance:
/// novelties are divided by it.
#[tokio::test]
async fn what_is_derived_from_a_room_is_kept_in_the_store() {
    let first = start_followed(Config::default()).await;
    first.stop.send(()).unwrap();
    first.ended.await.unwrap().unwrap();
    let folder = first.folder;
    let derived = folder.path().join("derived");
    let files = || std::fs::read_dir(&derived).unwrap();
    assert_eq!(files().count(), 2, "one for each room");

    let store = Store::open(folder.path().to_str().unwrap()).unwrap();
    let adapter = store.load_adapter("followed", None).await.unwrap();
    let key = store.derived_key("hall", 1, &adapter).await.unwrap();
    let key = key.expect("the hall has the features");
    let kept = store.load_derived(&key).await;
    let kept = kept.expect("the first server kept it");

    std::fs::remove_dir_all(&derived).unwrap();
    let (computed, folder) = answered_by_a_new_server(folder, &store).await;
    assert_eq!(store.load_derived(&key).await.as_ref(), Some(&kept));
    let (found, folder) = answered_by_a_new_server(folder, &store).await;
    assert_eq!(found, computed);

    let mut other = kept.clone();
    other.map.as_mut().unwrap().typical_distance *= 2.0;
    store.keep_derived(&key, &other).await.unwrap();
    let (found, folder) = answered_by_a_new_server(folder, &store).await;
    let novelty = |updates: &[pb::TrackUpdate]| updates[5].r#match.as_ref().unwrap().novelty;
    let (halved, whole) = (novelty(&found).unwrap(), novelty(&computed).unwrap());
    assert!(
        whole > 1e-3 && (2.0 * halved - whole).abs() < 1e-9,
        "{halved} {whole}"
    );

    for file in files() {
        std::fs::write(file.unwrap().path(), "damaged").unwrap();
    }
    let (found, _folder) = answered_by_a_new_server(folder, &store).await;
    assert_eq!(found, computed);
    assert_eq!(store.load_derived(&key).await, Some(kept), "derived anew");
}

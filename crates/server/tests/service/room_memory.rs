//! Rooms are loaded when they are asked for and dropped when memory is short; answers stay the
//! same.

use std::sync::Arc;

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_server::{Config, Reload, RoomMemory};
use tokio::sync::Notify;
use tonic::Code;

use crate::harness::{
    TestServer, feature, feature_row, filled_store, frame, question, start_on, until,
};
use crate::tracking::{begin, config as in_hall, seen, start_followed};

/// A server with rooms in memory as said, which looks for changes when it is asked to.
async fn start_with(rooms: RoomMemory) -> (TestServer, Config) {
    let (folder, store) = filled_store().await;
    let config = Config {
        rooms,
        reload: Reload {
            every: None,
            requested: Arc::new(Notify::new()),
        },
        ..Config::default()
    };

    let server = start_on(folder, store, config.clone()).await;
    (server, config)
}

fn in_room(room: &str) -> pb::NavigateRequest {
    pb::NavigateRequest {
        room: room.to_owned(),
        source: frame(10),
        motion: crate::harness::to_frame(50),
        ..question()
    }
}

fn metric(config: &Config, name: &str) -> f64 {
    crate::harness::metric(&config.metrics, name).expect(name)
}

/// What is answered to a navigation in each room and to a view that may be in any.
async fn answers(client: &Client) -> (Vec<pb::NavigateResponse>, pb::LocalizeResponse) {
    let mut navigated = Vec::new();
    for room in ["synthetic", "synthetic_b", "synthetic"] {
        navigated.push(client.navigate(in_room(room)).await.unwrap());
    }

    let anywhere = pb::LocalizeRequest {
        view: feature(feature_row(30)),
        top_k: Some(5),
        ..pb::LocalizeRequest::default()
    };
    (navigated, client.localize(anywhere).await.unwrap())
}

/// Oracle: the server that has every room in memory from the beginning.
#[tokio::test]
async fn answers_do_not_depend_on_what_is_in_memory() {
    let (all, all_config) = start_with(RoomMemory::default()).await;
    let expected = answers(&all.client).await;
    assert_eq!(metric(&all_config, "seese3_rooms_in_memory"), 2.0);

    // A room of the oracle holds more than half of what both do, or a little less.
    let both = metric(&all_config, "seese3_rooms_in_memory_bytes");
    assert!(both > 0.0);
    let one = Some((0.7 * both) as usize);

    for (preload, bytes, most) in [
        (false, None, 2.0),
        (true, one, 1.0),
        (false, one, 1.0),
        // Less than any room: each is loaded for every request.
        (false, Some(1), 0.0),
    ] {
        let (server, config) = start_with(RoomMemory { preload, bytes }).await;
        let before = metric(&config, "seese3_rooms_in_memory");
        assert_eq!(before > 0.0, preload, "{preload} {bytes:?}");

        assert_eq!(answers(&server.client).await, expected);

        let after = metric(&config, "seese3_rooms_in_memory");
        assert_eq!(after, most, "{preload} {bytes:?}");
    }
}

/// Oracle: the promise: a damaged room is refused by itself, if only when it is first asked for,
/// and a repaired one is served after SIGHUP.
#[tokio::test]
async fn damage_is_noticed_when_a_room_is_first_asked_for() {
    let lazy = RoomMemory {
        preload: false,
        bytes: None,
    };
    let (folder, store) = filled_store().await;
    let objects = folder.path().join("rooms/synthetic_b/objects");
    let frames = std::fs::read_dir(objects).unwrap();
    let frames = frames
        .map(|entry| entry.unwrap().path())
        .find(|path| path.to_string_lossy().contains("frames"))
        .unwrap();
    let intact = std::fs::read(&frames).unwrap();
    std::fs::write(&frames, &intact[..intact.len() / 2]).unwrap();

    let asked = Arc::new(Notify::new());
    let config = Config {
        rooms: lazy,
        reload: Reload {
            every: None,
            requested: asked.clone(),
        },
        ..Config::default()
    };
    let server = start_on(folder, store, config.clone()).await;
    let client = &server.client;
    assert!(client.serves("rooms/synthetic_b").await.unwrap());

    // Asked by several at once, and again: always refused, and nothing else is.
    let ask = async || match client.navigate(in_room("synthetic_b")).await {
        Err(seese3_client::Error::Refused(status)) => status.code(),
        other => panic!("{other:?}"),
    };
    let codes = tokio::join!(ask(), ask(), ask());
    assert_eq!(codes, (Code::FailedPrecondition, codes.0, codes.0));
    assert_eq!(ask().await, Code::FailedPrecondition);
    assert!(client.navigate(in_room("synthetic")).await.is_ok());
    assert!(!client.serves("rooms/synthetic_b").await.unwrap());

    // Where all rooms are searched, it is left out.
    let anywhere = pb::LocalizeRequest {
        view: feature(feature_row(30)),
        ..pb::LocalizeRequest::default()
    };
    let answer = client.localize(anywhere).await.unwrap();
    assert_eq!(answer.room_count, 1);

    std::fs::write(&frames, &intact).unwrap();
    asked.notify_one();
    let served = async || client.navigate(in_room("synthetic_b")).await.is_ok();
    until("the repaired room", served, |served| *served).await;
    assert!(client.serves("rooms/synthetic_b").await.unwrap());
}

/// Oracle: the promise: a store that is away for a while costs the rooms that are not in memory, as
/// long as it is away.
#[tokio::test]
async fn a_store_that_is_away_costs_what_is_not_in_memory() {
    let none = RoomMemory {
        preload: false,
        bytes: Some(1),
    };
    let (server, _) = start_with(none).await;
    let client = &server.client;
    let before = client.navigate(in_room("synthetic")).await.unwrap();

    let rooms = server.folder.path().join("rooms");
    let away = server.folder.path().join("away");
    std::fs::rename(&rooms, &away).unwrap();
    match client.navigate(in_room("synthetic")).await {
        Err(seese3_client::Error::Refused(status)) => {
            assert_eq!(status.code(), Code::FailedPrecondition);
        }
        other => panic!("{other:?}"),
    }

    std::fs::rename(&away, &rooms).unwrap();
    let after = client.navigate(in_room("synthetic")).await.unwrap();
    assert_eq!(after, before);
}

/// Oracle: the promise: a stream that is open holds the room that it is in, and none that was
/// removed since it began.
#[tokio::test]
async fn a_stream_holds_its_own_room_alone() {
    let config = Config {
        reload: Reload {
            every: None,
            requested: Arc::new(Notify::new()),
        },
        ..Config::default()
    };
    let asked = config.reload.requested.clone();
    let server = start_followed(config.clone()).await;
    assert_eq!(metric(&config, "seese3_rooms_in_memory"), 2.0);

    let (sender, requests) = tokio::sync::mpsc::channel(4);
    sender.send(begin(in_hall())).await.unwrap();
    let requests = tokio_stream::wrappers::ReceiverStream::new(requests);
    let mut stream = server.client.track(requests).await.unwrap();
    stream.message().await.unwrap().unwrap();

    std::fs::remove_dir_all(server.folder.path().join("rooms/attic")).unwrap();
    asked.notify_one();
    let in_memory = async || metric(&config, "seese3_rooms_in_memory");
    until("the removed room is dropped", in_memory, |rooms| {
        *rooms <= 1.0
    })
    .await;

    sender.send(seen(0)).await.unwrap();
    assert!(stream.message().await.unwrap().is_some());
}

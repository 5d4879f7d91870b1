//! Health, reflection, deadlines, request ids, draining.

use std::time::Duration;

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::evaluation_service_client::EvaluationServiceClient;
use seese3_client::proto::v1::navigation_service_client::NavigationServiceClient;
use seese3_server::{Config, Metrics, RunError, run};
use seese3_store::Store;
use tokio::net::TcpListener;
use tokio_stream::StreamExt;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::harness::{
    PATIENCE, StoppedClock, filled_store, metric, question, soon, start, start_on, until,
};

async fn channel(address: &str) -> Channel {
    Endpoint::from_shared(format!("http://{address}"))
        .unwrap()
        .connect()
        .await
        .unwrap()
}

fn named(service: &str) -> HealthCheckRequest {
    HealthCheckRequest {
        service: service.to_owned(),
    }
}

async fn check(address: &str, service: &str) -> Result<ServingStatus, Code> {
    let answer = HealthClient::new(channel(address).await)
        .check(named(service))
        .await;
    answer
        .map(|answer| answer.into_inner().status())
        .map_err(|status| status.code())
}

/// Oracle: the health protocol's specification: Check of an unknown name is NOT_FOUND, Watch of one
/// says SERVICE_UNKNOWN and stays open.
#[tokio::test]
async fn health_answers_for_the_server_its_services_and_its_rooms() {
    // The server does not end because its drain time is over.
    let config = Config {
        drain: 10 * PATIENCE,
        ..Config::default()
    };
    let server = start(config).await;
    for name in [
        "",
        "seese3.v1.NavigationService",
        "seese3.v1.EvaluationService",
        "rooms/synthetic",
    ] {
        assert_eq!(
            check(&server.address, name).await,
            Ok(ServingStatus::Serving),
            "{name}"
        );
    }

    for name in ["nope", "rooms/nope"] {
        assert_eq!(
            check(&server.address, name).await,
            Err(Code::NotFound),
            "{name}"
        );
    }

    let mut client = HealthClient::new(channel(&server.address).await);
    let mut unknown = client
        .watch(named("rooms/nope"))
        .await
        .unwrap()
        .into_inner();

    assert_eq!(
        unknown.message().await.unwrap().unwrap().status(),
        ServingStatus::ServiceUnknown
    );

    // Nothing is to come: a slow machine cannot fail this.
    let still_open = tokio::time::timeout(Duration::from_millis(100), unknown.message()).await;
    assert!(still_open.is_err(), "the stream waits");

    let mut watched = client.watch(named("")).await.unwrap().into_inner();
    assert_eq!(
        watched.message().await.unwrap().unwrap().status(),
        ServingStatus::Serving
    );

    server.stop.send(()).unwrap();

    assert_eq!(
        watched.message().await.unwrap().unwrap().status(),
        ServingStatus::NotServing
    );

    let what = "watchers do not keep a server that was told to stop";
    soon(what, server.ended).await.unwrap().unwrap();
}

/// Oracle: the bounds by hand. A request holds 16 KiB at least, so that an eighth of 2 MB has room
/// for 15 watchers, and half of it for the seven of one connection. Those who check, and requests,
/// are answered beside them.
#[tokio::test]
async fn watchers_leave_room_for_those_who_check() {
    let config = Config {
        memory_bytes: 2_000_000,
        ..Config::default()
    };
    let server = start(config).await;

    let mut clients = Vec::new();
    let mut watchers = Vec::new();
    for connection in 0..10 {
        let mut client = HealthClient::new(channel(&server.address).await);
        for _ in 0..20 {
            match client.watch(named("")).await {
                Ok(watcher) => watchers.push(watcher),
                Err(status) => assert_eq!(status.code(), Code::ResourceExhausted),
            }
        }

        if connection == 0 {
            assert_eq!(watchers.len(), 7);
        }
        clients.push(client);
    }
    assert!((12..=15).contains(&watchers.len()), "{}", watchers.len());

    for _ in 0..100 {
        let checked = check(&server.address, "").await;
        assert_eq!(checked, Ok(ServingStatus::Serving));
        server.client.navigate(question()).await.unwrap();
    }
}

/// Oracle: the promise of the deployment's page: a store of which nothing can be served ends the
/// server, and the error names the file.
#[tokio::test]
async fn a_store_without_any_sound_room_never_serves() {
    let (folder, store) = filled_store().await;
    for room in ["synthetic", "synthetic_b"] {
        let objects = folder.path().join("rooms").join(room).join("objects");
        for object in std::fs::read_dir(objects).unwrap() {
            std::fs::write(object.unwrap().path(), b"short").unwrap();
        }
    }

    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let ended = run(listener, store, Config::default(), std::future::pending()).await;
    let error = ended.unwrap_err().to_string();

    assert!(error.contains("rooms/synthetic/objects/frames-"), "{error}");

    let empty = tempfile::tempdir().unwrap();
    let store = Store::open(empty.path().to_str().unwrap()).unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let ended = run(listener, store, Config::default(), std::future::pending()).await;

    assert!(matches!(ended, Err(RunError::NoRoom { .. })));
}

/// Oracle: the reflection protocols' own messages, both versions, list every service.
#[tokio::test]
async fn reflection_lists_the_services_in_both_versions() {
    let server = start(Config::default()).await;
    let channel = channel(&server.address).await;

    let services = [
        "Navigation",
        "Localization",
        "Odometry",
        "Catalog",
        "Evaluation",
    ];

    macro_rules! listed {
        ($version:ident) => {{
            use tonic_reflection::pb::$version::ServerReflectionRequest;
            use tonic_reflection::pb::$version::server_reflection_client::ServerReflectionClient;
            use tonic_reflection::pb::$version::server_reflection_request::MessageRequest;
            use tonic_reflection::pb::$version::server_reflection_response::MessageResponse;
            let request = ServerReflectionRequest {
                host: String::new(),
                message_request: Some(MessageRequest::ListServices(String::new())),
            };
            let stream = tokio_stream::iter([request]);
            let mut answers = ServerReflectionClient::new(channel.clone())
                .server_reflection_info(stream)
                .await
                .unwrap()
                .into_inner();
            match answers
                .next()
                .await
                .unwrap()
                .unwrap()
                .message_response
                .unwrap()
            {
                MessageResponse::ListServicesResponse(list) => list
                    .service
                    .into_iter()
                    .map(|service| service.name)
                    .collect::<Vec<_>>(),
                other => panic!("{other:?}"),
            }
        }};
    }

    for names in [listed!(v1), listed!(v1alpha)] {
        for service in services {
            assert!(
                names.contains(&format!("seese3.v1.{service}Service")),
                "{names:?}"
            );
        }

        assert!(
            names.contains(&"grpc.health.v1.Health".to_owned()),
            "{names:?}"
        );
    }
}

/// Oracle: the definition of a deadline. The work would take minutes; the answer is
/// DEADLINE_EXCEEDED, and the only thread is free again at once.
#[tokio::test]
async fn a_deadline_ends_the_work() {
    let limits = seese3_core::navigation::Limits {
        steps: 4_000_000_000,
        top_k: 1_000,
        frames_in_answer: u64::MAX,
    };

    let server = start(Config {
        threads: 1,
        queue: 4,
        limits,
        memory_bytes: usize::MAX / 4,
        ..Config::default()
    })
    .await;

    let mut service = NavigationServiceClient::new(channel(&server.address).await);

    let endless = pb::NavigateRequest {
        steps: Some(400_000_000),
        ..question()
    };
    let mut request = Request::new(endless);
    request
        .metadata_mut()
        .insert("grpc-timeout", "200m".parse().unwrap());

    let status = soon("the deadline ends it", service.navigate(request)).await;
    assert_eq!(status.unwrap_err().code(), Code::DeadlineExceeded);

    let next = server.client.navigate(question());
    soon("the thread was given back", next).await.unwrap();
}

/// Oracle: as above, for a stream whose caller goes away.
#[tokio::test]
async fn a_caller_that_leaves_an_evaluation_frees_its_thread() {
    let server = start(Config {
        threads: 1,
        queue: 4,
        ..Config::default()
    })
    .await;
    let mut service = EvaluationServiceClient::new(channel(&server.address).await);

    let request = pb::EvaluateRequest {
        room: "synthetic".to_owned(),
        stride: Some(1),
        ..pb::EvaluateRequest::default()
    };

    // Neither a caller that leaves nor one that never reads keeps the only thread.
    let mut unread = Vec::new();
    for _ in 0..3 {
        let mut left = service
            .evaluate(request.clone())
            .await
            .unwrap()
            .into_inner();

        assert!(left.message().await.unwrap().is_some());

        drop(left);
        unread.push(service.evaluate(request.clone()).await.unwrap());
    }

    let next = server.client.navigate(question());
    soon("the thread was given back", next).await.unwrap();
}

/// Oracle: the promise itself: the caller's id comes back, and one is made for a caller without.
#[tokio::test]
async fn every_answer_carries_a_request_id() {
    let server = start(Config::default()).await;
    let mut service = NavigationServiceClient::new(channel(&server.address).await);
    let mut request = Request::new(question());
    request
        .metadata_mut()
        .insert("x-request-id", "robot-7".parse().unwrap());

    assert_eq!(
        service
            .navigate(request)
            .await
            .unwrap()
            .metadata()
            .get("x-request-id")
            .unwrap(),
        "robot-7"
    );

    let made = service.navigate(question()).await.unwrap();
    assert_eq!(made.metadata().get("x-request-id").unwrap().len(), 16);
}

/// Oracle: the promise itself: what is in flight when the server is told to stop is answered, and
/// the server ends; when it does not end in time, the bound does.
#[tokio::test]
async fn stopping_answers_what_is_in_flight_within_a_bound() {
    let limits = seese3_core::navigation::Limits {
        steps: 4_000_000_000,
        top_k: 1_000,
        frames_in_answer: u64::MAX,
    };

    let metrics = Metrics::default();
    let in_flight_now = async || metric(&metrics, "seese3_requests_in_flight");
    let server = start(Config {
        limits,
        memory_bytes: usize::MAX / 4,
        drain: 10 * PATIENCE,
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;
    let client = server.client.clone();

    let slow = pb::NavigateRequest {
        steps: Some(30_000),
        ..question()
    };
    let in_flight = tokio::spawn(async move { client.navigate(slow).await });

    until("it is in flight", in_flight_now, |count| {
        *count == Some(1.0)
    })
    .await;
    server.stop.send(()).unwrap();
    assert_eq!(in_flight.await.unwrap().unwrap().steps.len(), 30_000);

    server.ended.await.unwrap().unwrap();

    let stuck = start(Config {
        limits,
        memory_bytes: usize::MAX / 4,
        drain: Duration::from_millis(200),
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;
    let deadline = 10 * PATIENCE;
    let client = Client::connect(&stuck.address, deadline).await.unwrap();

    let endless = pb::NavigateRequest {
        steps: Some(400_000_000),
        ..question()
    };
    let in_flight = tokio::spawn(async move { client.navigate(endless).await });

    until("it is in flight", in_flight_now, |count| {
        *count == Some(1.0)
    })
    .await;
    stuck.stop.send(()).unwrap();
    soon("the bound holds", stuck.ended).await.unwrap().unwrap();

    let error = in_flight.await.unwrap().unwrap_err();
    assert_eq!(
        error.code(),
        Some(Code::Unavailable),
        "the caller is told: {error}"
    );

    assert!(
        Client::connect(&stuck.address, Duration::from_secs(1))
            .await
            .is_err(),
        "nobody listens any more"
    );

    drop((server.folder, stuck.folder));
}

/// Oracle: the meaning of the setting: health says NOT_SERVING, requests are still answered, and
/// then the server ends.
#[tokio::test]
async fn a_lame_duck_still_answers() {
    let clock = StoppedClock::new();
    let server = start(Config {
        lame_duck: Duration::from_secs(2),
        ..Config::default()
    })
    .await;
    assert!(server.client.serves("").await.unwrap());

    server.stop.send(()).unwrap();
    let serves = async || server.client.serves("").await.unwrap();
    until("health says so", serves, |serves| !*serves).await;

    // A connection that begins later is a client that a load balancer still sends here.
    clock.advance(Duration::from_millis(1_900)).await;
    let late = Client::connect(&server.address, PATIENCE).await.unwrap();
    assert!(late.navigate(question()).await.is_ok());
    clock.advance(Duration::from_millis(200)).await;
    soon("the server ends", server.ended)
        .await
        .unwrap()
        .unwrap();
}

/// Oracle: the meaning of the flag: a store without a room is of use where rooms can be added.
#[tokio::test]
async fn an_empty_store_is_served_where_it_can_be_filled() {
    let store = async || {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::create(folder.path().to_str().unwrap()).unwrap();
        (folder, store)
    };

    let (folder, empty) = store().await;
    let server = start_on(
        folder,
        empty,
        Config {
            writable: true,
            ..Config::default()
        },
    )
    .await;
    assert!(server.client.rooms().await.unwrap().is_empty());
    assert!(server.client.serves("").await.unwrap());

    let (_folder, empty) = store().await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let ended = run(listener, empty, Config::default(), std::future::pending()).await;
    assert!(matches!(ended, Err(RunError::NoRoom { .. })));
}

//! What requests may hold in memory: bodies that never arrive, messages that grow when they are
//! decoded, answers that are too large.

use std::time::Duration;

use pb::track_response::Answer;
use prost::Message;
use seese3_client::proto::v1 as pb;
use seese3_server::{Config, Metrics};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

use crate::harness::{StoppedClock, feature, metric, question, soon, start, until};
use crate::http2::{NAVIGATE, frame, headers, opened, prefixed, silent_calls};
use crate::isolation;
use crate::security::{client_with, principal};

/// Waits until as many bytes are held as wanted, as the metrics say.
async fn until_held(metrics: &Metrics, is_wanted: impl Fn(u64) -> bool) {
    let held = async || metric(metrics, "seese3_memory_held_bytes").unwrap() as u64;
    until("other memory is held", held, |held| is_wanted(*held)).await;
}

/// Oracle: the bound and the time limit themselves.
#[tokio::test]
async fn bodies_that_never_arrive_hold_little_and_not_for_long() {
    let clock = StoppedClock::new();
    let metrics = Metrics::default();
    let server = start(Config {
        memory_bytes: 2 << 20,
        receive_within: Duration::from_secs(2),
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;
    until_held(&metrics, |held| held == 0).await;

    // A call counts for 16 KiB and what it has sent.
    let ten = silent_calls(&server.address, 10, &[0; 1_000]).await;
    let expected = 10 * ((16 << 10) + 1_000);
    until_held(&metrics, |held| held == expected).await;

    // As many as the share of a connection: others are answered.
    let many = silent_calls(&server.address, 200, &[]).await;
    let share = ((2 << 20) - expected) / 2;
    until_held(&metrics, |held| held > expected + share - (17 << 10)).await;
    assert!(server.client.navigate(question()).await.is_ok());

    clock.advance(Duration::from_secs(2)).await;
    until_held(&metrics, |held| held == 0).await;
    assert!(server.client.navigate(question()).await.is_ok());

    drop((ten, many));
    until_held(&metrics, |held| held == 0).await;
}

/// Oracle: by hand: two bytes for each request of a batch are hundreds when it is decoded.
#[tokio::test]
async fn a_message_that_grows_when_it_is_decoded_is_refused_before() {
    let metrics = Metrics::default();
    let server = start(Config {
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;

    let empty = vec![pb::NavigateRequest::default(); 2_000_000];
    let refused = server.client.batch_navigate(empty).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::InvalidArgument), "{refused}");
    assert_eq!(refused.field().as_deref(), Some("request"));

    // A batch of the largest size is small beside that.
    let batch = vec![question(); 256];
    let answers = server.client.batch_navigate(batch).await.unwrap();
    assert_eq!(answers.len(), 256);
    until_held(&metrics, |held| held == 0).await;
}

/// Oracle: the bound itself.
#[tokio::test]
async fn an_answer_that_finds_no_memory_is_refused() {
    let server = start(Config {
        memory_bytes: 300_000,
        ..Config::default()
    })
    .await;
    assert!(server.client.navigate(question()).await.is_ok());

    let large = pb::NavigateRequest {
        steps: Some(100),
        top_k: Some(100),
        ..question()
    };
    let refused = server.client.navigate(large).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::ResourceExhausted));
    assert!(server.client.navigate(question()).await.is_ok());
}

/// Oracle: the time limit itself. The caller's window is closed, or has room for one byte, and it
/// reads or does not read what else the server sends.
#[tokio::test]
async fn a_response_that_is_not_received_is_not_kept() {
    let clock = StoppedClock::new();
    let metrics = Metrics::default();
    let server = start(Config {
        response_timeout: Duration::from_secs(2),
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;
    let large = pb::NavigateRequest {
        steps: Some(100),
        top_k: Some(100),
        ..question()
    };

    for window in [0, 1] {
        // SETTINGS_INITIAL_WINDOW_SIZE.
        let mut stream = opened(&server.address, &[0, 4, 0, 0, 0, window]).await;
        let call = [
            frame(1, 4, 1, &headers(NAVIGATE)),
            frame(0, 1, 1, &prefixed(&large.encode_to_vec())),
        ];
        stream.write_all(&call.concat()).await.unwrap();

        // The response has far more than one piece; what was taken over goes with the connection.
        // Its memory is held from before it is computed, its time limit begins after that.
        until_held(&metrics, |held| held > 200_000).await;
        let held = async || {
            clock.advance(Duration::from_secs(2)).await;
            metric(&metrics, "seese3_memory_held_bytes").unwrap()
        };
        until("the response is given up", held, |held| *held == 0.0).await;
        let mut rest = Vec::new();
        let _ = soon("the connection is closed", stream.read_to_end(&mut rest)).await;
    }

    // A response that is received costs nobody the connection.
    for _ in 0..5 {
        assert!(server.client.navigate(large.clone()).await.is_ok());
        clock.advance(Duration::from_millis(500)).await;
    }
}

/// Oracle: gRPC: a request of one message has one message. What is behind it is not decoded.
#[tokio::test]
async fn a_second_message_is_not_decoded() {
    let metrics = Metrics::default();
    let server = start(Config {
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;

    let two = [prefixed(&[]), prefixed(&[0; 50_000])].concat();
    let mut stream = silent_calls(&server.address, 1, &[]).await;
    for part in two.chunks(10_000) {
        stream.write_all(&frame(0, 0, 1, part)).await.unwrap();
    }
    until_held(&metrics, |held| held > 50_000).await;
    stream.write_all(&frame(0, 1, 1, &[])).await.unwrap();

    // It is refused, and nothing of it is held any more.
    until_held(&metrics, |held| held == 0).await;
    let refused = r#"method="/seese3.v1.NavigationService/Navigate",code="INVALID_ARGUMENT"} 1"#;
    assert!(metrics.text().contains(refused), "{}", metrics.text());
}

/// Oracle: the contract: a message of a stream is counted while it is worked on, not until the
/// stream ends. A refused frame of 1 MB leaves what an idle stream holds.
#[tokio::test]
async fn an_idle_stream_holds_nothing_of_its_messages() {
    let metrics = Metrics::default();
    let config = Config {
        metrics: metrics.clone(),
        ..Config::default()
    };
    let robot = principal("robot", "\"track\"", "\"*\"");
    let server = isolation::server(config, &robot).await;
    let client = client_with(&server, Some("robot")).await;

    let (requests, open) = tokio::sync::mpsc::channel(4);
    let config = pb::TrackConfig {
        room: "lab".to_owned(),
        ..pb::TrackConfig::default()
    };
    let large = pb::TrackFrame {
        sequence_number: 1,
        timestamp_ns: 1,
        view: feature(vec![0.0; 250_000]),
        ..pb::TrackFrame::default()
    };
    for message in [
        pb::track_request::Message::Config(config),
        pb::track_request::Message::Frame(large),
    ] {
        let message = Some(message);
        requests.send(pb::TrackRequest { message }).await.unwrap();
    }
    let mut answers = client.track(ReceiverStream::new(open)).await.unwrap();
    let started = answers.message().await.unwrap().unwrap();
    assert!(matches!(started.answer, Some(Answer::Started(_))));
    let refused = answers.message().await.unwrap().unwrap();
    assert!(
        matches!(refused.answer, Some(Answer::Refusal(_))),
        "of another length"
    );

    until_held(&metrics, |held| held <= 64 << 10).await;
    assert!(!requests.is_closed(), "the stream is open");
}

/// Oracle: the bounds by hand: eight health calls of a connection, each of one second. Other
/// connections are answered, and a path that is no RPC holds nothing.
#[tokio::test]
async fn health_calls_without_a_body_hold_up_nobody() {
    let clock = StoppedClock::new();
    let metrics = Metrics::default();
    let server = start(Config {
        memory_bytes: 2 << 20,
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;

    for path in [
        "/grpc.health.v1.Health/Check",
        "/grpc.health.v1.Health/Nope",
    ] {
        let mut silent = Vec::new();
        for _ in 0..8 {
            let mut stream = opened(&server.address, &[]).await;
            for call in 0..200 {
                let call = frame(1, 4, 2 * call + 1, &headers(path));
                stream.write_all(&call).await.unwrap();
            }
            silent.push(stream);
        }

        for _ in 0..20 {
            assert!(server.client.serves("").await.unwrap());
            assert!(server.client.navigate(question()).await.is_ok());
        }
        let held = metric(&metrics, "seese3_memory_held_bytes").unwrap();
        assert!(held < f64::from(64 << 10), "{path}: {held}");

        // Each connection had eight calls, and now they have ended.
        if path.ends_with("Check") {
            let counted = |code: &str| {
                let name =
                    format!(r#"seese3_request_seconds_count{{method="{path}",code="{code}"}}"#);
                metric(&metrics, &name).unwrap_or(0.0)
            };
            let full = async || counted("RESOURCE_EXHAUSTED");
            until("192 of 200 are refused", full, |count| {
                *count == 8.0 * 192.0
            })
            .await;
            clock.advance(Duration::from_secs(1)).await;
            let late = async || counted("DEADLINE_EXCEEDED");
            until("the others are late", late, |count| *count == 8.0 * 8.0).await;
        }
        drop(silent);
    }
}

/// Oracle: the bound of 1 KiB itself.
#[tokio::test]
async fn a_large_health_check_is_refused() {
    let server = start(Config::default()).await;
    let check = async |bytes: usize| {
        let answer = server.client.serves(&"x".repeat(bytes)).await;
        answer.unwrap_err().code()
    };
    assert_eq!(check(1_000).await, Some(Code::NotFound));
    assert_eq!(check(1_100).await, Some(Code::OutOfRange));
}

/// Oracle: by hand: two bytes for each name of a room are a string when they are decoded.
#[tokio::test]
async fn a_message_of_a_stream_that_grows_is_refused_too() {
    let server = start(Config {
        memory_bytes: 32 << 20,
        ..Config::default()
    })
    .await;

    let config = pb::TrackConfig {
        rooms: vec![String::new(); 2_000_000],
        ..pb::TrackConfig::default()
    };
    let request = pb::TrackRequest {
        message: Some(pb::track_request::Message::Config(config)),
    };
    let opened = server.client.track(tokio_stream::iter([request])).await;
    let refused = match opened {
        Err(error) => error.code().unwrap(),
        Ok(mut answers) => answers.message().await.unwrap_err().code(),
    };
    assert_eq!(refused, Code::InvalidArgument);
}

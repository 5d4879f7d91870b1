//! Connections that break the rules of HTTP/2 and gRPC, and very many streams that say nothing. The
//! others go on being answered.

use std::time::Duration;

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use seese3_client::proto::v1::track_response::Answer;
use seese3_client::{Client, ConnectOptions};
use seese3_server::{Config, Metrics};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::harness::{TestServer, metric, question, soon, start, until};
use crate::http2::{NAVIGATE, frame, headers, literal, opened, prefixed};
use crate::tracking::{begin, config, seen, start_followed};

/// Sends bytes and reads until the server closes the connection, or for a while. The server may
/// keep it open, so no test depends on what happens in that time.
async fn sent(mut stream: TcpStream, bytes: &[u8]) {
    // A server that has had enough closes while this still writes.
    let _ = stream.write_all(bytes).await;
    let mut answer = Vec::new();
    let read = stream.read_to_end(&mut answer);
    let _ = tokio::time::timeout(Duration::from_millis(300), read).await;
}

async fn answers_others(server: &TestServer, after: &str) {
    let answer = soon(after, server.client.navigate(question())).await;
    assert!(answer.is_ok(), "after {after}");
}

/// Oracle: RFC 9113: each is an error of the connection or of a stream, and of no other connection.
#[tokio::test]
async fn frames_against_the_rules_harm_nobody_else() {
    let server = start(Config::default()).await;
    let begun = frame(1, 4, 1, &headers(NAVIGATE));
    let cases: Vec<(&str, Vec<u8>)> = vec![
        ("a frame longer than allowed", frame(0, 0, 1, &[0; 20_000])),
        (
            "data of a stream that was never opened",
            frame(0, 0, 9, b"x"),
        ),
        ("headers on stream 0", frame(1, 4, 0, &headers(NAVIGATE))),
        ("headers that are no HPACK", frame(1, 4, 1, &[0xff; 40])),
        ("an even stream", frame(1, 4, 2, &headers(NAVIGATE))),
        ("settings of an odd length", frame(4, 0, 0, &[0; 5])),
        ("an increment of 0", frame(8, 0, 0, &[0; 4])),
        (
            "increments beyond the largest window",
            [
                frame(8, 0, 0, &[0x7f, 0xff, 0xff, 0xff]),
                frame(8, 0, 0, &[0x7f, 0xff, 0xff, 0xff]),
            ]
            .concat(),
        ),
        ("a ping of the wrong length", frame(6, 0, 0, &[0; 3])),
        ("a push by a client", frame(5, 4, 1, &[0, 0, 0, 2])),
        (
            "a frame of an unknown type",
            frame(0xee, 0xff, 3, &[1; 100]),
        ),
        (
            "a stream that depends on itself",
            [begun.clone(), frame(2, 0, 1, &[0, 0, 0, 1, 0])].concat(),
        ),
        (
            "headers that never end",
            [
                frame(1, 0, 1, &headers(NAVIGATE)),
                frame(9, 0, 1, &[0x40; 16_000]).repeat(40),
            ]
            .concat(),
        ),
        (
            "pings without an end",
            frame(6, 0, 0, &[7; 8]).repeat(20_000),
        ),
        (
            "settings without an end",
            frame(4, 0, 0, &[0, 3, 0, 0, 0, 9]).repeat(20_000),
        ),
        (
            "empty data without an end",
            [begun.clone(), frame(0, 0, 1, &[]).repeat(20_000)].concat(),
        ),
        ("HTTP/1.1", b"GET / HTTP/1.1\r\nhost: a\r\n\r\n".to_vec()),
    ];

    for (what, bytes) in cases {
        sent(opened(&server.address, &[]).await, &bytes).await;
        answers_others(&server, what).await;
    }

    // Bytes by chance, behind a preface and without one.
    let mut random = ChaCha8Rng::seed_from_u64(11);
    for _ in 0..20 {
        let mut bytes = vec![0; random.random_range(1..3_000)];
        random.fill_bytes(&mut bytes);
        sent(opened(&server.address, &[]).await, &bytes).await;
        sent(TcpStream::connect(&server.address).await.unwrap(), &bytes).await;
    }
    answers_others(&server, "bytes by chance").await;
}

/// Oracle: the attack's own definition (CVE-2023-44487): calls that are cancelled as soon as they
/// are made cost the attacker nothing. The server gives the connection up.
#[tokio::test]
async fn calls_that_are_cancelled_at_once_end_their_connection() {
    let metrics = Metrics::default();
    let server = start(Config {
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;

    let calls: Vec<u8> = (0..20_000_u32)
        .flat_map(|call| {
            let id = 2 * call + 1;
            let body = frame(0, 1, id, &prefixed(&[]));
            [
                frame(1, 4, id, &headers(NAVIGATE)),
                body,
                frame(3, 0, id, &[0, 0, 0, 8]),
            ]
            .concat()
        })
        .collect();
    let mut stream = opened(&server.address, &[]).await;
    let flood = async {
        let _ = stream.write_all(&calls).await;
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer).await;
        answer
    };

    // GOAWAY (type 7) with ENHANCE_YOUR_CALM (11) is the last that the connection hears.
    let answer = soon("the connection is given up", flood).await;
    let is_goaway = |part: &[u8]| part[3] == 7 && part[13..17] == [0, 0, 0, 11];
    assert!(answer.is_empty() || answer.windows(17).any(is_goaway));
    answers_others(&server, "a flood of cancelled calls").await;
}

/// Oracle: gRPC: a compressed message whose encoding the server does not take is UNIMPLEMENTED, one
/// without an encoding INTERNAL (gRPC's list of status codes, compression). Neither is unpacked.
#[tokio::test]
async fn compressed_messages_are_not_unpacked() {
    let metrics = Metrics::default();
    let server = start(Config {
        metrics: metrics.clone(),
        ..Config::default()
    })
    .await;

    // As the beginning of a gzip stream of very many zeros.
    let mut packed = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3];
    packed.resize(50_000, 0);
    let mut body = prefixed(&packed);
    body[0] = 1;

    for (encoding, code) in [
        (Some("gzip"), "UNIMPLEMENTED"),
        (Some("zstd"), "UNIMPLEMENTED"),
        (None, "INTERNAL"),
    ] {
        let mut head = headers(NAVIGATE);
        if let Some(encoding) = encoding {
            head.extend(literal(b"\x00\x0dgrpc-encoding", encoding));
        }

        let mut call = frame(1, 4, 1, &head);
        for part in body.chunks(16_000) {
            call.extend(frame(0, 0, 1, part));
        }
        call.extend(frame(0, 1, 1, &[]));
        let labels = format!("method=\"{NAVIGATE}\",code=\"{code}\"");
        let name = format!("seese3_request_seconds_count{{{labels}}}");
        let counted = async || metric(&metrics, &name).unwrap_or(0.0);
        let before = counted().await;
        let mut stream = opened(&server.address, &[]).await;
        stream.write_all(&call).await.unwrap();
        let now = until("a refusal is counted", counted, |now| *now > before).await;
        assert_eq!(now, before + 1.0, "{encoding:?}");
        answers_others(&server, "a compressed message").await;
    }
}

/// Oracle: the promise: streams that say nothing hold nobody up. SEESE3_IDLE_STREAMS says how many,
/// 400 if it is not set.
#[tokio::test]
async fn idle_streams_hold_nobody_up() {
    let given = std::env::var("SEESE3_IDLE_STREAMS").ok();
    let count: usize = given.map_or(400, |text| {
        text.parse().expect("SEESE3_IDLE_STREAMS is a number")
    });
    let server = start_followed(Config {
        // One connection gets half of them.
        streams: 2 * count,
        ..Config::default()
    })
    .await;

    // A connection carries up to 1,024 streams.
    let mut open = Vec::new();
    let mut connections = Vec::new();
    while open.len() < count {
        let options = ConnectOptions {
            deadline: Duration::from_secs(600),
            token: None,
            tls: None,
        };
        let client = Client::connect_with(&server.address, options)
            .await
            .unwrap();
        for _ in 0..(count - open.len()).min(1_000) {
            let (requests, waiting) = tokio::sync::mpsc::channel(1);
            requests.send(begin(config())).await.unwrap();
            let stream = tokio_stream::wrappers::ReceiverStream::new(waiting);
            let mut answers = client.track(stream).await.unwrap();
            let started = answers.message().await.unwrap().unwrap();
            assert!(matches!(started.answer, Some(Answer::Started(_))));
            open.push((requests, answers));
        }
        connections.push(client);
    }
    let rooms = soon("others are answered", server.client.rooms()).await;
    assert_eq!(rooms.unwrap().len(), 2);

    // Each of them is still there.
    let (requests, answers) = open.last_mut().unwrap();
    requests.send(seen(3)).await.unwrap();
    assert!(answers.message().await.unwrap().is_some());
}

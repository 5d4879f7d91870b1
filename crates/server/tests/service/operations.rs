//! What those who operate a server see: metrics and probes.

use seese3_client::Client;
use seese3_client::proto::v1 as pb;
use seese3_server::{Config, Listeners, run};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;

use crate::harness::{PATIENCE, StoppedClock, filled_store, question, soon, until};

/// The status line and the body of a GET.
async fn get(address: &str, path: &str) -> (String, String) {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();

    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    let status = head.lines().next().unwrap();
    (status.to_owned(), body.to_owned())
}

/// The value of a line of metrics that begins so; 0 if there is none.
fn value(metrics: &str, beginning: &str) -> f64 {
    let line = metrics.lines().find(|line| line.starts_with(beginning));
    line.map_or(0.0, |line| {
        line.rsplit(' ').next().unwrap().parse().unwrap()
    })
}

/// Oracle: what was asked, counted by hand; the paths and codes of gRPC; HTTP's codes of probes.
#[tokio::test]
async fn metrics_count_what_was_asked_and_probes_tell_the_stage() {
    let (_folder, store) = filled_store().await;
    let grpc = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let operations = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = grpc.local_addr().unwrap().to_string();
    let operated = operations.local_addr().unwrap().to_string();

    let (stop, stopped) = oneshot::channel();
    let listeners = Listeners {
        grpc,
        operations: Some(operations),
    };
    let ended = tokio::spawn(run(listeners, store, Config::default(), async {
        let _ = stopped.await;
    }));

    let client = Client::connect(&address, PATIENCE).await.unwrap();
    let status = async || get(&operated, "/readyz").await.0;
    until("it is ready", status, |status| status.contains("200")).await;
    assert_eq!(get(&operated, "/livez").await.1, "alive\n");

    for _ in 0..3 {
        client.navigate(question()).await.unwrap();
    }
    let nowhere = pb::NavigateRequest {
        room: "nowhere".to_owned(),
        ..question()
    };
    assert!(client.navigate(nowhere).await.is_err());

    let (status, metrics) = get(&operated, "/metrics").await;
    assert!(status.contains("200"), "{status}");

    let navigate = r#"seese3_request_seconds_count{method="/seese3.v1.NavigationService/Navigate""#;
    assert_eq!(value(&metrics, &format!(r#"{navigate},code="OK"}}"#)), 3.0);
    assert_eq!(
        value(&metrics, &format!(r#"{navigate},code="NOT_FOUND"}}"#)),
        1.0
    );
    assert_eq!(value(&metrics, "seese3_rooms"), 2.0);
    assert_eq!(value(&metrics, "seese3_adapters"), 1.0);
    assert_eq!(value(&metrics, "seese3_requests_in_flight"), 0.0);
    assert_eq!(value(&metrics, "seese3_retrieval_distance_count"), 3.0);
    assert!(metrics.ends_with("# EOF\n"), "OpenMetrics ends so");

    stop.send(()).unwrap();
    ended.await.unwrap().unwrap();
}

/// Oracle: the promise: a scrape is answered at once beside more connections than there are places,
/// all of which say nothing.
#[tokio::test]
async fn silent_connections_do_not_stop_scrapes() {
    // No time passes after which silent connections are closed.
    let _clock = StoppedClock::new();
    let (_folder, store) = filled_store().await;
    let operations = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let operated = operations.local_addr().unwrap().to_string();
    let listeners = Listeners {
        grpc: TcpListener::bind("127.0.0.1:0").await.unwrap(),
        operations: Some(operations),
    };
    tokio::spawn(run(
        listeners,
        store,
        Config::default(),
        std::future::pending(),
    ));

    let mut silent = Vec::new();
    for _ in 0..300 {
        silent.push(TcpStream::connect(&operated).await.unwrap());
    }

    let scraped = soon("a scrape is answered", get(&operated, "/livez")).await;
    assert_eq!(scraped.1, "alive\n");
}

//! The second listener, for those who operate a server: metrics and probes over plain HTTP.
//!
//! It has connections of its own, so that it answers while the gRPC port is full; few of them, and
//! none for long, because it asks for no credentials.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::time::Duration;

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::{AbortHandle, JoinSet};

use super::Phase;
use super::metrics::Metrics;

/// The media type of OpenMetrics, which Prometheus reads.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

#[derive(Clone)]
struct Operated {
    metrics: Metrics,
    phase: watch::Receiver<Phase>,
}

/// So many connections may be open; a further one takes the place of the oldest, so that whoever
/// asks at once is answered however many stay silent.
const CONNECTIONS: usize = 64;
/// A connection that asks nothing for so long is closed.
const SILENCE: Duration = Duration::from_secs(5);
/// No connection lives longer; whoever scrapes opens the next one.
const LIFETIME: Duration = Duration::from_secs(60);
/// The pause after the system refused to accept a connection.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// Answers `/metrics`, `/livez` and `/readyz` until it is dropped.
pub(super) async fn serve(
    listener: TcpListener,
    metrics: Metrics,
    phase: watch::Receiver<Phase>,
) -> Infallible {
    let router = Router::new()
        .route("/metrics", get(scrape))
        .route("/livez", get(|| async { "alive\n" }))
        .route("/readyz", get(ready))
        .with_state(Operated { metrics, phase });

    // Trouble that lasts is logged once.
    let mut is_refused = false;

    // When the set is dropped, so are the connections.
    let mut connections = JoinSet::new();
    let mut open: VecDeque<AbortHandle> = VecDeque::new();
    loop {
        while connections.try_join_next().is_some() {}
        open.retain(|connection| !connection.is_finished());

        match listener.accept().await {
            Ok((stream, _)) => {
                is_refused = false;
                if open.len() >= CONNECTIONS {
                    open.pop_front().inspect(AbortHandle::abort);
                }
                open.push_back(connections.spawn(answer(stream, router.clone())));
            }
            Err(error) => {
                if !is_refused {
                    tracing::error!(%error, "no connection for metrics can be accepted");
                }
                is_refused = true;
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Answers the requests of one connection.
async fn answer(stream: TcpStream, router: Router) {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(SILENCE)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));

    // However it ends, there is nobody left to tell.
    let _ = tokio::time::timeout(LIFETIME, connection).await;
}

async fn scrape(State(operated): State<Operated>) -> impl IntoResponse {
    (
        [(header::CONTENT_TYPE, OPEN_METRICS)],
        operated.metrics.text(),
    )
}

/// Ready as long as requests are answered: not while loading, and not while stopping.
async fn ready(State(operated): State<Operated>) -> (StatusCode, &'static str) {
    match *operated.phase.borrow() {
        Phase::Serving(_) => (StatusCode::OK, "serving\n"),
        Phase::Loading => (StatusCode::SERVICE_UNAVAILABLE, "loading\n"),
        Phase::Draining(_) | Phase::Stopping => (StatusCode::SERVICE_UNAVAILABLE, "stopping\n"),
    }
}

//! The operations listener: metrics and probes over plain HTTP.
//!
//! It has its own connections, so that it answers while the gRPC port is at its limit. Their number
//! and lifetime are small because no credentials are required.

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

/// Maximum number of open connections. A further one replaces the oldest, so that idle connections
/// cannot block a scrape.
const CONNECTIONS: usize = 64;
/// Timeout for receiving a request's headers; the connection is then closed.
const SILENCE: Duration = Duration::from_secs(5);
/// Maximum lifetime of a connection.
const LIFETIME: Duration = Duration::from_secs(60);
/// Pause after `accept` failed.
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

    // A condition that persists is logged once.
    let mut is_refused = false;

    // Dropping the set closes the connections.
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
                    tracing::error!(%error, "cannot accept connections for metrics");
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

    // Errors and timeouts only close the connection.
    let _ = tokio::time::timeout(LIFETIME, connection).await;
}

async fn scrape(State(operated): State<Operated>) -> impl IntoResponse {
    (
        [(header::CONTENT_TYPE, OPEN_METRICS)],
        operated.metrics.text(),
    )
}

/// Readiness: 200 while serving, 503 while loading or stopping.
async fn ready(State(operated): State<Operated>) -> (StatusCode, &'static str) {
    match *operated.phase.borrow() {
        Phase::Serving(_) => (StatusCode::OK, "serving\n"),
        Phase::Loading => (StatusCode::SERVICE_UNAVAILABLE, "loading\n"),
        Phase::Draining(_) | Phase::Stopping => (StatusCode::SERVICE_UNAVAILABLE, "stopping\n"),
    }
}

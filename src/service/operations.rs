//! The second listener, for those who operate a server: metrics and probes over plain HTTP.
//!
//! It has connections of its own, so that it answers while the gRPC port is full.

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::watch;

use super::Phase;
use super::metrics::Metrics;

/// The media type of OpenMetrics, which Prometheus reads.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

#[derive(Clone)]
struct Operated {
    metrics: Metrics,
    phase: watch::Receiver<Phase>,
}

/// Answers `/metrics`, `/livez` and `/readyz` until it is dropped.
pub(super) async fn serve(
    listener: TcpListener,
    metrics: Metrics,
    phase: watch::Receiver<Phase>,
) -> std::io::Result<()> {
    let router = Router::new()
        .route("/metrics", get(scrape))
        .route("/livez", get(|| async { "alive\n" }))
        .route("/readyz", get(ready))
        .with_state(Operated { metrics, phase });

    axum::serve(listener, router).await
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

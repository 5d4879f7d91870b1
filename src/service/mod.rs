//! The gRPC service: package `seese3.v1`, standard health and reflection.
//!
//! - A request answers from the [`Snapshot`] that was current when it began; a snapshot never
//!   changes. When the store has, a new one takes its place.
//! - Computation runs on blocking threads, a bounded number at a time; a panic there fails only
//!   that one request.
//! - Long work checks between its pieces whether the deadline passed or the caller went away, and
//!   stops if so.

mod catalog;
mod convert;
mod evaluation;
mod image_encoder;
mod navigate_to;
mod health;
mod localization;
mod navigation;
mod odometry;
mod reload;
mod relocalization;
mod shutdown;
mod snapshot;
mod status;
mod telemetry;
mod track;
mod two_views;
mod workers;

pub use image_encoder::ImageEncoders;
pub use reload::Reload;
pub use shutdown::shutdown_signal;
pub use snapshot::Snapshot;
pub use status::Error;
pub use track::TokenKey;

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::{Semaphore, oneshot, watch};
use tonic::transport::Server;
use tonic::transport::server::TcpIncoming;
use tower::util::MapRequestLayer;
use tower_http::request_id::{PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::trace::TraceLayer;

use crate::store::{self, Store};
use seese3_client::proto::FILE_DESCRIPTOR_SET;
use seese3_client::proto::v1::catalog_service_server::CatalogServiceServer;
use seese3_client::proto::v1::evaluation_service_server::EvaluationServiceServer;
use seese3_client::proto::v1::localization_service_server::LocalizationServiceServer;
use seese3_client::proto::v1::navigation_service_server::NavigationServiceServer;
use seese3_client::proto::v1::odometry_service_server::OdometryServiceServer;
use seese3_core::navigation::{IndexKind, Limits};
use snapshot::Loader;
use workers::Workers;

/// After the drain time, how long the server still waits for callers to receive the error of their
/// abandoned requests.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// The configuration and the limits of a server.
#[derive(Debug, Clone)]
pub struct Config {
    /// The index in which navigators search for the nearest frames.
    pub index: IndexKind,
    /// The limits of one request: steps, hits, and frames in the whole answer.
    pub limits: Limits,
    /// The encoders for images that callers send; none if the server takes no images.
    pub encoders: Option<ImageEncoders>,
    /// The largest number of requests in one BatchNavigate.
    pub batch: usize,
    /// The largest number of predictions in one ScorePredictions.
    pub predictions: usize,
    /// The largest message that is received, bytes.
    pub message_bytes: usize,
    /// The largest number of requests computed at the same time.
    pub threads: usize,
    /// The largest number of requests that wait for a thread; a further one is refused.
    pub queue: usize,
    /// The longest time for one request; a caller's own deadline can only shorten it.
    pub longest: Duration,
    /// The largest number of Track streams open at the same time; a further one is refused.
    pub streams: usize,
    /// The key that authenticates resume tokens. Servers that share it accept one another's tokens.
    pub token_key: TokenKey,
    /// How long requests in flight may continue after the shutdown signal.
    pub drain: Duration,
    /// When the server looks for changes of its store.
    pub reload: Reload,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            index: IndexKind::Exact,
            limits: Limits::default(),
            encoders: None,
            batch: 256,
            predictions: 100_000,
            message_bytes: 4 << 20,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            queue: 1_024,
            longest: Duration::from_secs(300),
            streams: 4_096,
            token_key: TokenKey::random(),
            drain: Duration::from_secs(10),
            reload: Reload::default(),
        }
    }
}

/// Why a server ended.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum RunError {
    #[error(transparent)]
    Store(#[from] store::Error),
    #[error("store '{location}' has no room; import one first")]
    NoRoom { location: String },
    #[error("no room of the store can be served; room '{room}': {reason}")]
    NoneServed { room: String, reason: String },
    #[error("--encoder {model}: {problem}")]
    Model {
        model: String,
        problem: crate::encoder::Error,
    },
    #[error("--two-view {}: {problem}; give XFeat's ONNX file (`seese3 encoders` says how to export it)", file.display())]
    TwoView {
        file: std::path::PathBuf,
        problem: String,
    },
    #[error("the server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    #[error("the reflection service cannot be made: {0}")]
    Reflection(String),
    #[error("loading the store failed: {0}")]
    Loading(String),
}

/// The stage of a server's life, which health and every handler read.
#[derive(Clone)]
enum Phase {
    Loading,
    Serving(Arc<Snapshot>),
    Draining(Arc<Snapshot>),
    /// The shutdown signal came before the store was loaded.
    Stopping,
}

/// The state that all handlers share.
#[derive(Clone)]
struct Handlers {
    phase: watch::Receiver<Phase>,
    workers: Workers,
    config: Arc<Config>,
    streams: Arc<Semaphore>,
}

impl Handlers {
    fn snapshot(&self) -> Result<Arc<Snapshot>, Error> {
        match &*self.phase.borrow() {
            Phase::Serving(snapshot) | Phase::Draining(snapshot) => Ok(snapshot.clone()),
            Phase::Loading | Phase::Stopping => Err(Error::Loading),
        }
    }
}

/// Serves a store until `shutdown` completes. The health service answers from the first moment,
/// with NOT_SERVING until the whole store is loaded.
///
/// # Errors
/// [`RunError`] if the store cannot be read, or none of its rooms can be served, in which case the
/// server ends before it serves; or if the transport fails. A single room or adapter that cannot be
/// served is refused by itself.
pub async fn run(
    listener: TcpListener,
    store: Store,
    config: Config,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), RunError> {
    // Health, reflection and the other services listen at once and read the phase from this
    // channel. Until the store is loaded, requests are refused as UNAVAILABLE.
    let (phase, watched) = watch::channel(Phase::Loading);
    let (stop, stopped) = oneshot::channel::<()>();
    let workers = Workers::new(&config);

    let handlers = Handlers {
        phase: watched.clone(),
        workers: workers.clone(),
        config: Arc::new(config.clone()),
        streams: Arc::new(Semaphore::new(config.streams)),
    };
    let server = server(handlers, watched, listener, async {
        // An error means that `run` was dropped; the server must stop then, too.
        let _ = stopped.await;
    })?;

    tokio::pin!(server, shutdown);
    let loading = async {
        let loader = Loader::open(store, config.index, config.encoders).await?;
        let first = loader.first().await?;
        Ok::<_, RunError>((loader, first))
    };

    // The server future has to be polled while the store loads, or no health check would be
    // answered.
    let (loader, first) = tokio::select! {
        loaded = loading => loaded?,
        ended = &mut server => return ended,
        () = &mut shutdown => {
            phase.send_replace(Phase::Stopping);
            return Ok(());
        }
    };

    tracing::info!(
        rooms = first.rooms().len(),
        adapters = first.adapters().len(),
        refused_rooms = first.refused().rooms.len(),
        refused_adapters = first.refused().adapters.len(),
        "serving"
    );

    // From here on requests are answered. The function waits for the shutdown signal or for a
    // failure of the server.
    phase.send_replace(Phase::Serving(Arc::new(first)));

    tokio::select! {
        ended = &mut server => return ended,
        () = &mut shutdown => {}
        () = reload::keep_current(loader, config.reload, &phase) => {}
    }

    tracing::info!(bound_s = config.drain.as_secs_f64(), "draining");

    // Health turns to NOT_SERVING and open Track streams end, so that load balancers and robots
    // move to another server while short requests finish here.
    phase.send_modify(|phase| {
        if let Phase::Serving(snapshot) = phase {
            *phase = Phase::Draining(snapshot.clone());
        }
    });

    // An error means the server has ended already.
    let _ = stop.send(());
    if let Ok(ended) = tokio::time::timeout(config.drain, &mut server).await {
        return ended;
    }

    tracing::warn!("the drain bound passed; requests still in flight are given up");
    workers.halt();

    // The abandoned requests now end with UNAVAILABLE. Wait a moment for callers to read that.
    tokio::time::timeout(LAST_WORDS, server)
        .await
        .unwrap_or(Ok(()))
}

fn server(
    handlers: Handlers,
    phase: watch::Receiver<Phase>,
    listener: TcpListener,
    stopped: impl Future<Output = ()> + Send,
) -> Result<impl Future<Output = Result<(), RunError>> + Send, RunError> {
    let most = handlers.config.message_bytes;

    // Reflection is offered in both versions, because some clients speak only v1alpha.
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let failed = |error: tonic_reflection::server::Error| RunError::Reflection(error.to_string());
    let v1 = reflection().build_v1().map_err(failed)?;
    let v1alpha = reflection().build_v1alpha().map_err(failed)?;

    // Keep-alive pings detect clients that vanished without closing their connection; when it is
    // closed their requests are cancelled.
    let router = Server::builder()
        .http2_keepalive_interval(Some(Duration::from_secs(30)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .max_concurrent_streams(Some(1_024))
        .layer(MapRequestLayer::new(telemetry::without_unfit_id))
        .layer(SetRequestIdLayer::new(
            telemetry::REQUEST_ID,
            telemetry::RandomId,
        ))
        .layer(
            TraceLayer::new_for_grpc()
                .make_span_with(telemetry::span)
                .on_request(())
                .on_response(telemetry::record_headers)
                .on_eos(telemetry::record_trailers)
                .on_failure(()),
        )
        .layer(PropagateRequestIdLayer::new(telemetry::REQUEST_ID))
        .add_service(health::service(phase))
        .add_service(v1)
        .add_service(v1alpha)
        .add_service(NavigationServiceServer::new(handlers.clone()).max_decoding_message_size(most))
        .add_service(
            LocalizationServiceServer::new(handlers.clone()).max_decoding_message_size(most),
        )
        .add_service(OdometryServiceServer::new(handlers.clone()).max_decoding_message_size(most))
        .add_service(CatalogServiceServer::new(handlers.clone()).max_decoding_message_size(most))
        .add_service(EvaluationServiceServer::new(handlers).max_decoding_message_size(most));

    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    Ok(async move {
        Ok(router
            .serve_with_incoming_shutdown(incoming, stopped)
            .await?)
    })
}

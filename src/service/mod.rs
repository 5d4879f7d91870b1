//! The gRPC service: package `seese3.v1`, standard health and reflection.
//!
//! - A request keeps the [`Snapshot`] it began with; a snapshot never changes.
//! - Work that computes runs on blocking threads, a bounded number at a time; a panic there costs
//!   one request.
//! - Deadlines and callers that went away stop the work between its pieces.

mod catalog;
mod convert;
mod evaluation;
mod eye;
mod goals;
mod health;
mod localization;
mod navigation;
mod odometry;
mod relocalization;
mod shutdown;
mod snapshot;
mod status;
mod telemetry;
mod track;
mod work;

pub use convert::pose as pose_from_wire;
pub use eye::ImageEncoders;
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

use crate::navigation::{IndexKind, Limits};
use crate::proto::FILE_DESCRIPTOR_SET;
use crate::proto::v1::catalog_service_server::CatalogServiceServer;
use crate::proto::v1::evaluation_service_server::EvaluationServiceServer;
use crate::proto::v1::localization_service_server::LocalizationServiceServer;
use crate::proto::v1::navigation_service_server::NavigationServiceServer;
use crate::proto::v1::odometry_service_server::OdometryServiceServer;
use crate::store::{self, Store};
use work::Workers;

/// How long callers have to hear that their request was given up.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// What a server allows.
#[derive(Debug, Clone)]
pub struct Config {
    /// Which index its navigators search.
    pub index: IndexKind,
    /// Of one question.
    pub limits: Limits,
    /// What images are encoded with, if callers may send them.
    pub encoders: Option<ImageEncoders>,
    /// Of one batch, requests.
    pub batch: usize,
    /// Of one ScorePredictions, pairs.
    pub predictions: usize,
    /// Of a received message, bytes.
    pub message_bytes: usize,
    /// Requests computed at a time.
    pub threads: usize,
    /// Requests that may wait for a thread; one more is refused.
    pub queue: usize,
    /// The longest a request may take, whatever its own deadline.
    pub longest: Duration,
    /// Cameras that are followed at a time; one more is refused.
    pub streams: usize,
    /// Seals what a stream goes on from. Servers that share it take one another's tokens.
    pub token_key: TokenKey,
    /// How long requests in flight may go on after the server was told to stop.
    pub drain: Duration,
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
        }
    }
}

/// Why a server ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Store(#[from] store::Error),
    #[error("store '{location}' has no room; import one first")]
    NoRoom { location: String },
    #[error("adapter '{adapter}' does not serve room '{room}': {problem}")]
    Navigator {
        adapter: String,
        room: String,
        problem: crate::navigation::Error,
    },
    #[error("adapter '{adapter}' cannot be given images: {problem}")]
    Encoder {
        adapter: String,
        problem: crate::encoder::Error,
    },
    #[error("--encoder {model}: {problem}")]
    Model {
        model: String,
        problem: crate::encoder::Error,
    },
    #[error("the server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    #[error("the reflection service cannot be made: {0}")]
    Reflection(String),
    #[error("loading the store failed: {0}")]
    Loading(String),
}

/// What a server is doing.
#[derive(Clone)]
enum Phase {
    Loading,
    Serving(Arc<Snapshot>),
    Draining(Arc<Snapshot>),
    /// Told to stop before anything was loaded.
    Stopping,
}

/// What every handler needs.
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

/// Serves a store until `shutdown` completes. Health answers from the first moment, NOT_SERVING
/// until all is loaded.
///
/// # Errors
/// [`RunError`]; a store that is damaged ends the server before it serves.
pub async fn run(
    listener: TcpListener,
    store: Store,
    config: Config,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), RunError> {
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
        // An error means the sender is gone: the server is to stop all the same.
        let _ = stopped.await;
    })?;

    tokio::pin!(server, shutdown);
    let loading = snapshot::load(store, config.index, config.encoders);

    let loaded = tokio::select! {
        loaded = loading => loaded?,
        ended = &mut server => return ended,
        () = &mut shutdown => {
            phase.send_replace(Phase::Stopping);
            return Ok(());
        }
    };

    let loaded = Arc::new(loaded);
    tracing::info!(
        rooms = loaded.room_count(),
        adapters = loaded.adapter_count(),
        "serving"
    );

    phase.send_replace(Phase::Serving(loaded.clone()));

    tokio::select! {
        ended = &mut server => return ended,
        () = &mut shutdown => {}
    }

    tracing::info!(bound_s = config.drain.as_secs_f64(), "draining");
    phase.send_replace(Phase::Draining(loaded));

    // An error means the server has ended already.
    let _ = stop.send(());
    if let Ok(ended) = tokio::time::timeout(config.drain, &mut server).await {
        return ended;
    }

    tracing::warn!("the drain bound passed; requests still in flight are given up");
    workers.halt();

    // Their callers are answered, unless they do not even read that.
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

    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let failed = |error: tonic_reflection::server::Error| RunError::Reflection(error.to_string());
    let v1 = reflection().build_v1().map_err(failed)?;
    let v1alpha = reflection().build_v1alpha().map_err(failed)?;

    let router = Server::builder()
        .http2_keepalive_interval(Some(Duration::from_secs(30)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .max_concurrent_streams(Some(1_024))
        .layer(telemetry::TelemetryLayer)
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

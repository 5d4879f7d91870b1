//! The gRPC service: package `seese3.v1`, standard health and reflection.
//!
//! - A request answers from the [`Snapshot`] that was current when it began; a snapshot never
//!   changes. When the store has, a new one takes its place.
//! - Computation runs on blocking threads, a bounded number at a time; a panic there fails only
//!   that one request.
//! - Long work checks between its pieces whether the deadline passed or the caller went away, and
//!   stops if so.

mod health;
mod holding_body;
mod shutdown;
mod status;
mod tls;
#[cfg(feature = "otlp")]
mod traces;
mod metrics;
mod connections;
mod image_encoder;
mod request_metrics;
mod operations;
mod workers;
mod auth;
mod memory;
mod telemetry;
mod two_views;
mod snapshot;
mod convert;
mod reload;
mod catalog;
mod evaluation;
mod localization;
mod navigate_to;
mod navigation;
mod relocalization;
mod track;
mod odometry;
mod encoding;

pub use auth::{AuthError, Keyring};
pub use convert::{pinhole_to_wire, source_to_wire};
pub use image_encoder::ImageEncoders;
pub use metrics::Metrics;
pub use reload::Reload;
pub use shutdown::shutdown_signal;
pub use snapshot::{RoomMemory, Snapshot};
pub use status::{Error, Full};
pub use tls::{Tls, TlsError, TlsFiles};
#[cfg(feature = "otlp")]
pub use traces::Traces;
pub use track::TokenKey;

use seese3_core::Cause;
use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, oneshot, watch};
use tonic::transport::Server;
use tonic::{Request, Response, Status};
use tower::util::MapRequestLayer;
use tower_http::request_id::{PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::trace::TraceLayer;

use auth::{AuthLayer, Principal};
use catalog::Changes;
use health::RoomHealth;
use memory::{Memory, MemoryLayer, respond};
use reload::ReloadHandle;
use request_metrics::RequestMetricsLayer;
use seese3_client::proto::FILE_DESCRIPTOR_SET;
use seese3_client::proto::v1::catalog_service_server::CatalogServiceServer;
use seese3_client::proto::v1::evaluation_service_server::EvaluationServiceServer;
use seese3_client::proto::v1::localization_service_server::LocalizationServiceServer;
use seese3_client::proto::v1::navigation_service_server::NavigationServiceServer;
use seese3_client::proto::v1::odometry_service_server::OdometryServiceServer;
use seese3_core::cancel::Cancellation;
use seese3_core::navigation::{IndexKind, Limits};
use seese3_store::Store;
use snapshot::Loader;
use workers::{Lane, Workers};

/// What those may hold in memory who watch health: this part of what requests may.
const WATCHERS: usize = 8;
/// What health checks may hold in memory, bytes.
const PROBES: usize = 16 << 20;
/// After the drain time, how long the server still waits for callers to receive the error of their
/// abandoned requests.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// The configuration and the limits of a server.
#[derive(Debug, Clone)]
pub struct Config {
    /// The index in which navigators search for the nearest frames.
    pub index: IndexKind,
    /// Which rooms are in memory.
    pub rooms: RoomMemory,
    /// The limits of one request: steps, hits, and frames in the whole answer.
    pub limits: Limits,
    /// The encoders for images that callers send; none if the server takes no images.
    pub encoders: Option<ImageEncoders>,
    /// The largest number of requests in one BatchNavigate.
    pub batch: usize,
    /// The largest number of predictions in one ScorePredictions.
    pub predictions: usize,
    /// What all requests in progress may hold in memory together, bytes.
    pub memory_bytes: usize,
    /// How long a request with one message may take to arrive.
    pub receive_within: Duration,
    /// How long a caller may receive nothing of a unary response, before its connection is closed.
    pub response_timeout: Duration,
    /// Whether callers may change the catalog.
    pub writable: bool,
    /// Whether callers may see the images of rooms, as thumbnails.
    pub thumbnails: bool,
    /// What all uploads in progress may hold in memory together, bytes.
    pub upload_bytes: usize,
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
    /// How long the server still accepts requests after the shutdown signal, while health says
    /// NOT_SERVING.
    pub lame_duck: Duration,
    /// How long requests in flight may continue after that.
    pub drain: Duration,
    /// When the server looks for changes of its store.
    pub reload: Reload,
    /// What the server counts.
    pub metrics: Metrics,
    /// The largest number of connections at a time; a further one is closed at once.
    pub connections: usize,
    /// The server's certificate; none to speak plain text.
    pub tls: Option<Arc<Tls>>,
    /// Who may call; none to answer everybody.
    pub keyring: Option<Arc<Keyring>>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            index: IndexKind::Exact,
            rooms: RoomMemory::default(),
            limits: Limits::default(),
            encoders: None,
            batch: 256,
            predictions: 100_000,
            memory_bytes: 1 << 30,
            receive_within: Duration::from_secs(30),
            response_timeout: Duration::from_secs(60),
            writable: false,
            thumbnails: false,
            upload_bytes: 1 << 30,
            message_bytes: 4 << 20,
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            queue: 1_024,
            longest: Duration::from_secs(300),
            streams: 4_096,
            token_key: TokenKey::random(),
            lame_duck: Duration::ZERO,
            drain: Duration::from_secs(10),
            reload: Reload::default(),
            metrics: Metrics::default(),
            connections: 4_096,
            tls: None,
            keyring: None,
        }
    }
}

/// Why a server ended.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum RunError {
    #[error(transparent)]
    Store(#[from] seese3_store::Error),
    #[error("store '{location}' has no room; import one first")]
    NoRoom { location: String },
    #[error("no room of the store can be served; room '{room}': {reason}")]
    NoneServed { room: String, reason: String },
    #[error("--encoder {model}: {problem}")]
    Model {
        model: String,
        #[source]
        problem: seese3_encoder::Error,
    },
    #[error("--two-view {}: {problem}; give XFeat's ONNX file (`seese3 encoders` says how to export it)", file.display())]
    TwoView {
        file: std::path::PathBuf,
        #[source]
        problem: Cause,
    },
    #[error("the server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    #[error("the reflection service cannot be made: {0}")]
    Reflection(#[source] tonic_reflection::server::Error),
    #[error("loading the store failed: {0}")]
    Loading(#[source] tokio::task::JoinError),
}

/// Where a server listens.
#[derive(Debug)]
pub struct Listeners {
    /// For gRPC.
    pub grpc: TcpListener,
    /// For `/metrics`, `/livez` and `/readyz` over HTTP, if anywhere.
    pub operations: Option<TcpListener>,
}

impl From<TcpListener> for Listeners {
    fn from(grpc: TcpListener) -> Self {
        Self {
            grpc,
            operations: None,
        }
    }
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
    /// What changes of the catalog go through; none if this server takes no changes.
    changes: Option<Arc<Changes>>,
}

impl Handlers {
    /// What is served now, as far as the caller of the request may see it.
    fn snapshot<T>(&self, request: &Request<T>) -> Result<Arc<Snapshot>, Error> {
        let snapshot = match &*self.phase.borrow() {
            Phase::Serving(snapshot) | Phase::Draining(snapshot) => snapshot.clone(),
            Phase::Loading | Phase::Stopping => return Err(Error::Loading),
        };

        let scope = principal(request).map(|principal| principal.rooms());
        Ok(match scope.filter(|scope| !scope.is_all()) {
            Some(scope) => Arc::new(snapshot.seen_by(scope)),
            None => snapshot,
        })
    }
}

impl Handlers {
    /// Answers a unary request from the current snapshot: `work` runs on a worker thread of the lane,
    /// within the caller's deadline.
    async fn unary<Q, A>(
        &self,
        request: Request<Q>,
        lane: impl FnOnce(&Q) -> Lane,
        work: impl FnOnce(&Snapshot, Q, &Cancellation) -> Result<A, Error> + Send + 'static,
    ) -> Result<Response<A>, Status>
    where
        Q: Send + 'static,
        A: Message + 'static,
    {
        let snapshot = self.snapshot(&request)?;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();
        let lane = lane(&request);

        let work = move |cancel: &Cancellation| work(&snapshot, request, cancel);
        respond(self.workers.run(lane, budget, work).await?)
    }
}

/// Who a request is from; none if the server answers everybody.
fn principal<T>(request: &Request<T>) -> Option<&Arc<Principal>> {
    request.extensions().get()
}

/// Serves a store until `shutdown` completes. The health service answers from the first moment,
/// with NOT_SERVING until the whole store is loaded.
///
/// # Errors
/// [`RunError`] if the store cannot be read, or none of its rooms can be served, in which case the
/// server ends before it serves; or if the transport fails. A single room or adapter that cannot be
/// served is refused by itself.
pub async fn run(
    listeners: impl Into<Listeners>,
    store: Store,
    config: Config,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), RunError> {
    // Health, reflection and the other services listen at once and read the phase from this
    // channel. Until the store is loaded, requests are refused as UNAVAILABLE.
    let Listeners { grpc, operations } = listeners.into();
    let (phase, watched) = watch::channel(Phase::Loading);
    let metrics = config.metrics.clone();
    let (stop, stopped) = oneshot::channel::<()>();
    let workers = Workers::new(&config);
    let (reload_handle, reload_requests) = ReloadHandle::new();
    let changes = Changes::new(store.clone(), reload_handle, &config);

    let handlers = Handlers {
        phase: watched.clone(),
        workers: workers.clone(),
        config: Arc::new(config.clone()),
        streams: Arc::new(Semaphore::new(config.streams)),
        changes: config.writable.then(|| Arc::new(changes)),
    };
    let answering = server(handlers, watched.clone(), grpc, async {
        // An error means that `run` was dropped; the server must stop then, too.
        let _ = stopped.await;
    })?;
    let operating = operate(operations, metrics.clone(), watched);
    let following = follow_files(config.tls.clone(), config.keyring.clone());
    let server = async {
        tokio::select! {
            ended = answering => ended,
            never = operating => match never {},
            never = following => match never {},
        }
    };

    tokio::pin!(server, shutdown);
    let loading = async {
        let loader = Loader::open(store, &config).await?;
        let first = loader.first(config.writable).await?;
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

    metrics.serving(first.counts());

    // From here on requests are answered. The function waits for the shutdown signal or for a
    // failure of the server.
    phase.send_replace(Phase::Serving(Arc::new(first)));

    tokio::select! {
        ended = &mut server => return ended,
        () = &mut shutdown => {}
        () = reload::keep_current(loader, config.reload, reload_requests, config.writable, &phase, &metrics) => {}
    }

    tracing::info!(bound_s = config.drain.as_secs_f64(), "draining");

    // Health turns to NOT_SERVING and open Track streams end, so that load balancers and robots
    // move to another server while short requests finish here.
    phase.send_modify(|phase| {
        if let Phase::Serving(snapshot) = phase {
            *phase = Phase::Draining(snapshot.clone());
        }
    });

    // Load balancers need a moment to notice; until then they still send requests here.
    if let Ok(ended) = tokio::time::timeout(config.lame_duck, &mut server).await {
        return ended;
    }

    // An error means the server has ended already.
    let _ = stop.send(());
    drained(server, config.drain, &workers, &metrics).await
}

/// Waits until a server that was told to stop has ended: at most `bound`, and then a moment.
async fn drained(
    mut server: Pin<&mut impl Future<Output = Result<(), RunError>>>,
    bound: Duration,
    workers: &Workers,
    metrics: &Metrics,
) -> Result<(), RunError> {
    tokio::select! {
        ended = &mut server => return ended,
        // Callers that answer nothing keep their connections open. Without a request they are not
        // waited for.
        () = idle(metrics) => {}
        () = tokio::time::sleep(bound) => {
            tracing::warn!("the drain bound passed; requests still in flight are given up");
            workers.halt();
        }
    }

    // Wait a moment for callers to read their last answers; of abandoned requests that is
    // UNAVAILABLE.
    tokio::time::timeout(LAST_WORDS, server)
        .await
        .unwrap_or(Ok(()))
}

/// Completes when no request is being answered.
async fn idle(metrics: &Metrics) {
    while metrics.in_flight() > 0 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Notices new certificates and credentials; never completes.
async fn follow_files(tls: Option<Arc<Tls>>, keyring: Option<Arc<Keyring>>) -> Infallible {
    let of_tls = async {
        if let Some(tls) = &tls {
            tls.follow_files().await;
        }
    };
    let of_keyring = async {
        if let Some(keyring) = &keyring {
            keyring.follow_file().await;
        }
    };

    tokio::join!(of_tls, of_keyring);
    std::future::pending().await
}

/// Answers those who operate the server, if there is a listener for them; never completes.
async fn operate(
    listener: Option<TcpListener>,
    metrics: Metrics,
    phase: watch::Receiver<Phase>,
) -> Infallible {
    match listener {
        None => std::future::pending().await,
        Some(listener) => operations::serve(listener, metrics, phase).await,
    }
}

fn memory_layer(config: &Config) -> MemoryLayer {
    let memory = Memory::new(config.memory_bytes, config.metrics.clone());
    let counted = memory.clone();
    config.metrics.gauge_elsewhere(
        "memory_held_bytes",
        "What requests in progress are counted to hold in memory",
        move || counted.held() as u64,
    );

    MemoryLayer {
        memory,
        message_bytes: config.message_bytes,
        receive_within: config.receive_within,
        response_timeout: config.response_timeout,
        probes: Memory::new(PROBES, config.metrics.clone()),
        watchers: Memory::new(config.memory_bytes / WATCHERS, config.metrics.clone()),
    }
}

fn server(
    handlers: Handlers,
    phase: watch::Receiver<Phase>,
    listener: TcpListener,
    stopped: impl Future<Output = ()> + Send,
) -> Result<impl Future<Output = Result<(), RunError>> + Send, RunError> {
    let Config {
        message_bytes: most,
        connections,
        tls,
        keyring,
        metrics,
        ..
    } = handlers.config.as_ref().clone();

    let memory = memory_layer(&handlers.config);

    let room_health = match &keyring {
        Some(_) => RoomHealth::Hidden,
        None => RoomHealth::Shown,
    };

    // Reflection is offered in both versions, because some clients speak only v1alpha.
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let failed = RunError::Reflection;
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
        .layer(RequestMetricsLayer(metrics.clone()))
        .layer(AuthLayer {
            keyring,
            metrics: metrics.clone(),
        })
        .layer(memory)
        .add_service(health::service(phase, room_health))
        .add_service(v1)
        .add_service(v1alpha)
        .add_service(NavigationServiceServer::new(handlers.clone()).max_decoding_message_size(most))
        .add_service(
            LocalizationServiceServer::new(handlers.clone()).max_decoding_message_size(most),
        )
        .add_service(OdometryServiceServer::new(handlers.clone()).max_decoding_message_size(most))
        .add_service(CatalogServiceServer::new(handlers.clone()).max_decoding_message_size(most))
        .add_service(EvaluationServiceServer::new(handlers).max_decoding_message_size(most));

    let incoming = connections::incoming(listener, connections, tls, metrics);
    Ok(async move {
        Ok(router
            .serve_with_incoming_shutdown(incoming, stopped)
            .await?)
    })
}

//! The gRPC service: package `seese3.v1`, standard health and reflection.
//!
//! - A request is answered from the [`Snapshot`] that was current when it began. Snapshots are
//!   immutable; when the store changes, a new one replaces the old.
//! - Computation runs on a bounded number of blocking threads, or in place if it takes about a tenth
//!   of a millisecond. A panic fails only its request.
//! - Long work regularly checks for cancellation: it stops after the deadline, or when the caller
//!   has gone.
//!
//! ```no_run
//! use seese3_server::{Config, run};
//! use seese3_store::Store;
//!
//! # async fn serve() -> Result<(), Box<dyn std::error::Error>> {
//! let listener = tokio::net::TcpListener::bind("127.0.0.1:50051").await?;
//! let stop = async {
//!     let _ = tokio::signal::ctrl_c().await;
//! };
//! run(listener, Store::open("store")?, Config::default(), stop).await?;
//! # Ok(()) }
//! ```

mod health;
mod holding_body;
mod shutdown;
mod slow_files;
mod status;
mod tls;
#[cfg(feature = "otlp")]
mod traces;
mod rpcs;
mod metrics;
mod connections;
mod decoding;
mod image_encoder;
mod request_metrics;
mod operations;
mod auth;
mod caller;
mod shares;
mod workers;
mod memory;
mod telemetry;
mod two_views;
mod stated_revisions;
mod snapshot;
mod convert;
mod cost;
mod embedding;
mod image_view;
mod reload;
mod received_keypoints;
mod received_room;
mod room_messages;
mod catalog;
mod localization;
mod evaluation;
mod plan_route;
mod navigation;
mod relocalization;
mod track;
mod odometry;
mod encoding;

pub use auth::{AuthError, Keyring};
pub use convert::{camera_to_wire, source_to_wire};
pub use image_encoder::ImageEncoders;
pub use metrics::Metrics;
pub use received_room::{CompleteRoom, ReceivedRoom};
pub use reload::Reload;
pub use room_messages::{MESSAGE_BYTES, RoomPart, RoomParts, Unsendable, room_upload};
pub use seese3_store::Quota;
pub use shutdown::shutdown_signal;
pub use snapshot::{RoomMemory, Snapshot};
pub use status::{Error, Full};
pub use tls::{Tls, TlsError, TlsFiles};
#[cfg(feature = "otlp")]
pub use traces::Traces;
pub use track::TokenKey;

use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use tokio::net::TcpListener;
use tokio::sync::{oneshot, watch};
use tonic::transport::Server;
use tonic::{Request, Response, Status};
use tower::util::MapRequestLayer;
use tower_http::request_id::{PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::trace::TraceLayer;

use auth::{AuthLayer, Principal, RoomScope};
use catalog::Changes;
use connections::Acceptance;
use cost::Costs;
use health::RoomHealth;
use memory::{Memory, MemoryLayer, Responses, respond, with_lease};
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
use shares::Shares;
use snapshot::Loader;
use stated_revisions::StatesRevisions;
use workers::{Lane, Workers};

/// Maximum number of blocking threads that a server may need, of tokio's runtime
/// (`max_blocking_threads`): those of jobs that run, are paused or wait for the disk, and of reads
/// of the store.
pub const MAX_BLOCKING_THREADS: usize = 2_048;
/// Divisor for the memory budget of images that are decoded: 1/4 of the request budget.
const DECODING: usize = 4;
/// Divisor for the memory budget of health watchers: 1/8 of the request budget.
const WATCHERS: usize = 8;
/// Time after draining in which callers can still receive their last responses or errors.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// Configuration and limits of a server.
#[derive(Debug, Clone)]
pub struct Config {
    /// Index for nearest-frame search.
    pub index: IndexKind,
    /// When rooms are loaded into memory, and how much they may hold.
    pub rooms: RoomMemory,
    /// Limits of one request: steps, frames per step (`top_k`), and frames in the whole answer.
    pub limits: Limits,
    /// Encoders for images from callers; `None` if the server accepts no images.
    pub encoders: Option<ImageEncoders>,
    /// Maximum number of requests in one BatchNavigate.
    pub batch: usize,
    /// Maximum number of predictions in one ScorePredictions.
    pub predictions: usize,
    /// Memory budget of all requests in progress together, bytes.
    pub memory_bytes: usize,
    /// Time limit for receiving a request that has one message.
    pub receive_within: Duration,
    /// Idle timeout of a unary response: its connection is closed if the caller receives nothing
    /// for this long.
    pub response_timeout: Duration,
    /// Whether callers may change the catalog.
    pub writable: bool,
    /// Whether callers may get the rooms' images as thumbnails.
    pub thumbnails: bool,
    /// The most that each room may take in the store, with the adapters named after it and
    /// fitted to it.
    pub room_quota: Quota,
    /// Memory budget of all uploads in progress together, bytes.
    pub upload_bytes: usize,
    /// Maximum size of a received message, bytes.
    pub message_bytes: usize,
    /// Worker threads for short requests, and as many for requests with images. Long requests
    /// and evaluations get half as many each, rounded up; fits run one at a time.
    pub threads: usize,
    /// Maximum number of requests that wait for a thread, for each of these kinds; further ones are
    /// refused. Callers share these places.
    pub queue: usize,
    /// Time limit of one request. A caller's deadline can only shorten it.
    pub longest: Duration,
    /// Maximum number of open Track streams, divided between callers; further ones are refused.
    pub streams: usize,
    /// Key that authenticates resume tokens. Servers with the same key accept each other's tokens.
    pub token_key: TokenKey,
    /// Time after the shutdown signal in which requests are still accepted while health reports
    /// NOT_SERVING.
    pub lame_duck: Duration,
    /// Time after `lame_duck` in which requests in flight may finish.
    pub drain: Duration,
    /// When the server checks its store for changes.
    pub reload: Reload,
    /// The server's metrics.
    pub metrics: Metrics,
    /// Maximum number of connections. With `keyring`, callers divide them; otherwise further ones
    /// are closed at once.
    pub connections: usize,
    /// The server's certificate; `None` for plain text.
    pub tls: Option<Arc<Tls>>,
    /// The callers' credentials; `None` to accept any caller.
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
            room_quota: Quota::default(),
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
    #[error("the server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    #[error("cannot build the reflection service: {0}")]
    Reflection(#[source] tonic_reflection::server::Error),
    #[error("loading the store failed: {0}")]
    Loading(#[source] tokio::task::JoinError),
}

/// Listening sockets of a server.
#[derive(Debug)]
pub struct Listeners {
    /// For gRPC.
    pub grpc: TcpListener,
    /// For `/metrics`, `/livez` and `/readyz` over HTTP; `None` disables them.
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

/// Lifecycle phase of the server, read by health and all handlers.
#[derive(Clone)]
enum Phase {
    Loading,
    Serving(Arc<Snapshot>),
    Draining(Arc<Snapshot>),
    /// The shutdown signal came before the store was loaded.
    Stopping,
}

/// State shared by all handlers.
#[derive(Clone)]
struct Handlers {
    phase: watch::Receiver<Phase>,
    workers: Workers,
    config: Arc<Config>,
    /// Places for open Track streams, divided between callers.
    streams: Arc<Shares>,
    /// The store, for downloads and lists of what is not in memory.
    store: Store,
    /// Applies changes of the catalog; `None` if the server is read-only.
    changes: Option<Arc<Changes>>,
}

impl Handlers {
    /// The current snapshot, limited to the rooms that the caller may see.
    fn snapshot<T>(&self, request: &Request<T>) -> Result<Arc<Snapshot>, Error> {
        self.snapshot_for(principal(request).map(|principal| principal.rooms()))
    }

    /// The current snapshot, limited to the rooms of `scope`; `None` for all rooms.
    fn snapshot_for(&self, scope: Option<&RoomScope>) -> Result<Arc<Snapshot>, Error> {
        let snapshot = match &*self.phase.borrow() {
            Phase::Serving(snapshot) | Phase::Draining(snapshot) => snapshot.clone(),
            Phase::Loading | Phase::Stopping => return Err(Error::Loading),
        };

        Ok(match scope.filter(|scope| !scope.is_all()) {
            Some(scope) => Arc::new(snapshot.seen_by(scope)),
            None => snapshot,
        })
    }
}

impl Handlers {
    /// Answers a unary request from the current snapshot. Runs `work` on a worker thread of the
    /// lane, within the caller's deadline.
    async fn unary<Q, A>(
        &self,
        request: Request<Q>,
        lane: impl FnOnce(&Costs<'_>, &Q) -> Lane,
        work: impl FnOnce(&Snapshot, Q, &Cancellation) -> Result<A, Error> + Send + 'static,
    ) -> Result<Response<A>, Status>
    where
        Q: StatesRevisions + Send + 'static,
        A: Message + 'static,
    {
        let snapshot = self.snapshot(&request)?;
        let stated = request.get_ref().stated_revisions()?;
        let context = self.workers.context(&request);
        let request = request.into_inner();
        let costs = Costs {
            snapshot: &snapshot,
            index: self.config.index,
        };
        let lane = lane(&costs, &request);

        let work = move |cancel: &Cancellation| {
            let snapshot = snapshot.with_revisions(&stated)?;
            work(&snapshot, request, cancel)
        };
        respond(self.workers.run(lane, context, with_lease(work)).await?)
    }
}

/// The authenticated caller; `None` if the server has no keyring.
fn principal<T>(request: &Request<T>) -> Option<&Arc<Principal>> {
    request.extensions().get()
}

/// Serves a store until `shutdown` completes. Health checks are answered at once, with NOT_SERVING
/// until the store is loaded.
///
/// # Errors
/// [`RunError`] if the store cannot be read, no room can be served, or the transport fails. A
/// single room or adapter that cannot be served does not stop the server: only its own requests are
/// refused.
pub async fn run(
    listeners: impl Into<Listeners>,
    store: Store,
    config: Config,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), RunError> {
    // All services listen at once and read the phase from this channel. Until the store is loaded,
    // requests are refused with UNAVAILABLE.
    let Listeners { grpc, operations } = listeners.into();
    let (phase, watched) = watch::channel(Phase::Loading);
    let metrics = config.metrics.clone();
    let (stop, stopped) = oneshot::channel::<()>();
    let workers = Workers::new(&config);
    let (reload_handle, reload_requests) = ReloadHandle::new();
    let changes = Changes::new(store.clone(), watched.clone(), reload_handle, &config);

    let handlers = Handlers {
        phase: watched.clone(),
        workers: workers.clone(),
        config: Arc::new(config.clone()),
        streams: Shares::new(config.streams),
        store: store.clone(),
        changes: config.writable.then(|| Arc::new(changes)),
    };
    let answering = server(handlers, watched.clone(), grpc, async {
        // An error means that `run` was dropped; the server must stop then too.
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

    // Poll the server while the store loads, so that health checks are answered.
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

    metrics.index(config.index);
    metrics.serving(first.counts());

    // Requests are answered from here on, until the shutdown signal or a failure of the server.
    phase.send_replace(Phase::Serving(Arc::new(first)));

    tokio::select! {
        ended = &mut server => return ended,
        () = &mut shutdown => {}
        () = reload::keep_current(loader, config.reload, reload_requests, config.writable, &phase, &metrics) => {}
    }

    tracing::info!(bound_s = config.drain.as_secs_f64(), "draining");

    // Health changes to NOT_SERVING and open Track streams end: load balancers and robots move to
    // another server while short requests finish here.
    phase.send_modify(|phase| {
        if let Phase::Serving(snapshot) = phase {
            *phase = Phase::Draining(snapshot.clone());
        }
    });

    // Load balancers still send requests here until they notice.
    if let Ok(ended) = tokio::time::timeout(config.lame_duck, &mut server).await {
        return ended;
    }

    // `send` fails if the server has already ended.
    let _ = stop.send(());
    drained(server, config.drain, &workers, &metrics).await
}

/// Waits for a stopping server to end, at most `bound` plus [`LAST_WORDS`].
async fn drained(
    mut server: Pin<&mut impl Future<Output = Result<(), RunError>>>,
    bound: Duration,
    workers: &Workers,
    metrics: &Metrics,
) -> Result<(), RunError> {
    tokio::select! {
        ended = &mut server => return ended,
        // Idle connections without a request are not waited for.
        () = idle(metrics) => {}
        () = tokio::time::sleep(bound) => {
            tracing::warn!("drain timeout passed; requests in flight are abandoned");
            workers.halt();
        }
    }

    // Give callers time to read their last responses; abandoned requests end with UNAVAILABLE.
    tokio::time::timeout(LAST_WORDS, server)
        .await
        .unwrap_or(Ok(()))
}

/// Completes when no request is in flight.
async fn idle(metrics: &Metrics) {
    while metrics.in_flight() > 0 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Reloads changed certificate and credential files; never completes.
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

/// Serves metrics and probes if there is a listener for them; never completes.
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
        "Memory accounted to requests in progress, bytes",
        move || counted.held() as u64,
    );

    MemoryLayer {
        memory,
        message_bytes: config.message_bytes,
        receive_within: config.receive_within,
        responses: Responses::watched(config.response_timeout),
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

    let has_credentials = keyring.is_some();
    let room_health = match &keyring {
        Some(_) => RoomHealth::Hidden,
        None => RoomHealth::Shown,
    };

    // Offer reflection in both versions: some clients support only v1alpha.
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let failed = RunError::Reflection;
    let v1 = reflection().build_v1().map_err(failed)?;
    let v1alpha = reflection().build_v1alpha().map_err(failed)?;

    // Keep-alive pings detect clients that vanished without closing their connection. Closing it
    // cancels their requests.
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

    let acceptance = Acceptance {
        most: connections,
        has_credentials,
        tls,
        metrics,
    };
    let incoming = connections::incoming(listener, acceptance);
    Ok(async move {
        Ok(router
            .serve_with_incoming_shutdown(incoming, stopped)
            .await?)
    })
}

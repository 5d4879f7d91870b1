//! `seese3 serve`: the gRPC server, until SIGTERM or Ctrl-C.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{ArgAction, Args, ValueEnum};
use tokio::net::TcpListener;
use tokio::sync::Notify;

use super::encoder::ModelRuntime;
use super::log::{LogFormat, Traces, start_log};
use super::output::say;
use seese3_core::navigation::{IndexKind, Limits};
use seese3_encoder::Bounds;
use seese3_server::{
    Config, ImageEncoders, Keyring, Listeners, Quota, Reload, RoomMemory, Tls, TlsFiles, TokenKey,
    run, shutdown_signal,
};
use seese3_store::{ObjectCache, Store};

#[derive(Debug, Args)]
pub struct Serve {
    /// TOML file of settings, each named as its flag without the dashes; flags and environment
    /// variables override it
    #[arg(long, value_name = "FILE", env = "SEESE3_CONFIG")]
    config: Option<PathBuf>,
    /// The store to serve: a folder, or a URL of a bucket (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// Cache folder for objects read from a bucket; servers of one machine can share it; none if omitted
    #[arg(long, value_name = "FOLDER", env = "SEESE3_STORE_CACHE")]
    store_cache: Option<PathBuf>,
    /// Maximum size of the cache, bytes; least recently used objects are evicted
    #[arg(long, value_name = "BYTES", env = "SEESE3_STORE_CACHE_BYTES", default_value_t = 10 << 30, requires = "store_cache")]
    store_cache_bytes: u64,
    /// Address to listen on, HOST:PORT; port 0 takes a free port
    #[arg(long, env = "SEESE3_LISTEN", default_value = "127.0.0.1:50051")]
    listen: String,
    /// Address of the operations endpoint, HOST:PORT: /metrics for Prometheus, /livez and /readyz,
    /// over plain HTTP without authentication; none if omitted
    #[arg(long, value_name = "ADDR", env = "SEESE3_METRICS_LISTEN")]
    metrics_listen: Option<String>,
    /// TOML file with the callers and their permissions; without it, any caller may call everything
    #[arg(long, value_name = "FILE", env = "SEESE3_AUTH_FILE")]
    auth_file: Option<PathBuf>,
    /// Certificate chain of the server, PEM; connections are unencrypted if omitted
    #[arg(
        long,
        value_name = "FILE",
        env = "SEESE3_TLS_CERT",
        requires = "tls_key"
    )]
    tls_cert: Option<PathBuf>,
    /// Private key of the certificate, PEM
    #[arg(
        long,
        value_name = "FILE",
        env = "SEESE3_TLS_KEY",
        requires = "tls_cert"
    )]
    tls_key: Option<PathBuf>,
    /// Certificate authorities of clients, PEM: only clients with a certificate from one of them
    /// may connect
    #[arg(
        long,
        value_name = "FILE",
        env = "SEESE3_TLS_CLIENT_CA",
        requires = "tls_cert"
    )]
    tls_client_ca: Option<PathBuf>,
    /// Maximum number of connections, 1 to 1000000; with --auth-file, callers divide them,
    /// otherwise further ones are closed at once
    #[arg(long, env = "SEESE3_MAX_CONNECTIONS", default_value_t = Config::default().connections, value_parser = bounded(1, 1_000_000))]
    max_connections: usize,
    /// Index for the nearest-frame search
    #[arg(long, env = "SEESE3_INDEX", value_enum, default_value_t = IndexName::Exact)]
    index: IndexName,
    /// Load and verify every room before it is served. With `false`, load a room on its first
    /// request: startup is faster, but a damaged room is detected late
    #[arg(long, env = "SEESE3_PRELOAD", default_value_t = RoomMemory::default().preload, default_missing_value = "true", num_args = 0..=1, action = ArgAction::Set)]
    preload: bool,
    /// Approximate memory limit of all loaded rooms, 1048576 to 1099511627776 bytes. Beyond it, the
    /// least recently used room is unloaded until its next request; rooms in use by a stream stay.
    /// No limit if omitted
    #[arg(long, env = "SEESE3_MAX_ROOM_BYTES", value_parser = bounded(1 << 20, 1 << 40))]
    max_room_bytes: Option<usize>,
    /// Also accept images instead of features, encoded by these models: `builtin`, `pixels`, or the
    /// ONNX files of the adapters' features, separated by commas; none if omitted
    #[arg(
        long = "encoder",
        value_name = "MODEL",
        env = "SEESE3_ENCODER",
        value_delimiter = ','
    )]
    encoders: Vec<String>,
    #[command(flatten)]
    models: ModelRuntime,
    /// Maximum size of an image, 1 to 1000000000 pixels after decoding
    #[arg(long, env = "SEESE3_MAX_IMAGE_PIXELS", default_value_t = 16_000_000, value_parser = clap::value_parser!(u64).range(1..=1_000_000_000))]
    max_image_pixels: u64,
    /// Maximum number of pixels of all images of one request, 1 to 1000000000000
    #[arg(long, env = "SEESE3_MAX_REQUEST_PIXELS", default_value_t = ImageEncoders::REQUEST_PIXELS, value_parser = clap::value_parser!(u64).range(1..=1_000_000_000_000))]
    max_request_pixels: u64,
    /// Maximum number of steps in one navigation; requests beyond it are refused; at least 1
    #[arg(long, env = "SEESE3_MAX_STEPS", default_value_t = Limits::default().steps, value_parser = clap::value_parser!(u32).range(1..))]
    max_steps: u32,
    /// Maximum number of frames returned for one step or one localization; requests beyond it are
    /// refused; at least 1
    #[arg(long, env = "SEESE3_MAX_TOP_K", default_value_t = Limits::default().top_k, value_parser = clap::value_parser!(u32).range(1..))]
    max_top_k: u32,
    /// Maximum number of frames in one answer (steps times frames per step); requests beyond it are
    /// refused; at least 1
    #[arg(long, env = "SEESE3_MAX_FRAMES_IN_ANSWER", default_value_t = Limits::default().frames_in_answer, value_parser = clap::value_parser!(u64).range(1..))]
    max_frames_in_answer: u64,
    /// Memory limit of all requests in progress, 16777216 to 1099511627776 bytes: received data,
    /// decoded data and unsent answers. Requests beyond it are refused
    #[arg(long, env = "SEESE3_MAX_MEMORY_BYTES", default_value_t = Config::default().memory_bytes, value_parser = bounded(16 << 20, 1 << 40))]
    max_memory_bytes: usize,
    /// Allow callers to change the catalog: upload and remove rooms and adapters, fit adapters, set
    /// defaults. With --auth-file, only callers with the verb "write" may
    #[arg(long, env = "SEESE3_WRITABLE")]
    writable: bool,
    /// Allow callers that list a room's frames to also get its images, as thumbnails of at most 512
    /// pixels in width. Images are read from the room's original folder
    #[arg(long, env = "SEESE3_THUMBNAILS")]
    thumbnails: bool,
    /// Maximum number of stored revisions of a room, with the adapters named after it and fitted to
    /// it; no limit if omitted; at least 1
    #[arg(long, env = "SEESE3_MAX_STORED_REVISIONS", value_parser = clap::value_parser!(u64).range(1..))]
    max_stored_revisions: Option<u64>,
    /// Size in the store of a room, with the adapters named after it and fitted to it, bytes, from
    /// which on publications are refused; no limit if omitted; at least 1
    #[arg(long, env = "SEESE3_MAX_STORED_BYTES", value_parser = clap::value_parser!(u64).range(1..))]
    max_stored_bytes: Option<u64>,
    /// Memory limit of all uploads in progress, 1048576 to 1099511627776 bytes
    #[arg(long, env = "SEESE3_MAX_UPLOAD_BYTES", default_value_t = Config::default().upload_bytes, value_parser = bounded(1 << 20, 1 << 40))]
    max_upload_bytes: usize,
    /// Maximum size of a message from a client, 1024 to 1073741824 bytes; also limits an encoded
    /// image
    #[arg(long, env = "SEESE3_MAX_MESSAGE_BYTES", default_value_t = Config::default().message_bytes, value_parser = bounded(1_024, 1 << 30))]
    max_message_bytes: usize,
    /// Time limit of a request, seconds, 1 to 86400; a client's deadline can only shorten it. An
    /// open tracking stream has no time limit
    #[arg(long, env = "SEESE3_MAX_REQUEST_SECONDS", default_value_t = Config::default().longest.as_secs(), value_parser = clap::value_parser!(u64).range(1..=86_400))]
    max_request_seconds: u64,
    /// Lame-duck time, seconds, 0 to 86400: after SIGTERM or Ctrl-C, requests are still accepted
    /// while health reports NOT_SERVING, so that load balancers notice first
    #[arg(long, env = "SEESE3_LAME_DUCK_SECONDS", default_value_t = Config::default().lame_duck.as_secs(), value_parser = clap::value_parser!(u64).range(0..=86_400))]
    lame_duck_seconds: u64,
    /// Drain time, seconds, 0 to 86400: after the lame-duck time, running requests may finish for
    /// this long
    #[arg(long, env = "SEESE3_DRAIN_SECONDS", default_value_t = Config::default().drain.as_secs(), value_parser = clap::value_parser!(u64).range(0..=86_400))]
    drain_seconds: u64,
    /// Interval at which the store is checked for new revisions, seconds, 0 to 86400; they are
    /// served without a restart. With 0, only SIGHUP triggers a check. SIGHUP also retries the
    /// revisions that were refused
    #[arg(long, env = "SEESE3_RELOAD_SECONDS", default_value_t = Config::default().reload.every.map_or(0, |every| every.as_secs()), value_parser = clap::value_parser!(u64).range(0..=86_400))]
    reload_seconds: u64,
    /// Maximum number of concurrent tracking streams, 1 to 1000000; further ones are refused
    #[arg(long, env = "SEESE3_MAX_STREAMS", default_value_t = Config::default().streams, value_parser = bounded(1, 1_000_000))]
    max_streams: usize,
    /// File with a secret of at least 16 bytes that signs the resume tokens of tracking streams.
    /// Servers with the same secret can resume each other's streams. If omitted, the key is random,
    /// and tokens are invalid after the server stops
    #[arg(long, value_name = "FILE", env = "SEESE3_TOKEN_KEY_FILE")]
    token_key_file: Option<PathBuf>,
    /// Threads for short requests, and as many for requests with one or two images, 1 to 1024. Long
    /// requests and evaluations get half as many each, rounded up; fits have one. Also the number
    /// of threads of an onnxruntime session. The number of cores if omitted
    #[arg(long, env = "SEESE3_THREADS", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Maximum number of waiting requests of each of these kinds, 0 to 1000000; further ones are
    /// refused
    #[arg(long, env = "SEESE3_QUEUE", default_value_t = Config::default().queue, value_parser = bounded(0, 1_000_000))]
    queue: usize,
    /// Format of the log, which goes to standard error; RUST_LOG filters it
    #[arg(long, env = "SEESE3_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
    /// Export request spans to the OpenTelemetry collector at this address, for example
    /// http://127.0.0.1:4317 (OTLP over gRPC, plain text). Needs a build with the feature `otlp`
    #[arg(long, value_name = "URL", env = "SEESE3_OTLP_ENDPOINT")]
    otlp_endpoint: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum IndexName {
    /// Exact: the distance to every frame is computed
    Exact,
    /// Approximate HNSW graph (crate hnsw_rs), for rooms of 100,000 frames and more
    Hnsw,
}

impl IndexName {
    fn kind(self) -> anyhow::Result<IndexKind> {
        match self {
            Self::Exact => Ok(IndexKind::Exact),
            #[cfg(feature = "hnsw")]
            Self::Hnsw => Ok(IndexKind::Hnsw(
                seese3_core::index::HnswParameters::default(),
            )),
            #[cfg(not(feature = "hnsw"))]
            Self::Hnsw => Err(super::output::not_built("--index hnsw", "hnsw")),
        }
    }
}

/// Parses a count that must lie in a range.
fn bounded(least: u64, most: u64) -> clap::builder::RangedU64ValueParser<usize> {
    clap::builder::RangedU64ValueParser::new().range(least..=most)
}

impl Serve {
    pub async fn run(self) -> anyhow::Result<()> {
        let traces = self.traces()?;
        let log = start_log(self.log_format, traces.as_ref());
        let store = self.opened_store()?;
        let config = self.server_config()?;
        let losses = log.losses();
        config.metrics.count_elsewhere(
            "log_lines_lost",
            "Log lines that could not be written",
            move || losses.count(),
        );

        // The port is opened before the store is loaded: health checks are answered at once,
        // NOT_SERVING until everything is loaded.
        let grpc = listener(&self.listen, "listening").await?;
        let operations = match &self.metrics_listen {
            None => None,
            Some(address) => {
                let opened = listener(address, "metrics").await;
                Some(opened.context("--metrics-listen")?)
            }
        };
        let listeners = Listeners { grpc, operations };
        if self.writable {
            store.check_conditional_writes().await?;
        }

        let (asked, again) = tokio::sync::oneshot::channel();
        let stopping = async move {
            shutdown_signal().await;
            // An error means that the server ended by itself.
            let _ = asked.send(());
        };
        let signaled_twice = async move {
            match again.await {
                Ok(()) => shutdown_signal().await,
                Err(_) => std::future::pending().await,
            }
        };

        tokio::select! {
            ended = run(listeners, store, config, stopping) => ended?,
            // A second signal skips the wait for requests in flight.
            () = signaled_twice => bail!("received a second signal: requests in flight were aborted"),
        }

        match log.losses().count() {
            0 => say("stopped"),
            lost => say(format_args!("stopped; {lost} lines of the log were lost")),
        }

        Ok(())
    }
}

/// Opens a port and prints its address: with port 0 the system chooses it, and scripts read it from
/// this line.
async fn listener(address: &str, what: &str) -> anyhow::Result<TcpListener> {
    let listener = TcpListener::bind(address)
        .await
        .with_context(|| format!("cannot listen on {address}"))?;
    let address = listener
        .local_addr()
        .context("the listener has no address")?;

    say(format_args!("{what} on {address}"));
    Ok(listener)
}

/// File descriptors reserved for the store, the log and the listeners.
const FILES_KEPT: u64 = 128;

/// The requested number of connections, capped by the limit of open files. That limit is first
/// raised to its maximum: its default is too low for one server.
fn connections_within_file_limit(asked: usize) -> usize {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

        let limit = getrlimit(Resource::Nofile);
        let raised = Rlimit {
            current: limit.maximum,
            maximum: limit.maximum,
        };

        // If it cannot be raised, the current limit applies.
        let now = match setrlimit(Resource::Nofile, raised) {
            Ok(()) => limit.maximum,
            Err(_) => limit.current,
        };
        let Some(files) = now else {
            return asked;
        };

        let possible = usize::try_from(files.saturating_sub(FILES_KEPT)).unwrap_or(usize::MAX);
        if possible < asked {
            tracing::warn!(
                asked,
                possible,
                "connection limit lowered: raise the limit of open files (LimitNOFILE, ulimit -n)"
            );
        }
        asked.min(possible.max(1))
    }

    #[cfg(not(unix))]
    asked
}

/// Notified whenever the process gets SIGHUP.
fn reload_on_hangup() -> Arc<Notify> {
    let asked = Arc::new(Notify::new());

    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};

        let asked = asked.clone();
        tokio::spawn(async move {
            // Without the handler, the server still checks the store periodically.
            let Ok(mut hangup) = signal(SignalKind::hangup()) else {
                return;
            };
            while hangup.recv().await.is_some() {
                asked.notify_one();
            }
        });
    }

    asked
}

impl Serve {
    /// Makes the checks that `serve` makes before it opens its port.
    pub fn check(&self) -> anyhow::Result<()> {
        self.store_without_cache()?;
        self.server_config().map(drop)
    }

    fn opened_store(&self) -> anyhow::Result<Store> {
        let store = self.store_without_cache()?;
        Ok(match &self.store_cache {
            None => store,
            Some(folder) => {
                let cache = ObjectCache::open(folder, self.store_cache_bytes);
                store.with_cache(cache.context("--store-cache")?)
            }
        })
    }

    fn store_without_cache(&self) -> anyhow::Result<Store> {
        let store = Store::open(&self.store)?;
        if self.store_cache.is_some() && !store.is_bucket() {
            bail!(
                "--store-cache is for a store in a bucket; leave it out: '{}' is a folder",
                self.store
            );
        }
        Ok(store)
    }

    fn server_config(&self) -> anyhow::Result<Config> {
        let defaults = Config::default();

        // One number limits the threads of each kind of requests and of an onnxruntime session.
        let threads = self.threads.map_or(defaults.threads, usize::from);

        Ok(Config {
            index: self.index.kind()?,
            rooms: RoomMemory {
                preload: self.preload,
                bytes: self.max_room_bytes,
            },
            encoders: (!self.encoders.is_empty()).then(|| {
                ImageEncoders {
                    models: self.encoders.clone(),
                    runtime: self.models.with_threads(threads),
                    bounds: Bounds {
                        // An image is part of one message, so it cannot be larger.
                        bytes: self.max_message_bytes as u64,
                        pixels: self.max_image_pixels,
                    },
                    request_pixels: self.max_request_pixels,
                }
            }),
            limits: Limits {
                steps: self.max_steps,
                top_k: self.max_top_k,
                frames_in_answer: self.max_frames_in_answer,
            },
            memory_bytes: self.max_memory_bytes,
            writable: self.writable,
            thumbnails: self.thumbnails,
            room_quota: Quota {
                revisions: self.max_stored_revisions,
                bytes: self.max_stored_bytes,
            },
            upload_bytes: self.max_upload_bytes,
            message_bytes: self.max_message_bytes,
            threads,
            queue: self.queue,
            longest: Duration::from_secs(self.max_request_seconds),
            streams: self.max_streams,
            token_key: self.token_key()?,
            lame_duck: Duration::from_secs(self.lame_duck_seconds),
            drain: Duration::from_secs(self.drain_seconds),
            connections: connections_within_file_limit(self.max_connections),
            tls: self.tls()?.map(Arc::new),
            keyring: self.keyring()?.map(Arc::new),
            reload: Reload {
                every: (self.reload_seconds > 0).then(|| Duration::from_secs(self.reload_seconds)),
                requested: reload_on_hangup(),
            },
            ..defaults
        })
    }

    #[cfg(feature = "otlp")]
    fn traces(&self) -> anyhow::Result<Option<Traces>> {
        let Some(endpoint) = &self.otlp_endpoint else {
            return Ok(None);
        };
        let traces = Traces::open(endpoint);
        traces
            .map(Some)
            .map_err(|problem| anyhow::anyhow!("--otlp-endpoint {endpoint}: {problem}"))
    }

    #[cfg(not(feature = "otlp"))]
    fn traces(&self) -> anyhow::Result<Option<Traces>> {
        match &self.otlp_endpoint {
            None => Ok(None),
            Some(_) => Err(super::output::not_built("--otlp-endpoint", "otlp")),
        }
    }

    fn tls(&self) -> anyhow::Result<Option<Tls>> {
        // Values of the configuration file are clap defaults, to which the `requires` rules do not
        // apply.
        let (cert, key) = match (&self.tls_cert, &self.tls_key) {
            (Some(cert), Some(key)) => (cert, key),
            (None, None) if self.tls_client_ca.is_none() => return Ok(None),
            _ => bail!("give --tls-cert and --tls-key together; --tls-client-ca needs both"),
        };
        let files = TlsFiles {
            cert: cert.clone(),
            key: key.clone(),
            client_ca: self.tls_client_ca.clone(),
        };

        Ok(Some(Tls::open(files)?))
    }

    fn keyring(&self) -> anyhow::Result<Option<Keyring>> {
        let Some(file) = &self.auth_file else {
            return Ok(None);
        };
        if self.tls_cert.is_none() {
            tracing::warn!(
                "tokens are sent unencrypted: give --tls-cert, or listen on loopback behind a proxy"
            );
        }

        Ok(Some(Keyring::open(file.clone())?))
    }

    fn token_key(&self) -> anyhow::Result<TokenKey> {
        let Some(file) = &self.token_key_file else {
            return Ok(TokenKey::random());
        };
        let secret = seese3_files::read(file, seese3_files::SMALL_FILE_BYTES)
            .with_context(|| format!("--token-key-file: {} cannot be read", file.display()))?;

        TokenKey::new(&secret)
            .map_err(|problem| anyhow::anyhow!("--token-key-file: {} {problem}", file.display()))
    }
}

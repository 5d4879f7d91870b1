//! `seese3 serve`: answer over gRPC until told to stop.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::{Args, ValueEnum};
use tokio::net::TcpListener;

use super::encoder::RuntimeName;
use super::say;
use crate::encoder::{Bounds, Runtime};
use crate::index::HnswParameters;
use crate::navigation::{IndexKind, Limits};
use crate::service::{Config, ImageEncoders, TokenKey, run, shutdown_signal};
use crate::store::Store;

#[derive(Debug, Args)]
pub struct Serve {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// Where to listen; port 0 takes a free one
    #[arg(long, env = "SEESE3_LISTEN", default_value = "127.0.0.1:50051")]
    listen: String,
    /// How frames are searched
    #[arg(long, env = "SEESE3_INDEX", value_enum, default_value_t = IndexName::Exact)]
    index: IndexName,
    /// Take images instead of features: `builtin`, `pixels`, or the ONNX file that an adapter's
    /// features were made by; several are divided by commas
    #[arg(
        long = "encoder",
        value_name = "MODEL",
        env = "SEESE3_ENCODER",
        value_delimiter = ','
    )]
    encoders: Vec<String>,
    /// What runs ONNX models: tract needs nothing, onnxruntime is faster
    #[arg(long, env = "SEESE3_RUNTIME", value_enum, default_value_t = RuntimeName::Tract)]
    runtime: RuntimeName,
    /// The shared library of onnxruntime
    #[arg(long = "onnxruntime", value_name = "FILE", env = "ORT_DYLIB_PATH")]
    library: Option<std::path::PathBuf>,
    /// The most pixels of an image that is sent
    #[arg(long, env = "SEESE3_MAX_IMAGE_PIXELS", default_value_t = 16_000_000)]
    max_image_pixels: u64,
    /// The most steps of one navigation
    #[arg(long, env = "SEESE3_MAX_STEPS", default_value_t = Limits::default().steps)]
    max_steps: u32,
    /// The most frames of one step or localisation
    #[arg(long, env = "SEESE3_MAX_HITS", default_value_t = Limits::default().hits)]
    max_hits: u32,
    /// The most frames of one answer
    #[arg(long, env = "SEESE3_MAX_HITS_IN_ALL", default_value_t = Limits::default().hits_in_all)]
    max_hits_in_all: u64,
    /// The largest message that is read, bytes
    #[arg(long, env = "SEESE3_MAX_MESSAGE_BYTES", default_value_t = Config::default().message_bytes)]
    max_message_bytes: usize,
    /// The longest a request may take, seconds
    #[arg(long, env = "SEESE3_MAX_REQUEST_SECONDS", default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    max_request_seconds: u64,
    /// How long requests in flight may go on after SIGTERM, seconds
    #[arg(long, env = "SEESE3_DRAIN_SECONDS", default_value_t = 10, value_parser = clap::value_parser!(u64).range(0..=86_400))]
    drain_seconds: u64,
    /// Cameras that are followed at a time
    #[arg(long, env = "SEESE3_MAX_STREAMS", default_value_t = Config::default().streams)]
    max_streams: usize,
    /// A file whose bytes, 16 or more, seal resume tokens: servers that share it go on with one
    /// another's streams; without one they end with the server
    #[arg(long, value_name = "FILE", env = "SEESE3_TOKEN_KEY_FILE")]
    token_key_file: Option<PathBuf>,
    /// Requests computed at a time; the machine's cores if not given
    #[arg(long, env = "SEESE3_THREADS", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Requests that may wait for a thread
    #[arg(long, env = "SEESE3_QUEUE", default_value_t = 1_024, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    queue: u32,
    /// How the log is written, to standard error; RUST_LOG chooses what
    #[arg(long, env = "SEESE3_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum IndexName {
    /// Every frame is looked at
    Exact,
    /// The approximate graph of hnsw_rs, for rooms of 100,000 frames and more
    Hnsw,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

impl Serve {
    pub async fn run(self) -> anyhow::Result<()> {
        start_log(self.log_format);
        let store = Store::open(&self.store)?;
        let defaults = Config::default();
        let threads = self.threads.map_or(defaults.threads, usize::from);

        let config = Config {
            index: match self.index {
                IndexName::Exact => IndexKind::Exact,
                IndexName::Hnsw => IndexKind::Hnsw(HnswParameters::default()),
            },
            encoders: (!self.encoders.is_empty()).then(|| ImageEncoders {
                models: self.encoders.clone(),
                runtime: Runtime {
                    kind: self.runtime.into(),
                    threads,
                    library: self.library.clone(),
                },
                bounds: Bounds {
                    bytes: self.max_message_bytes as u64,
                    pixels: self.max_image_pixels,
                },
            }),
            limits: Limits {
                steps: self.max_steps,
                hits: self.max_hits,
                hits_in_all: self.max_hits_in_all,
            },
            message_bytes: self.max_message_bytes,
            threads,
            queue: self.queue as usize,
            longest: Duration::from_secs(self.max_request_seconds),
            streams: self.max_streams,
            token_key: self.token_key()?,
            drain: Duration::from_secs(self.drain_seconds),
            ..defaults
        };

        let listener = TcpListener::bind(&self.listen)
            .await
            .with_context(|| format!("cannot listen on {}", self.listen))?;
        let address = listener
            .local_addr()
            .context("the listener has no address")?;
        say(format_args!("listening on {address}"));

        run(listener, store, config, shutdown_signal()).await?;
        say("stopped");

        Ok(())
    }
}

impl Serve {
    fn token_key(&self) -> anyhow::Result<TokenKey> {
        let Some(file) = &self.token_key_file else {
            return Ok(TokenKey::random());
        };
        let secret = std::fs::read(file)
            .with_context(|| format!("--token-key-file: {} cannot be read", file.display()))?;

        TokenKey::new(&secret)
            .map_err(|problem| anyhow::anyhow!("--token-key-file: {} {problem}", file.display()))
    }
}

fn start_log(format: LogFormat) {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info,hnsw_rs=warn"));
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());

    match format {
        LogFormat::Text => log.init(),
        LogFormat::Json => log.json().flatten_event(true).init(),
    }
}

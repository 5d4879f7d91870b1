//! The log of a server, on standard error.
//!
//! A log may be on a full disk, or in a pipe that nobody reads. Neither may hold up or fail a
//! request: lines go to a thread of their own, and those that cannot be written are dropped and
//! counted.

use std::io::{self, IsTerminal, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use clap::ValueEnum;
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::Layer;
use tracing_subscriber::fmt::format::FmtSpan;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// How many lines may wait to be written; further ones are dropped.
const WAITING_LINES: usize = 8_192;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

/// A started log. Dropping it writes the lines that wait, for at most about a second.
pub struct Log {
    losses: LogLosses,
    _writer: WorkerGuard,
}

impl Log {
    /// Counts the lines that were lost.
    pub fn losses(&self) -> LogLosses {
        self.losses.clone()
    }
}

/// Counts the lines that could not be written.
#[derive(Clone)]
pub struct LogLosses {
    /// Lines for which there was no place to wait.
    overflowed: ErrorCounter,
    /// Lines that the system refused to write.
    failed: Arc<AtomicU64>,
}

impl LogLosses {
    /// The number of lines lost so far.
    pub fn count(&self) -> u64 {
        self.overflowed.dropped_lines() as u64 + self.failed.load(Ordering::Relaxed)
    }
}

/// Where spans of requests go besides the log; in a build without the feature `otlp`, nowhere.
#[cfg(feature = "otlp")]
pub use seese3_server::Traces;
/// Where spans of requests go besides the log; in a build without the feature `otlp`, nowhere.
#[cfg(not(feature = "otlp"))]
pub enum Traces {}

/// Starts the log of this process. RUST_LOG sets what is logged, but not what is exported.
pub fn start_log(format: LogFormat, traces: Option<&Traces>) -> Log {
    let failed = Arc::new(AtomicU64::new(0));
    let writer = Forgiving {
        inner: io::stderr(),
        failed: failed.clone(),
    };
    let (writer, guard) = NonBlockingBuilder::default()
        .buffered_lines_limit(WAITING_LINES)
        .lossy(true)
        .thread_name("log")
        .finish(writer);
    let losses = LogLosses {
        overflowed: writer.error_counter(),
        failed,
    };

    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| {
        EnvFilter::new("info,hnsw_rs=warn,opentelemetry=warn,opentelemetry_sdk=warn")
    });
    // As no-color.org asks: any text in NO_COLOR means none.
    let no_colour = std::env::var_os("NO_COLOR").is_some_and(|set| !set.is_empty());
    let is_coloured = io::stderr().is_terminal() && !no_colour;
    let log = tracing_subscriber::fmt::layer()
        // A request is logged once, when its span closes.
        .with_span_events(FmtSpan::CLOSE)
        .with_writer(writer)
        .with_ansi(is_coloured)
        // It would print to standard error, and panic where that cannot be written.
        .log_internal_errors(false);
    let log = match format {
        LogFormat::Text => log.with_filter(filter).boxed(),
        LogFormat::Json => log.json().flatten_event(true).with_filter(filter).boxed(),
    };

    let subscriber = tracing_subscriber::registry().with(log);
    #[cfg(feature = "otlp")]
    subscriber.with(traces.map(Traces::layer)).init();
    #[cfg(not(feature = "otlp"))]
    {
        // There is none in this build.
        let _ = traces;
        subscriber.init();
    }

    Log {
        losses,
        _writer: guard,
    }
}

/// Counts failed writes and reports them as successful, so that the writing thread goes on.
struct Forgiving<W> {
    inner: W,
    failed: Arc<AtomicU64>,
}

impl<W: Write> Write for Forgiving<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.inner.write_all(bytes).is_err() {
            self.failed.fetch_add(1, Ordering::Relaxed);
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        // What could not be flushed was counted when it was written.
        let _ = self.inner.flush();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Full;

    impl Write for Full {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::StorageFull.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Err(io::ErrorKind::StorageFull.into())
        }
    }

    /// Oracle: the promise: a line that cannot be written is counted, and is no error.
    #[test]
    fn a_line_that_cannot_be_written_is_counted() {
        let failed = Arc::new(AtomicU64::new(0));
        let mut writer = Forgiving {
            inner: Full,
            failed: failed.clone(),
        };

        writer.write_all(b"one\n").unwrap();
        writer.write_all(b"two\n").unwrap();
        writer.flush().unwrap();
        assert_eq!(failed.load(Ordering::Relaxed), 2);
    }
}

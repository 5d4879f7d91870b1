//! The log of a server, on standard error.
//!
//! A full disk or a blocked pipe must neither delay nor fail a request. A separate thread writes
//! the lines; lines that cannot be written are dropped and counted.

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

/// Capacity of the queue of unwritten lines; further lines are dropped.
const WAITING_LINES: usize = 8_192;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

/// A running log. Dropping it writes the queued lines, within about a second.
pub struct Log {
    losses: LogLosses,
    _writer: WorkerGuard,
}

impl Log {
    /// The counter of lost lines.
    pub fn losses(&self) -> LogLosses {
        self.losses.clone()
    }
}

/// Counter of lines that could not be written.
#[derive(Clone)]
pub struct LogLosses {
    /// Lines dropped because the queue was full.
    overflowed: ErrorCounter,
    /// Lines lost to a failed write.
    failed: Arc<AtomicU64>,
}

impl LogLosses {
    /// The number of lines lost so far.
    pub fn count(&self) -> u64 {
        self.overflowed.dropped_lines() as u64 + self.failed.load(Ordering::Relaxed)
    }
}

/// Exporter of request spans to OpenTelemetry.
#[cfg(feature = "otlp")]
pub use seese3_server::Traces;
/// Has no values: this build lacks the feature `otlp`.
#[cfg(not(feature = "otlp"))]
pub enum Traces {}

/// Starts the log of this process. RUST_LOG filters the log, not the exported traces.
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
        // The server logs failed exports itself, once. OpenTelemetry would log each, with text of
        // the collector of any length.
        EnvFilter::new("info,hnsw_rs=warn,opentelemetry=off,opentelemetry_sdk=off,opentelemetry-otlp=off,opentelemetry_otlp=off")
    });
    // As no-color.org specifies, any non-empty NO_COLOR turns colors off.
    let no_color = std::env::var_os("NO_COLOR").is_some_and(|set| !set.is_empty());
    let is_colored = io::stderr().is_terminal() && !no_color;
    let log = tracing_subscriber::fmt::layer()
        // A request is logged once, when its span closes.
        .with_span_events(FmtSpan::CLOSE)
        .with_writer(writer)
        .with_ansi(is_colored)
        // Internal errors would be printed to standard error, which panics if that cannot be
        // written.
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
        // `Traces` has no values in this build.
        let _ = traces;
        subscriber.init();
    }

    Log {
        losses,
        _writer: guard,
    }
}

/// Counts failed writes and reports them as successful, so that the writing thread continues.
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
        // Lines that fail to flush were already counted as failed writes.
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

    /// Oracle: the specification: a line that cannot be written is counted and causes no error.
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

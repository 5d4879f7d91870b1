//! Exports request spans to an OpenTelemetry collector (OTLP over gRPC).
//!
//! A request with `traceparent` (W3C Trace Context) joins the caller's trace, and is exported if
//! that trace is sampled. Any other request starts a new trace. A background thread sends spans
//! from a bounded queue, so a slow or absent collector does not delay requests.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use http::HeaderMap;
use opentelemetry::KeyValue;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::{Status, TracerProvider};
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{
    Sampler, SdkTracer, SdkTracerProvider, SpanData, SpanExporter as ExportSpans,
};
use tonic::Code;
use tracing::{Span, Subscriber};
use tracing_opentelemetry::{OpenTelemetryLayer, OpenTelemetrySpanExt};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{FilterExt, LevelFilter, filter_fn};
use tracing_subscriber::registry::LookupSpan;

use super::status::brief;

/// Timeout of one export, and of the last export at shutdown.
const EXPORT: Duration = Duration::from_secs(5);

/// Maximum length of a caller's trace header, bytes. W3C Trace Context asks for 512 of
/// `tracestate`; a longer one is left out.
const LONGEST_HEADER: usize = 512;

/// A span exporter. Dropping it sends the queued spans.
#[derive(Debug)]
pub struct Traces(SdkTracerProvider);

impl Traces {
    /// An exporter to the collector at `endpoint`, such as `http://127.0.0.1:4317`. The collector
    /// need not be reachable yet. Must be called in a multi-threaded async runtime.
    ///
    /// # Errors
    /// A message if the endpoint is not a plain-HTTP URL.
    pub fn open(endpoint: &str) -> Result<Self, String> {
        if !endpoint.starts_with("http://") {
            return Err("must begin with http://; spans are sent in plain text".to_owned());
        }

        let exporter = SpanExporter::builder()
            .with_tonic()
            .with_endpoint(endpoint)
            .with_timeout(EXPORT)
            .build()
            .map_err(|error| error.to_string())?;
        let resource = Resource::builder()
            .with_service_name("seese3")
            .with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")))
            .build();
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(LoggedExporter {
                exporter,
                fails: AtomicBool::new(false),
            })
            .with_resource(resource)
            .with_sampler(Sampler::ParentBased(Box::new(Sampler::AlwaysOn)))
            .build();

        Ok(Self(provider))
    }

    /// The subscriber layer that exports request spans.
    pub fn layer<S>(&self) -> impl Layer<S> + use<S>
    where
        S: Subscriber + for<'a> LookupSpan<'a>,
    {
        let layer: OpenTelemetryLayer<S, SdkTracer> =
            tracing_opentelemetry::layer().with_tracer(self.0.tracer("seese3"));

        // Exclude the exporter's own spans, and levels below INFO.
        let filter = filter_fn(|metadata| metadata.target().starts_with("seese3"));
        layer.with_filter(
            filter
                .with_max_level_hint(LevelFilter::INFO)
                .and(LevelFilter::INFO),
        )
    }
}

/// An exporter whose failures are logged when they begin and end. OpenTelemetry logs each of them,
/// and what the collector says.
#[derive(Debug)]
struct LoggedExporter {
    exporter: SpanExporter,
    fails: AtomicBool,
}

impl ExportSpans for LoggedExporter {
    async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
        let result = self.exporter.export(batch).await;
        let failed_before = self.fails.swap(result.is_err(), Ordering::Relaxed);
        match &result {
            Err(error) if !failed_before => {
                let error = brief(&error.to_string());
                tracing::warn!(
                    error,
                    "spans cannot be exported; they are lost until they can"
                );
            }
            Ok(()) if failed_before => tracing::info!("spans are exported again"),
            _ => {}
        }
        result
    }

    fn shutdown_with_timeout(&self, timeout: Duration) -> OTelSdkResult {
        self.exporter.shutdown_with_timeout(timeout)
    }

    fn force_flush(&self) -> OTelSdkResult {
        self.exporter.force_flush()
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.exporter.set_resource(resource);
    }
}

impl Drop for Traces {
    fn drop(&mut self) {
        // Spans that cannot be sent are dropped, as during operation.
        let _ = self.0.shutdown_with_timeout(EXPORT);
    }
}

/// Sets the caller's trace as the parent of the request span, if the caller sends one.
pub(super) fn continue_trace(span: &Span, path: &str, headers: &HeaderMap) {
    let caller = TraceContextPropagator::new().extract(&Headers(headers));
    if span.set_parent(caller).is_err() {
        // Spans are not exported in this process.
        return;
    }

    let method = path.trim_start_matches('/');
    span.record("otel.name", method);
    span.record("otel.kind", "server");
    span.set_attribute("rpc.system", "grpc");
    if let Some((service, method)) = method.split_once('/') {
        span.set_attribute("rpc.service", service.to_owned());
        span.set_attribute("rpc.method", method.to_owned());
    }
}

/// Records the gRPC status in the request span. Only server faults mark a server span as an error
/// (OpenTelemetry semantic conventions for gRPC).
pub(super) fn record_status(span: &Span, status: &str) {
    let Ok(code) = status.parse::<i32>() else {
        return;
    };
    span.set_attribute("rpc.grpc.status_code", i64::from(code));

    let is_servers_fault = matches!(
        Code::from_i32(code),
        Code::Unknown
            | Code::DeadlineExceeded
            | Code::Unimplemented
            | Code::Internal
            | Code::Unavailable
            | Code::DataLoss
    );
    if is_servers_fault {
        span.set_status(Status::error(Code::from_i32(code).description()));
    }
}

struct Headers<'a>(&'a HeaderMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        let value = self.0.get(key).and_then(|value| value.to_str().ok());
        value.filter(|value| value.len() <= LONGEST_HEADER)
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(http::HeaderName::as_str).collect()
    }
}

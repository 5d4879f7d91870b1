//! Spans of requests for a collector of OpenTelemetry (OTLP over gRPC).
//!
//! A request whose caller sends `traceparent` (W3C Trace Context) is part of the caller's trace,
//! and is exported if the caller's trace is; any other begins a trace of its own. Spans wait in a
//! queue of bounded length for a thread that sends them: a collector that is slow or gone holds
//! nobody up.

use std::time::Duration;

use http::HeaderMap;
use opentelemetry::KeyValue;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::{Status, TracerProvider};
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{Sampler, SdkTracer, SdkTracerProvider};
use tonic::Code;
use tracing::{Span, Subscriber};
use tracing_opentelemetry::{OpenTelemetryLayer, OpenTelemetrySpanExt};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{FilterExt, LevelFilter, filter_fn};
use tracing_subscriber::registry::LookupSpan;

/// How long the collector may take for one export, and the end of the server waits for the last.
const EXPORT: Duration = Duration::from_secs(5);

/// The way of spans to a collector. When it is dropped, those that wait are sent.
#[derive(Debug)]
pub struct Traces(SdkTracerProvider);

impl Traces {
    /// Spans go to the collector at `endpoint`, such as `http://127.0.0.1:4317`. It need not be
    /// there yet. This is called on a thread of an async runtime with several.
    ///
    /// # Errors
    /// In words, if the endpoint is no URL of plain HTTP.
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
            .with_batch_exporter(exporter)
            .with_resource(resource)
            .with_sampler(Sampler::ParentBased(Box::new(Sampler::AlwaysOn)))
            .build();

        Ok(Self(provider))
    }

    /// The part of a subscriber that exports the spans of requests.
    pub fn layer<S>(&self) -> impl Layer<S> + use<S>
    where
        S: Subscriber + for<'a> LookupSpan<'a>,
    {
        let layer: OpenTelemetryLayer<S, SdkTracer> =
            tracing_opentelemetry::layer().with_tracer(self.0.tracer("seese3"));

        // Not what the exporter itself does, and no lines of the log for developers.
        let filter = filter_fn(|metadata| metadata.target().starts_with("seese3"));
        layer.with_filter(
            filter
                .with_max_level_hint(LevelFilter::INFO)
                .and(LevelFilter::INFO),
        )
    }
}

impl Drop for Traces {
    fn drop(&mut self) {
        // Spans that cannot be sent are lost, as they are while the server runs.
        let _ = self.0.shutdown_with_timeout(EXPORT);
    }
}

/// Makes the span of a request part of the trace that its caller sends, if it sends one.
pub(super) fn continue_trace(span: &Span, path: &str, headers: &HeaderMap) {
    let caller = TraceContextPropagator::new().extract(&Headers(headers));
    if span.set_parent(caller).is_err() {
        // Nothing is exported in this process.
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

/// Notes the gRPC status of a request in its span. Of a server's spans, those are errors that the
/// server is to blame for (OpenTelemetry's conventions for gRPC).
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
        self.0.get(key).and_then(|value| value.to_str().ok())
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(http::HeaderName::as_str).collect()
    }
}

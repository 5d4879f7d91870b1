//! Prometheus metrics of a server.
//!
//! Every name begins with `seese3_`. Label values come from closed sets, never from requests, so
//! that callers cannot create new time series.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};
use strum::{IntoStaticStr, VariantArray};

use super::rpcs::known_path;
use super::status::Full;
use seese3_client::proto::v1::TrackStatus;
use seese3_core::navigation::IndexKind;

/// The metrics of one server. Clones share the same counters.
#[derive(Debug, Clone)]
pub struct Metrics(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    registry: Mutex<Registry>,
    requests: Family<RequestLabels, Histogram>,
    in_flight: Gauge,
    frames: Family<FrameLabels, Histogram>,
    encodings: Histogram,
    retrieval_distance: Histogram,
    refusals: Family<FullLabels, Counter>,
    rooms: Gauge,
    adapters: Gauge,
    refused: Family<KindLabels, Gauge>,
    reloads: Family<OutcomeLabels, Counter>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RequestLabels {
    method: &'static str,
    code: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct FrameLabels {
    outcome: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct FullLabels {
    full: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct KindLabels {
    kind: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OutcomeLabels {
    outcome: &'static str,
}

/// Outcome of checking the store for changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum ReloadOutcome {
    Changed,
    Unchanged,
    Failed,
}

/// Buckets from 0.25 ms to 131 s.
fn request_seconds() -> Histogram {
    Histogram::new(exponential_buckets(0.000_25, 2.0, 20))
}

/// Buckets from 0.1 ms to 3.3 s; a camera sends a frame every 16 to 200 ms.
fn frame_seconds() -> Histogram {
    Histogram::new(exponential_buckets(0.000_1, 2.0, 16))
}

/// Buckets from 0.01 to 82. Latent distances have no unit; those of neighbors are 0.01 to 10.
fn latent_distance() -> Histogram {
    Histogram::new(exponential_buckets(0.01, 2.0, 14))
}

impl Default for Metrics {
    fn default() -> Self {
        let mut registry = Registry::with_prefix("seese3");
        let build = Info::new(vec![("version", env!("CARGO_PKG_VERSION"))]);
        registry.register("build", "The program", build);

        let metrics = Inner {
            requests: Family::new_with_constructor(request_seconds),
            in_flight: Gauge::default(),
            frames: Family::new_with_constructor(frame_seconds),
            encodings: request_seconds(),
            retrieval_distance: latent_distance(),
            refusals: Family::default(),
            rooms: Gauge::default(),
            adapters: Gauge::default(),
            refused: Family::default(),
            reloads: Family::default(),
            registry: Mutex::default(),
        };
        metrics.describe(&mut registry);
        metrics.begin_at_zero();

        Self(Arc::new(Inner {
            registry: Mutex::new(registry),
            ..metrics
        }))
    }
}

impl Inner {
    /// Creates the counters that alerts watch, so that the first event is a change from zero.
    fn begin_at_zero(&self) {
        for &full in Full::VARIANTS {
            let full = full.into();
            drop(self.refusals.get_or_create(&FullLabels { full }));
        }
        for outcome in ReloadOutcome::VARIANTS {
            let outcome = outcome.into();
            drop(self.reloads.get_or_create(&OutcomeLabels { outcome }));
        }
        for status in [
            TrackStatus::Tracking,
            TrackStatus::Degraded,
            TrackStatus::Lost,
            TrackStatus::Relocalizing,
        ] {
            let outcome = status.as_str_name();
            drop(self.frames.get_or_create(&FrameLabels { outcome }));
        }
    }

    /// Registers every metric with its name and help text.
    fn describe(&self, registry: &mut Registry) {
        registry.register_with_unit(
            "request",
            "Time from a request's arrival to the end of its response, streams included, by RPC and gRPC code",
            Unit::Seconds,
            self.requests.clone(),
        );
        registry.register(
            "requests_in_flight",
            "Requests and streams in flight",
            self.in_flight.clone(),
        );
        registry.register_with_unit(
            "track_frame",
            "Time from a Track frame's arrival to its answer, by tracking status or refusal",
            Unit::Seconds,
            self.frames.clone(),
        );
        registry.register_with_unit(
            "image_encoding",
            "Time to encode one image",
            Unit::Seconds,
            self.encodings.clone(),
        );
        registry.register(
            "retrieval_distance",
            "Latent distance from the query to the nearest retrieved frame",
            self.retrieval_distance.clone(),
        );
        registry.register(
            "requests_shed",
            "Requests refused because a limit was reached, by limit",
            self.refusals.clone(),
        );
        registry.register("rooms", "Rooms that are served", self.rooms.clone());
        registry.register(
            "adapters",
            "Adapters that are served",
            self.adapters.clone(),
        );
        registry.register(
            "refused",
            "Newest revisions in the store that cannot be served: rooms, adapters, adapters in one of \
             their rooms, and chosen defaults",
            self.refused.clone(),
        );
        registry.register(
            "reloads",
            "Checks of the store for changes, by outcome: changed, unchanged or failed",
            self.reloads.clone(),
        );
    }
}

/// Numbers of served and refused items in a snapshot.
pub(super) struct ServedCounts {
    pub rooms: usize,
    pub adapters: usize,
    /// Number of refused items by kind.
    pub refused: [(&'static str, usize); 4],
}

impl Metrics {
    /// The metrics in the text format, for a scrape.
    pub fn text(&self) -> String {
        let registry = self.registry();

        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = prometheus_client::encoding::text::encode(&mut text, &registry);
        text
    }

    /// Registers an external counter, read by `count` at every scrape.
    pub fn count_elsewhere(
        &self,
        name: &'static str,
        help: &'static str,
        count: impl Fn() -> u64 + Send + Sync + 'static,
    ) {
        self.register(Elsewhere {
            name,
            help,
            value: Box::new(count),
            kind: Kind::Counter,
        });
    }

    /// Registers an external gauge, read by `value` at every scrape.
    pub(super) fn gauge_elsewhere(
        &self,
        name: &'static str,
        help: &'static str,
        value: impl Fn() -> u64 + Send + Sync + 'static,
    ) {
        self.register(Elsewhere {
            name,
            help,
            value: Box::new(value),
            kind: Kind::Gauge,
        });
    }

    fn register(&self, collector: Elsewhere) {
        self.registry().register_collector(Box::new(collector));
    }

    fn registry(&self) -> MutexGuard<'_, Registry> {
        let registry = self.0.registry.lock();
        registry.unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts the start of a request or stream.
    pub(super) fn request_began(&self) {
        self.0.in_flight.inc();
    }

    /// Records the end of a request or stream.
    pub(super) fn request_ended(&self, method: &str, code: tonic::Code, took: Duration) {
        self.0.in_flight.dec();

        let labels = RequestLabels {
            method: known_path(method).unwrap_or("unknown"),
            code: code_name(code),
        };
        let requests = self.0.requests.get_or_create(&labels);
        requests.observe(took.as_secs_f64());
    }

    /// Number of requests and streams in flight.
    pub(super) fn in_flight(&self) -> i64 {
        self.0.in_flight.get()
    }

    /// Records the answer to a Track frame.
    pub(super) fn frame_answered(&self, outcome: &'static str, took: Duration) {
        let frames = self.0.frames.get_or_create(&FrameLabels { outcome });
        frames.observe(took.as_secs_f64());
    }

    /// Records the encoding of an image.
    pub(super) fn image_encoded(&self, took: Duration) {
        self.0.encodings.observe(took.as_secs_f64());
    }

    /// Records the latent distance of a retrieved frame.
    pub(super) fn retrieved(&self, distance: f64) {
        self.0.retrieval_distance.observe(distance);
    }

    /// Counts a request refused because of this limit.
    pub(super) fn shed(&self, full: Full) {
        let full = full.into();
        self.0.refusals.get_or_create(&FullLabels { full }).inc();
    }

    /// Sets the gauges of a newly served snapshot.
    pub(super) fn serving(&self, counts: ServedCounts) {
        let count = |count: usize| i64::try_from(count).unwrap_or(i64::MAX);
        self.0.rooms.set(count(counts.rooms));
        self.0.adapters.set(count(counts.adapters));

        for (kind, refused) in counts.refused {
            let gauge = self.0.refused.get_or_create(&KindLabels { kind });
            gauge.set(count(refused));
        }
    }

    /// Names the index of the rooms' frames.
    pub(super) fn index(&self, kind: IndexKind) {
        let name = Info::new(vec![("kind", kind.name())]);
        let help = "The index of the frames of a room";
        self.registry().register("index", help, name);
    }

    /// Counts a check of the store for changes.
    pub(super) fn reloaded(&self, outcome: ReloadOutcome) {
        let outcome = outcome.into();
        self.0
            .reloads
            .get_or_create(&OutcomeLabels { outcome })
            .inc();
    }
}

/// A collector that reads an external value.
struct Elsewhere {
    name: &'static str,
    help: &'static str,
    value: Box<dyn Fn() -> u64 + Send + Sync>,
    kind: Kind,
}

/// Metric type of an external value.
#[derive(Debug, Clone, Copy)]
enum Kind {
    Counter,
    Gauge,
}

impl std::fmt::Debug for Elsewhere {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name)
    }
}

impl Collector for Elsewhere {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), std::fmt::Error> {
        let value = (self.value)();
        match self.kind {
            Kind::Counter => {
                let counter = ConstCounter::new(value);
                let kind = counter.metric_type();
                counter.encode(encoder.encode_descriptor(self.name, self.help, None, kind)?)
            }
            Kind::Gauge => {
                let gauge = ConstGauge::new(i64::try_from(value).unwrap_or(i64::MAX));
                let kind = gauge.metric_type();
                gauge.encode(encoder.encode_descriptor(self.name, self.help, None, kind)?)
            }
        }
    }
}

/// The name of a code in the gRPC specification.
fn code_name(code: tonic::Code) -> &'static str {
    use tonic::Code;

    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the Prometheus text format. A counter ends in `_total`; a histogram has buckets, a
    /// count and a sum. An unknown path is never a label.
    #[test]
    fn what_is_counted_is_in_the_text() {
        let metrics = Metrics::default();
        let took = Duration::from_millis(3);
        for (method, code) in [
            ("/seese3.v1.NavigationService/Navigate", tonic::Code::Ok),
            ("/made/up", tonic::Code::Unauthenticated),
        ] {
            metrics.request_began();
            metrics.request_ended(method, code, took);
        }
        metrics.shed(Full::ShortRequests);
        metrics.count_elsewhere("log_lines_lost", "Lines", || 7);

        let text = metrics.text();
        for line in [
            r#"seese3_request_seconds_count{method="/seese3.v1.NavigationService/Navigate",code="OK"} 1"#,
            r#"seese3_request_seconds_bucket{le="0.004",method="/seese3.v1.NavigationService/Navigate",code="OK"} 1"#,
            r#"seese3_request_seconds_bucket{le="0.002",method="/seese3.v1.NavigationService/Navigate",code="OK"} 0"#,
            r#"seese3_request_seconds_count{method="unknown",code="UNAUTHENTICATED"} 1"#,
            r#"seese3_requests_shed_total{full="short requests"} 1"#,
            "seese3_requests_in_flight 0",
            "seese3_log_lines_lost_total 7",
        ] {
            assert!(text.contains(line), "no {line} in\n{text}");
        }
        assert!(!text.contains("made/up"));
    }
}

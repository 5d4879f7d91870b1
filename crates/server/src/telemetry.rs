//! Writes one log line when a request ends. It has a request id that the caller may choose and that
//! the response returns.
//!
//! Each request has a span. The gRPC status is in the headers of a response that failed at once,
//! and otherwise in the trailers after the last message. It is recorded in the span; closing the
//! span writes the line. If the caller goes away, the span closes without a status.

use std::time::Duration;

use http::{HeaderMap, HeaderName, HeaderValue, Request, Response};
use tower_http::request_id::{MakeRequestId, RequestId};
use tracing::{Level, Span, field};

use super::connections::Peer;
use super::health::{HEALTH_CHECK, HEALTH_WATCH};
use super::rpcs::rpc;

/// The metadata key of the request id, in requests and responses.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// Maximum length of a caller's request id, bytes.
const LONGEST_ID: usize = 128;

/// Removes a request id that is empty, too long or not printable, so that a new one is assigned.
pub fn without_unfit_id<B>(mut request: Request<B>) -> Request<B> {
    if request.headers().get(REQUEST_ID).is_some_and(is_unfit) {
        request.headers_mut().remove(REQUEST_ID);
    }

    request
}

fn is_unfit(id: &HeaderValue) -> bool {
    let is_printable = id.as_bytes().iter().all(u8::is_ascii_graphic);
    id.is_empty() || id.len() > LONGEST_ID || !is_printable
}

/// Generates random request ids of 16 hexadecimal digits.
#[derive(Debug, Clone, Copy)]
pub struct RandomId;

impl MakeRequestId for RandomId {
    fn make_request_id<B>(&mut self, _: &Request<B>) -> Option<RequestId> {
        let id = format!("{:016x}", rand::random::<u64>());
        HeaderValue::from_str(&id).ok().map(RequestId::new)
    }
}

/// Maximum length of a path in logs and spans, bytes. Those of RPCs are shorter.
const LONGEST_PATH: usize = 100;

/// A span of this level, with the fields of a request.
macro_rules! request_span {
    ($level:expr, $request:expr, $path:expr) => {{
        let id = $request.headers().get(REQUEST_ID);
        let peer = $request.extensions().get::<Peer>();
        tracing::span!(
            $level,
            "request",
            id = id.and_then(|id| id.to_str().ok()).unwrap_or_default(),
            method = $path,
            trace = trace_id($request.headers()),
            peer = peer.map(|peer| field::display(peer.address)),
            principal = field::Empty,
            grpc_status = field::Empty,
            // Recorded only where spans are exported; log lines then have them too.
            otel.name = field::Empty,
            otel.kind = field::Empty,
        )
    }};
}

/// The span of a request. Its status is recorded later. Everybody can make health calls and calls
/// of unknown paths, in any number, so they are logged at a lower level.
pub fn span<B>(request: &Request<B>) -> Span {
    // An unknown path may be long.
    let path = request.uri().path();
    let path = path.get(..LONGEST_PATH).unwrap_or(path);
    let is_quiet = rpc(path).is_none() || [HEALTH_CHECK, HEALTH_WATCH].contains(&path);
    let span = if is_quiet {
        request_span!(Level::DEBUG, request, path)
    } else {
        request_span!(Level::INFO, request, path)
    };

    #[cfg(feature = "otlp")]
    super::traces::continue_trace(&span, path, request.headers());
    span
}

/// The trace id from `traceparent` (W3C Trace Context), if the caller sends one. It links log lines
/// with the spans of other services.
fn trace_id(headers: &HeaderMap) -> Option<&str> {
    let parts = headers.get("traceparent")?.to_str().ok()?;
    let id = parts.split('-').nth(1)?;
    let is_number = id.len() == 32 && id.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_number.then_some(id)
}

/// Records the status of a response that failed before its first message.
pub fn record_headers<B>(response: &Response<B>, _: Duration, span: &Span) {
    record_status(response.headers(), span);
}

/// Records the status in the trailers; a stream that ends without trailers succeeded.
pub fn record_trailers(trailers: Option<&HeaderMap>, _: Duration, span: &Span) {
    match trailers {
        Some(trailers) => record_status(trailers, span),
        None => {
            span.record("grpc_status", "0");
            #[cfg(feature = "otlp")]
            super::traces::record_status(span, "0");
        }
    }
}

fn record_status(headers: &HeaderMap, span: &Span) {
    let status = headers.get("grpc-status");
    if let Some(status) = status.and_then(|status| status.to_str().ok()) {
        span.record("grpc_status", status);
        #[cfg(feature = "otlp")]
        super::traces::record_status(span, status);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: W3C Trace Context, section 3.2.
    #[test]
    fn the_trace_of_a_caller_is_known() {
        let of = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("traceparent", text.parse().unwrap());
            trace_id(&headers).map(str::to_owned)
        };
        let id = "4bf92f3577b34da6a3ce929d0e0e4736";
        assert_eq!(
            of(&format!("00-{id}-00f067aa0b890217-01")).as_deref(),
            Some(id)
        );
        assert_eq!(of("00-4bf9-00f067aa0b890217-01"), None);
        assert_eq!(of("nonsense"), None);
        assert_eq!(trace_id(&HeaderMap::new()), None);
    }

    /// Oracle: the contract. Ids of up to 128 printable characters are kept; others are replaced by
    /// a new random id of 16 digits.
    #[test]
    fn long_or_unprintable_ids_are_replaced() {
        let kept = |id: &str| {
            let request = Request::builder().header(REQUEST_ID, id).body(()).unwrap();
            without_unfit_id(request).headers().contains_key(REQUEST_ID)
        };
        assert!(kept("robot-7/42") && kept(&"x".repeat(128)));
        assert!(!kept("a b") && !kept("") && !kept(&"x".repeat(129)));

        let made = || RandomId.make_request_id(&Request::new(())).unwrap();
        let first = made();
        assert_eq!(first.header_value().len(), 16);
        assert_ne!(first.header_value(), made().header_value());
    }
}

//! A line in the log for each request, with an id that the caller can give and gets back.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Instant;

use http::{HeaderValue, Request, Response};
use tonic::body::Body;
use tower::{Layer, Service};
use tracing::Instrument;

/// Of the id, in requests and responses.
const REQUEST_ID: &str = "x-request-id";
/// The longest id that is taken over.
const LONGEST_ID: usize = 128;

/// Makes [`Telemetry`].
#[derive(Debug, Clone, Copy)]
pub struct TelemetryLayer;

/// Logs requests on their way to a service.
#[derive(Debug, Clone)]
pub struct Telemetry<S>(S);

impl<S> Layer<S> for TelemetryLayer {
    type Service = Telemetry<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Telemetry(inner)
    }
}

impl<S> Service<Request<Body>> for Telemetry<S>
where
    S: Service<Request<Body>, Response = Response<Body>> + Clone + Send + 'static,
    S::Future: Send,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Self::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let begun = Instant::now();
        let id = request_id(request.headers().get(REQUEST_ID));
        let span = tracing::info_span!(
            "request",
            id = id.to_str().unwrap_or_default(),
            method = request.uri().path()
        );

        // The service that was polled ready answers; its clone stays for the next request.
        let ready = self.0.clone();
        let mut inner = std::mem::replace(&mut self.0, ready);

        let answered = async move {
            let mut response = inner.call(request).await?;
            let headers = response.headers_mut();
            let code = headers
                .get("grpc-status")
                .and_then(|code| code.to_str().ok())
                .unwrap_or("0")
                .to_owned();

            headers.insert(REQUEST_ID, id);
            let ms = begun.elapsed().as_secs_f64() * 1e3;
            tracing::info!(grpc_status = code, ms, "answered");

            Ok(response)
        };

        Box::pin(answered.instrument(span))
    }
}

/// The caller's id if it is short and printable, else a new one.
fn request_id(given: Option<&HeaderValue>) -> HeaderValue {
    let fits = |id: &&HeaderValue| {
        !id.is_empty() && id.len() <= LONGEST_ID && id.as_bytes().iter().all(u8::is_ascii_graphic)
    };
    match given.filter(fits) {
        Some(id) => id.clone(),
        None => HeaderValue::from_str(&format!("{:016x}", rand::random::<u64>()))
            .unwrap_or(HeaderValue::from_static("unnamed")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_or_unprintable_ids_are_replaced() {
        let given = |text: &str| request_id(Some(&HeaderValue::from_str(text).unwrap()));
        assert_eq!(given("robot-7/42"), "robot-7/42");
        assert_ne!(given("a b"), "a b");
        assert_eq!(given(&"x".repeat(129)).len(), 16);

        assert_ne!(request_id(None), request_id(None));
    }
}

//! Measures every request from its arrival to the last byte of its response, by final status code.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Instant;

use http::{HeaderMap, Request, Response};
use http_body::{Frame, SizeHint};
use tonic::Code;
use tonic::body::Body;
use tower::{Layer, Service};

use super::metrics::Metrics;

/// Adds request metrics to a service.
#[derive(Debug, Clone)]
pub struct RequestMetricsLayer(pub Metrics);

impl<S> Layer<S> for RequestMetricsLayer {
    type Service = RequestMetrics<S>;

    fn layer(&self, inner: S) -> Self::Service {
        RequestMetrics {
            inner,
            metrics: self.0.clone(),
        }
    }
}

/// A service with request metrics.
#[derive(Debug, Clone)]
pub struct RequestMetrics<S> {
    inner: S,
    metrics: Metrics,
}

impl<S, B> Service<Request<B>> for RequestMetrics<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let mut open = OpenRequest::new(self.metrics.clone(), request.uri().path());
        let answer = self.inner.call(request);

        Box::pin(async move {
            let response = answer.await?;

            // A request that is refused at once has its code in the headers.
            open.record_code(response.headers());
            Ok(response.map(|body| Body::new(MeasuredBody { body, open })))
        })
    }
}

/// A request in flight. Dropping it records its end, with the received status code or, if there is
/// none because the caller has gone, with CANCELLED.
struct OpenRequest {
    metrics: Metrics,
    method: String,
    began: Instant,
    code: Option<Code>,
}

impl OpenRequest {
    fn new(metrics: Metrics, method: &str) -> Self {
        metrics.request_began();
        Self {
            metrics,
            method: method.to_owned(),
            began: Instant::now(),
            code: None,
        }
    }

    fn record_code(&mut self, headers: &HeaderMap) {
        if let Some(code) = headers.get("grpc-status") {
            self.code = Some(Code::from_bytes(code.as_bytes()));
        }
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        let code = self.code.unwrap_or(Code::Cancelled);
        self.metrics
            .request_ended(&self.method, code, self.began.elapsed());
    }
}

/// A response body; its trailers hold the status code.
struct MeasuredBody {
    body: Body,
    open: OpenRequest,
}

impl http_body::Body for MeasuredBody {
    type Data = <Body as http_body::Body>::Data;
    type Error = <Body as http_body::Body>::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        let polled = Pin::new(&mut self.body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && let Some(trailers) = frame.trailers_ref()
        {
            self.open.record_code(trailers);
        }

        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

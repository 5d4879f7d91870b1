//! Receives requests, as far as there is memory for them.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use http::{Request, Response};
use http_body::{Frame, SizeHint};
use http_body_util::{BodyExt, Full as WholeBody};
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};

use super::super::Error;
use super::super::metrics::Metrics;
use super::super::status::Full;
use super::decoded::decoded_size;
use super::{HELD, Held, Memory};

/// The RPCs whose requests are streams of messages, by the end of their path.
const STREAMS: [&str; 4] = [
    "/Track",
    "/CreateRoom",
    "/PublishAdapter",
    "/ServerReflectionInfo",
];
/// What stands before a message: whether it is compressed, and its length.
const PREFIX: usize = 5;

/// Wraps a service so that its requests hold no more memory than they may.
#[derive(Debug, Clone)]
pub struct MemoryLayer {
    /// The memory of all requests.
    pub memory: Memory,
    /// The largest message, bytes.
    pub message_bytes: usize,
    /// How long a request with one message may take to arrive.
    pub receive_within: Duration,
    /// Counts what is refused.
    pub metrics: Metrics,
}

impl<S> Layer<S> for MemoryLayer {
    type Service = Bounded<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Bounded {
            inner,
            layer: self.clone(),
        }
    }
}

/// A service whose requests hold no more memory than they may.
#[derive(Debug, Clone)]
pub struct Bounded<S> {
    inner: S,
    layer: MemoryLayer,
}

impl<S> Service<Request<Body>> for Bounded<S>
where
    S: Service<Request<Body>, Response = Response<Body>> + Clone + Send + 'static,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        // The service that was found ready is the one to call.
        let waiting = self.inner.clone();
        let mut inner = std::mem::replace(&mut self.inner, waiting);
        let layer = self.layer.clone();

        Box::pin(async move {
            let (held, request) = match layer.received(request).await {
                Ok(received) => received,
                Err(error) => return Ok(Status::from(error).into_http()),
            };

            let response = HELD.scope(held.clone(), inner.call(request)).await?;
            Ok(response.map(|body| Body::new(HoldingBody { body, _held: held })))
        })
    }
}

impl MemoryLayer {
    /// Receives a request as far as it has to be before a handler sees it.
    async fn received(&self, request: Request<Body>) -> Result<(Held, Request<Body>), Error> {
        let held = self.memory.begin().ok_or_else(|| self.full())?;
        let path = request.uri().path().to_owned();

        if STREAMS.iter().any(|end| path.ends_with(end)) {
            let layer = self.clone();
            let counted = held.clone();
            let request = request.map(|body| {
                Body::new(CountedBody {
                    body,
                    counted: 0,
                    held: counted,
                    layer,
                })
            });
            return Ok((held, request));
        }

        let (head, body) = request.into_parts();
        let message = tokio::time::timeout(self.receive_within, self.whole(body, &held)).await;
        let message = message.map_err(|_| Error::Deadline)??;
        let size = decoded_size(&path, message.get(PREFIX..).unwrap_or_default());
        if size > self.memory.largest_request() {
            let problem = format!(
                "takes {size} bytes when it is decoded, over the limit of this server; send less at once"
            );
            return Err(Error::invalid("request", problem));
        }
        if !held.0.hold(size) {
            return Err(self.full());
        }

        let body = Body::new(WholeBody::new(message));
        Ok((held, Request::from_parts(head, body)))
    }

    /// All bytes of a request.
    async fn whole(&self, mut body: Body, held: &Held) -> Result<Bytes, Error> {
        let mut whole = BytesMut::new();
        while let Some(frame) = body.frame().await {
            let frame = frame.map_err(|status| Error::Transport {
                code: status.code(),
                problem: status.message().to_owned(),
            })?;
            let Ok(data) = frame.into_data() else {
                continue;
            };

            // The decoder refuses a message that is too long by its prefix: no more is read of it.
            if !held.0.hold(data.len()) {
                return Err(self.full());
            }
            whole.extend_from_slice(&data);
            if whole.len() > self.message_bytes + PREFIX {
                break;
            }
        }

        Ok(whole.freeze())
    }

    fn full(&self) -> Error {
        self.metrics.shed(Full::Memory);
        Error::Full { what: Full::Memory }
    }
}

/// The body of a request that is a stream: its bytes are counted up to the largest message, since the
/// handler keeps no more of it.
struct CountedBody {
    body: Body,
    counted: usize,
    held: Held,
    layer: MemoryLayer,
}

impl http_body::Body for CountedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let polled = Pin::new(&mut self.body).poll_frame(context);
        let Poll::Ready(Some(Ok(frame))) = &polled else {
            return polled;
        };

        let arrived = frame.data_ref().map_or(0, Bytes::len);
        let uncounted = (self.layer.message_bytes + PREFIX).saturating_sub(self.counted);
        let bytes = arrived.min(uncounted);
        if !self.held.0.hold(bytes) {
            return Poll::Ready(Some(Err(self.layer.full().into())));
        }

        self.counted += bytes;
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// The body of an answer, which holds the memory of its request until it has been sent.
struct HoldingBody {
    body: Body,
    _held: Held,
}

impl http_body::Body for HoldingBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

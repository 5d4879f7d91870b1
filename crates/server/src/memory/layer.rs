//! Middleware that receives requests within the memory limit.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use http::{Request, Response};
use http_body_util::{BodyExt, Full as WholeBody};
use tokio::sync::OwnedSemaphorePermit;
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};

use super::super::Error;
use super::super::caller::CallerId;
use super::super::connections::Peer;
use super::super::health::{HEALTH_BYTES, HEALTH_CHECK, HEALTH_WATCH};
use super::super::holding_body::holding;
use super::super::rpcs::rpc;
use super::super::status::Full;
use super::decoded::{PREFIX, decoded_size};
use super::response::{Responses, in_pieces};
use super::stream::{CountedBody, StreamMemory};
use super::{MEMORY_LEASE, Memory, MemoryLease};

/// Time limit for receiving a health request. It needs no credentials, and is a few bytes.
const HEALTH_RECEIVE: Duration = Duration::from_secs(1);

/// Middleware that bounds the memory held by requests.
#[derive(Debug, Clone)]
pub struct MemoryLayer {
    /// Budget of all requests except health requests.
    pub memory: Memory,
    /// Budget of health watch streams, divided between connections. Health checks need no budget:
    /// a connection has few at a time, and they are small and short.
    pub watchers: Memory,
    /// Maximum message size, bytes.
    pub message_bytes: usize,
    /// Receive timeout of a request with one message.
    pub receive_within: Duration,
    /// The responses that are being sent.
    pub responses: Arc<Responses>,
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

/// A service wrapped by [`MemoryLayer`].
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
        // Call the instance that `poll_ready` was called on.
        let waiting = self.inner.clone();
        let mut inner = std::mem::replace(&mut self.inner, waiting);
        let layer = self.layer.clone();

        Box::pin(async move {
            let received = match layer.received(request).await {
                Ok(received) => received,
                Err(error) => return Ok(Status::from(error).into_http()),
            };

            let Received { request, held } = received;
            let is_watch = request.uri().path() == HEALTH_WATCH;
            let peer = request.extensions().get::<Peer>().cloned();
            let response = match held.lease.clone() {
                Some(lease) => MEMORY_LEASE.scope(lease, inner.call(request)).await?,
                None => inner.call(request).await?,
            };

            let peer = peer.filter(|_| !is_watch);
            let timeout = peer.map(|peer| layer.responses.begin(peer));
            Ok(response.map(|body| in_pieces(holding(body, held), timeout)))
        })
    }
}

/// A request for its handler, and what it holds until its response is sent.
struct Received {
    request: Request<Body>,
    held: Held,
}

/// Resources of a request.
struct Held {
    /// `None` for a health check.
    lease: Option<MemoryLease>,
    /// Its place among the health calls of the connection.
    _health: Option<OwnedSemaphorePermit>,
}

impl MemoryLayer {
    /// Receives a request for its handler: completely if it has one message, otherwise as a stream
    /// whose messages are counted.
    async fn received(&self, mut request: Request<Body>) -> Result<Received, Error> {
        let path = request.uri().path().to_owned();
        let is_health = [HEALTH_CHECK, HEALTH_WATCH].contains(&path.as_str());
        let peer = request.extensions().get::<Peer>();
        let health = match peer.filter(|_| is_health) {
            Some(peer) => Some(peer.health_place().ok_or_else(|| self.too_many_checks())?),
            None => None,
        };
        let lease = match path.as_str() {
            HEALTH_CHECK => None,
            HEALTH_WATCH => {
                let connection = CallerId::connection(request.extensions());
                Some(self.watchers.begin(connection)?)
            }
            _ => Some(self.memory.begin(CallerId::of(request.extensions()))?),
        };
        let held = Held {
            lease,
            _health: health,
        };

        let is_stream = rpc(&path).is_some_and(|rpc| rpc.has_streamed_request);
        if is_stream && let Some(lease) = held.lease.clone() {
            let messages = StreamMemory::default();
            request.extensions_mut().insert(messages.clone());
            let counted = |body| Body::new(CountedBody::new(body, &path, lease, messages));
            let request = request.map(counted);
            return Ok(Received { request, held });
        }

        let (most, within) = match is_health {
            true => (HEALTH_BYTES, HEALTH_RECEIVE),
            false => (self.message_bytes, self.receive_within),
        };
        let (head, body) = request.into_parts();
        let message = tokio::time::timeout(within, whole(body, most, held.lease.as_ref())).await;
        let message = message.map_err(|_| Error::Deadline)??;
        let one = one_message(&message, most)?;
        if let Some(lease) = &held.lease {
            let limit = lease.memory.largest_request();
            lease.hold_message(decoded_size(&path, one, limit))?;
        }

        let body = Body::new(WholeBody::new(message));
        let request = Request::from_parts(head, body);
        Ok(Received { request, held })
    }

    fn too_many_checks(&self) -> Error {
        let what = Full::HealthCalls;
        self.memory.metrics.shed(what);
        Error::Full { what }
    }
}

/// The single message of a body, without its prefix. An oversized message is passed on, because the
/// decoder rejects it by its prefix.
fn one_message(body: &[u8], most: usize) -> Result<&[u8], Error> {
    let Some((prefix, message)) = body.split_first_chunk::<PREFIX>() else {
        return Ok(&[]);
    };
    let [_, length @ ..] = *prefix;
    let length = u32::from_be_bytes(length) as usize;

    // The decoder would read all further messages before rejecting them.
    if length <= most && length != message.len() {
        let problem = format!("has {} bytes where its prefix says {length}", message.len());
        return Err(Error::invalid("request", problem));
    }
    Ok(message)
}

/// Receives all bytes of a request, a little more than `most` at most.
async fn whole(mut body: Body, most: usize, lease: Option<&MemoryLease>) -> Result<Bytes, Error> {
    let mut whole = BytesMut::new();
    while let Some(frame) = body.frame().await {
        let frame = frame.map_err(|status| Error::Transport {
            code: status.code(),
            problem: status.message().to_owned(),
        })?;
        let Ok(data) = frame.into_data() else {
            continue;
        };

        // The decoder rejects an oversized message by its prefix, so stop reading.
        if let Some(lease) = lease {
            lease.hold(data.len())?;
        }
        whole.extend_from_slice(&data);
        if whole.len() > most + PREFIX {
            break;
        }
    }

    Ok(whole.freeze())
}

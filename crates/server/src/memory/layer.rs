//! Middleware that receives requests within the memory limit.

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
use super::super::connections::Peer;
use super::super::holding_body::holding;
use super::decoded::{decoded_size, has_unary_response, is_stream};
use super::response::{ResponseTimeout, in_pieces};
use super::{MEMORY_LEASE, Memory, MemoryLease};

/// Paths of the health service. Watch streams are long-lived, so they have a separate memory
/// budget; otherwise they could block health checks or requests.
const CHECK: &str = "/grpc.health.v1.Health/Check";
const WATCH: &str = "/grpc.health.v1.Health/Watch";
/// Length of the gRPC message prefix: compression flag and message length.
const PREFIX: usize = 5;

/// Middleware that bounds the memory held by requests.
#[derive(Debug, Clone)]
pub struct MemoryLayer {
    /// Budget of all requests except health requests.
    pub memory: Memory,
    /// Budget of health checks, which are answered even when the request budget is exhausted.
    pub probes: Memory,
    /// Budget of health watch streams.
    pub watchers: Memory,
    /// Maximum message size, bytes.
    pub message_bytes: usize,
    /// Receive timeout of a request with one message.
    pub receive_within: Duration,
    /// Timeout of a unary response that the caller does not receive.
    pub response_timeout: Duration,
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
            let (held, request) = match layer.received(request).await {
                Ok(received) => received,
                Err(error) => return Ok(Status::from(error).into_http()),
            };

            let is_unary = has_unary_response(request.uri().path());
            let peer = request.extensions().get::<Peer>().cloned();
            let response = MEMORY_LEASE
                .scope(held.clone(), inner.call(request))
                .await?;

            let peer = peer.filter(|_| is_unary);
            let timeout = peer.map(|peer| ResponseTimeout::new(peer, layer.response_timeout));
            Ok(response.map(|body| in_pieces(holding(body, held), timeout)))
        })
    }
}

impl MemoryLayer {
    /// Receives a request for its handler: completely if it has one message, otherwise as a stream
    /// whose messages are counted.
    async fn received(
        &self,
        request: Request<Body>,
    ) -> Result<(MemoryLease, Request<Body>), Error> {
        let path = request.uri().path().to_owned();
        let memory = match path.as_str() {
            CHECK => &self.probes,
            WATCH => &self.watchers,
            _ => &self.memory,
        };
        let held = memory.begin()?;

        if is_stream(&path) {
            let counted = held.clone();
            let request = request.map(|body| {
                Body::new(CountedBody {
                    body,
                    messages: Messages::of(&path),
                    held: counted,
                })
            });
            return Ok((held, request));
        }

        let (head, body) = request.into_parts();
        let message = tokio::time::timeout(self.receive_within, self.whole(body, &held)).await;
        let message = message.map_err(|_| Error::Deadline)??;
        held.hold_message(decoded_size(&path, self.one_message(&message)?), 0)?;

        let body = Body::new(WholeBody::new(message));
        Ok((held, Request::from_parts(head, body)))
    }

    /// The single message of a body, without its prefix. An oversized message is passed on, because
    /// the decoder rejects it by its prefix.
    fn one_message<'a>(&self, body: &'a [u8]) -> Result<&'a [u8], Error> {
        let Some((prefix, message)) = body.split_first_chunk::<PREFIX>() else {
            return Ok(&[]);
        };
        let [_, length @ ..] = *prefix;
        let length = u32::from_be_bytes(length) as usize;

        // The decoder would read all further messages before rejecting them.
        if length <= self.message_bytes && length != message.len() {
            let problem = format!("has {} bytes where its prefix says {length}", message.len());
            return Err(Error::invalid("request", problem));
        }
        Ok(message)
    }

    /// Receives all bytes of a request.
    async fn whole(&self, mut body: Body, held: &MemoryLease) -> Result<Bytes, Error> {
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
            held.hold(data.len())?;
            whole.extend_from_slice(&data);
            if whole.len() > self.message_bytes + PREFIX {
                break;
            }
        }

        Ok(whole.freeze())
    }
}

/// The body of a streaming request. Only the largest message so far counts, because the handler
/// keeps one at a time.
struct CountedBody {
    body: Body,
    messages: Messages,
    held: MemoryLease,
}

/// Finds message boundaries in the bytes of a stream.
#[derive(Debug, Default)]
struct Messages {
    /// The path of the RPC.
    path: String,
    /// Received bytes of the current message's prefix.
    prefix: Vec<u8>,
    /// Missing bytes of the current message, without its prefix.
    missing: usize,
    /// Received bytes of the current message, without its prefix.
    current: Vec<u8>,
    /// Peak memory of any message so far, bytes: the received bytes, held here and in the decoder,
    /// plus the decoded size.
    largest: usize,
}

impl Messages {
    fn of(path: &str) -> Self {
        Self {
            path: path.to_owned(),
            ..Self::default()
        }
    }

    /// Processes received bytes.
    fn take(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let wanted = match PREFIX - self.prefix.len() {
                0 => self.missing,
                wanted => wanted,
            };
            let (taken, rest) = bytes.split_at(wanted.min(bytes.len()));
            bytes = rest;

            if self.prefix.len() < PREFIX {
                self.prefix.extend(taken);
                if let [_, length @ ..] = self.prefix.as_slice()
                    && let Ok(length) = length.try_into()
                {
                    self.missing = u32::from_be_bytes(length) as usize;
                }
            } else {
                self.missing -= taken.len();
                self.current.extend(taken);
            }

            let arrived = self.prefix.len() + self.current.len();
            self.largest = self.largest.max(2 * arrived);
            if self.prefix.len() == PREFIX && self.missing == 0 {
                let decoded = decoded_size(&self.path, &self.current);
                self.largest = self.largest.max(decoded.saturating_add(2 * arrived));
                self.prefix.clear();
                self.current = Vec::new();
            }
        }
    }
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

        // The decoder rejects an oversized message as soon as its prefix has arrived.
        if let Some(data) = frame.data_ref() {
            let before = self.messages.largest;
            self.messages.take(data);
            if let Err(error) = self.held.hold_message(self.messages.largest, before) {
                return Poll::Ready(Some(Err(error.into())));
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message;
    use seese3_client::proto::v1 as pb;

    fn message(length: usize) -> Vec<u8> {
        let mut bytes = vec![0];
        bytes.extend((length as u32).to_be_bytes());
        bytes.resize(PREFIX + length, 7);
        bytes
    }

    /// Oracle: the message lengths, for any chunking of the stream.
    #[test]
    fn a_stream_counts_for_its_largest_message() {
        let stream: Vec<u8> = [30, 0, 100, 7, 100, 99]
            .into_iter()
            .flat_map(message)
            .collect();

        for step in [1, 2, 5, 6, 64, stream.len()] {
            let mut messages = Messages::default();
            stream.chunks(step).for_each(|part| messages.take(part));
            // Two copies of the received bytes and one decoded. The decoded size for an unknown RPC
            // is the message size.
            let expected = 2 * (PREFIX + 100) + 100;
            assert_eq!(messages.largest, expected, "in parts of {step}");
        }

        // An announced length does not count.
        let mut messages = Messages::default();
        messages.take(&[0, 0xff, 0xff, 0xff, 0xff, 1, 2]);
        assert_eq!(messages.largest, 14);

        // A complete message counts with its decoded size.
        let config = pb::TrackConfig {
            rooms: vec![String::new(); 1_000],
            ..pb::TrackConfig::default()
        };
        let request = pb::TrackRequest {
            message: Some(pb::track_request::Message::Config(config)),
        };
        let mut bytes = message(0);
        let encoded = request.encode_to_vec();
        bytes[1..].copy_from_slice(&(encoded.len() as u32).to_be_bytes());
        bytes.extend(encoded);
        let mut messages = Messages::of("/seese3.v1.OdometryService/Track");
        messages.take(&bytes);
        assert!(messages.largest > 1_000 * size_of::<String>());
    }
}

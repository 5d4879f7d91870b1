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
use super::super::connections::Peer;
use super::super::holding_body::holding;
use super::decoded::{decoded_size, has_unary_response, is_stream};
use super::response::{ResponseTimeout, in_pieces};
use super::{MEMORY_LEASE, Memory, MemoryLease};

/// The paths of the health service. Those who watch stay, and have memory of their own: else many
/// of them would hold that of those who check, or of requests.
const CHECK: &str = "/grpc.health.v1.Health/Check";
const WATCH: &str = "/grpc.health.v1.Health/Watch";
/// What stands before a message: whether it is compressed, and its length.
const PREFIX: usize = 5;

/// Wraps a service so that its requests hold no more memory than they may.
#[derive(Debug, Clone)]
pub struct MemoryLayer {
    /// The memory of all requests but those of health.
    pub memory: Memory,
    /// The memory of health checks, which are answered when the other memory is full.
    pub probes: Memory,
    /// The memory of those who watch health.
    pub watchers: Memory,
    /// The largest message, bytes.
    pub message_bytes: usize,
    /// How long a request with one message may take to arrive.
    pub receive_within: Duration,
    /// How long a caller may receive nothing of a unary response.
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
    /// Receives a request as far as it has to be before a handler sees it.
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

    /// The bytes of the one message that a body has to consist of, without its prefix. A message
    /// that is too long is passed on: the decoder refuses it by its prefix.
    fn one_message<'a>(&self, body: &'a [u8]) -> Result<&'a [u8], Error> {
        let Some((prefix, message)) = body.split_first_chunk::<PREFIX>() else {
            return Ok(&[]);
        };
        let [_, length @ ..] = *prefix;
        let length = u32::from_be_bytes(length) as usize;

        // The decoder would read every further message before it refuses them.
        if length <= self.message_bytes && length != message.len() {
            let problem = format!("has {} bytes where its prefix says {length}", message.len());
            return Err(Error::invalid("request", problem));
        }
        Ok(message)
    }

    /// All bytes of a request.
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

            // The decoder refuses a message that is too long by its prefix: no more is read of it.
            held.hold(data.len())?;
            whole.extend_from_slice(&data);
            if whole.len() > self.message_bytes + PREFIX {
                break;
            }
        }

        Ok(whole.freeze())
    }
}

/// The body of a request that is a stream. What counts is the largest message so far: the handler
/// keeps one at a time.
struct CountedBody {
    body: Body,
    messages: Messages,
    held: MemoryLease,
}

/// Finds the messages in the bytes of a stream.
#[derive(Debug, Default)]
struct Messages {
    /// The path of the RPC.
    path: String,
    /// What has arrived of the prefix of the current message.
    prefix: Vec<u8>,
    /// How much of the current message is still to come, after its prefix.
    missing: usize,
    /// What has arrived of the current message, after its prefix.
    current: Vec<u8>,
    /// The most that any message took: what had arrived of it, here and in the decoder, and what it
    /// becomes when it is decoded.
    largest: usize,
}

impl Messages {
    fn of(path: &str) -> Self {
        Self {
            path: path.to_owned(),
            ..Self::default()
        }
    }

    /// Takes what arrived.
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

        // The decoder refuses a message that is too long as soon as its prefix has arrived.
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

    /// Oracle: the lengths of the messages, however the stream is cut.
    #[test]
    fn a_stream_counts_for_its_largest_message() {
        let stream: Vec<u8> = [30, 0, 100, 7, 100, 99]
            .into_iter()
            .flat_map(message)
            .collect();

        for step in [1, 2, 5, 6, 64, stream.len()] {
            let mut messages = Messages::default();
            stream.chunks(step).for_each(|part| messages.take(part));
            // Twice as it arrives, and once as it is decoded: an unknown RPC's as its bytes.
            let expected = 2 * (PREFIX + 100) + 100;
            assert_eq!(messages.largest, expected, "in parts of {step}");
        }

        // A length that is only announced counts for nothing.
        let mut messages = Messages::default();
        messages.take(&[0, 0xff, 0xff, 0xff, 0xff, 1, 2]);
        assert_eq!(messages.largest, 14);

        // What grows when it is decoded counts as grown, as soon as it is complete.
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

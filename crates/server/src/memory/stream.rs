//! Memory of the messages of a stream.
//!
//! A message counts from its first byte until its handler has processed it. A handler that keeps
//! messages takes their memory with them ([`StreamMemory::take`]). Any other handler asks for the
//! next message when it has processed the last one, which releases its memory.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};

use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tonic::Status;
use tonic::body::Body;

use super::super::Error;
use super::decoded::{PREFIX, decoded_size};
use super::{MemoryLease, Share};

/// Received messages that the handler has not taken, with their memory.
#[derive(Debug, Clone, Default)]
pub struct StreamMemory(Arc<Mutex<VecDeque<Share>>>);

impl StreamMemory {
    /// The memory of the oldest message not taken yet, to be held as long as the message. `None`
    /// outside of a request.
    pub fn take(&self) -> Option<Share> {
        let mut messages = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        messages.pop_front()
    }

    fn received(&self, message: Share) {
        let mut messages = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        messages.push_back(message);
    }

    fn release(&self) {
        let mut messages = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        messages.clear();
    }
}

/// The body of a streaming request.
pub struct CountedBody {
    body: Body,
    messages: Messages,
    received: StreamMemory,
}

impl CountedBody {
    /// Counts the messages of `body`, a request to the RPC of `path`, for the caller of `lease`.
    pub fn new(body: Body, path: &str, lease: MemoryLease, received: StreamMemory) -> Self {
        Self {
            body,
            messages: Messages {
                path: path.to_owned(),
                lease,
                prefix: Vec::new(),
                missing: 0,
                current: Vec::new(),
                memory: None,
            },
            received,
        }
    }
}

/// Finds message boundaries in the bytes of a stream.
struct Messages {
    /// The path of the RPC.
    path: String,
    /// The lease of the request; each message has a share of its own.
    lease: MemoryLease,
    /// Received bytes of the current message's prefix.
    prefix: Vec<u8>,
    /// Missing bytes of the current message, without its prefix.
    missing: usize,
    /// Received bytes of the current message, without its prefix.
    current: Vec<u8>,
    /// Memory of the current message.
    memory: Option<Share>,
}

impl Messages {
    /// Processes received bytes; complete messages are added to `received`.
    ///
    /// # Errors
    /// [`Error::Full`] if there is no memory for the bytes or for a decoded message,
    /// [`Error::Invalid`] if a decoded message exceeds the limit of one request.
    fn take(&mut self, mut bytes: &[u8], received: &StreamMemory) -> Result<(), Error> {
        while !bytes.is_empty() {
            let wanted = match PREFIX - self.prefix.len() {
                0 => self.missing,
                wanted => wanted,
            };
            let (taken, rest) = bytes.split_at(wanted.min(bytes.len()));
            bytes = rest;

            // The bytes exist twice, here and in the decoder.
            self.hold(2 * taken.len())?;
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

            if self.prefix.len() == PREFIX && self.missing == 0 {
                let limit = self.lease.memory.largest_request();
                let decoded = decoded_size(&self.path, &self.current, limit);
                self.lease.check_message(decoded)?;
                self.hold(decoded)?;

                self.prefix.clear();
                self.current = Vec::new();
                if let Some(memory) = self.memory.take() {
                    received.received(memory);
                }
            }
        }

        Ok(())
    }

    fn hold(&mut self, bytes: usize) -> Result<(), Error> {
        let MemoryLease { memory, caller, .. } = &self.lease;
        let held = match &mut self.memory {
            Some(share) => share.grow(bytes),
            None => memory
                .shares
                .take(caller.clone(), bytes)
                .map(|share| self.memory = Some(share)),
        };
        held.map_err(|limit| memory.full(limit))
    }
}

impl http_body::Body for CountedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        // The decoder asks for more bytes only after it has passed on all complete messages.
        self.received.release();

        let polled = Pin::new(&mut self.body).poll_frame(context);
        let Poll::Ready(Some(Ok(frame))) = &polled else {
            return polled;
        };

        // The decoder rejects an oversized message as soon as its prefix has arrived.
        if let Some(data) = frame.data_ref() {
            let received = self.received.clone();
            if let Err(error) = self.messages.take(data, &received) {
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
    use super::super::super::caller::CallerId;
    use super::super::super::metrics::Metrics;
    use super::super::Memory;
    use super::*;
    use http_body::Body as _;
    use prost::Message;
    use seese3_client::proto::v1 as pb;

    const TRACK: &str = "/seese3.v1.OdometryService/Track";

    fn message(length: usize) -> Vec<u8> {
        let mut bytes = vec![0];
        bytes.extend((length as u32).to_be_bytes());
        bytes.resize(PREFIX + length, 7);
        bytes
    }

    fn messages(path: &str) -> (Messages, Memory) {
        let memory = Memory::new(1 << 30, Metrics::default());
        let lease = memory.begin(CallerId::Connection(1)).unwrap();
        lease.release(usize::MAX);
        let received = StreamMemory::default();
        let body = CountedBody::new(Body::empty(), path, lease, received);
        (body.messages, memory)
    }

    /// Oracle: the message lengths, for any chunking of the stream: two copies of the received
    /// bytes and one decoded. For an unknown RPC the decoded size is the message size.
    #[test]
    fn each_message_counts_until_it_is_released() {
        let lengths = [30, 0, 100, 7];
        let stream: Vec<u8> = lengths.into_iter().flat_map(message).collect();

        for step in [1, 2, 5, 6, 64, stream.len()] {
            let (mut messages, memory) = messages("/unknown");
            let received = StreamMemory::default();
            for part in stream.chunks(step) {
                messages.take(part, &received).unwrap();
            }

            let sizes = lengths.map(|length| 2 * (PREFIX + length) + length);
            let sum: usize = sizes.iter().sum();
            assert_eq!(memory.held(), sum, "in parts of {step}");
            let first = received.take().unwrap();
            assert_eq!(first.amount(), sizes[0]);
            received.release();
            assert_eq!(memory.held(), sizes[0]);
            drop(first);
            assert_eq!(memory.held(), 0);
        }
    }

    /// Oracle: by hand. Two bytes for each name are a string when they are decoded; an announced
    /// length does not count.
    #[test]
    fn a_message_counts_as_decoded() {
        let config = pb::TrackConfig {
            rooms: vec![String::new(); 1_000],
            ..pb::TrackConfig::default()
        };
        let request = pb::TrackRequest {
            message: Some(pb::track_request::Message::Config(config)),
        };
        let encoded = request.encode_to_vec();
        let mut bytes = message(0);
        bytes[1..].copy_from_slice(&(encoded.len() as u32).to_be_bytes());
        bytes.extend(encoded);

        let (mut messages, memory) = messages(TRACK);
        messages.take(&bytes, &StreamMemory::default()).unwrap();
        assert_eq!(memory.held(), 0, "nobody keeps the message");
        let received = StreamMemory::default();
        messages.take(&bytes, &received).unwrap();
        assert!(memory.held() > 1_000 * size_of::<String>());

        messages
            .take(&[0, 0xff, 0xff, 0xff, 0xff, 1, 2], &received)
            .unwrap();
        received.release();
        assert_eq!(memory.held(), 14);
    }

    /// Oracle: the contract: the decoder's next request for bytes releases what it has passed on.
    #[test]
    fn the_next_poll_releases_processed_messages() {
        let memory = Memory::new(1 << 30, Metrics::default());
        let lease = memory.begin(CallerId::Connection(1)).unwrap();
        let before = memory.held();
        let whole = http_body_util::Full::new(Bytes::from(message(1_000)));
        let body = Body::new(whole);
        let mut body = CountedBody::new(body, TRACK, lease, StreamMemory::default());

        let mut context = Context::from_waker(std::task::Waker::noop());
        let polled = Pin::new(&mut body).poll_frame(&mut context);
        assert!(matches!(polled, Poll::Ready(Some(Ok(_)))));
        assert!(memory.held() >= before + 2_000);

        let polled = Pin::new(&mut body).poll_frame(&mut context);
        assert!(matches!(polled, Poll::Ready(None)));
        assert_eq!(memory.held(), before);
    }
}

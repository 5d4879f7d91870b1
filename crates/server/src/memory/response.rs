//! Sending responses to slow callers.
//!
//! HTTP/2 sends only what fits the caller's flow-control window and waits indefinitely with the
//! rest. Data that the transport has accepted is no longer counted, and it accepts a whole data
//! frame as soon as one byte fits. Frames are therefore kept short.

use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http_body::{Frame, SizeHint};
use slab::Slab;
use tokio::time::Instant;
use tonic::Status;
use tonic::body::Body;

use super::super::connections::Peer;

/// Maximum data frame size, bytes; HTTP/2's default.
const PIECE: usize = 16 << 10;

/// Parts of the time limit after which responses are looked at.
const LOOKS: u32 = 8;

/// The responses that are being sent. A caller that receives nothing for a time limit, or up to an eighth
/// more, while there is something to receive, loses its connection: data in flight cannot be withdrawn
/// otherwise.
#[derive(Debug)]
pub struct Responses {
    limit: Duration,
    began: Instant,
    open: Mutex<Slab<Arc<Progress>>>,
}

#[derive(Debug)]
struct Progress {
    peer: Peer,
    /// When the transport last polled for a piece, milliseconds after the start of [`Responses`].
    polled_ms: AtomicU64,
    /// Whether the handler has nothing to send: the caller need not receive anything.
    is_waiting: AtomicBool,
}

impl Responses {
    /// Starts the task that looks at the responses. It ends with them.
    pub fn watched(limit: Duration) -> Arc<Self> {
        let responses = Arc::new(Self {
            limit,
            began: Instant::now(),
            open: Mutex::default(),
        });

        let known = Arc::downgrade(&responses);
        let pause = (limit / LOOKS).max(Duration::from_millis(1));
        tokio::spawn(async move {
            loop {
                tokio::time::sleep(pause).await;
                let Some(responses) = known.upgrade() else {
                    return;
                };
                responses.close_stalled();
            }
        });
        responses
    }

    /// Watches a new response to `peer`.
    pub fn begin(self: &Arc<Self>, peer: Peer) -> ResponseTimeout {
        let progress = Arc::new(Progress {
            peer,
            polled_ms: AtomicU64::new(self.now_ms()),
            is_waiting: AtomicBool::new(false),
        });
        ResponseTimeout {
            key: self.open().insert(progress.clone()),
            responses: self.clone(),
            progress,
        }
    }

    /// Closes the connections whose callers receive nothing.
    fn close_stalled(&self) {
        let limit = u64::try_from(self.limit.as_millis()).unwrap_or(u64::MAX);
        let now = self.now_ms();
        let is_stalled = |progress: &Progress| {
            let since = now.saturating_sub(progress.polled_ms.load(Ordering::Relaxed));
            since >= limit && !progress.is_waiting.load(Ordering::Relaxed)
        };

        for (_, progress) in self.open().iter() {
            if is_stalled(progress) && progress.peer.close() {
                let address = progress.peer.address;
                tracing::warn!(%address, "response timeout: connection closed");
            }
        }
    }

    fn now_ms(&self) -> u64 {
        u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX)
    }

    fn open(&self) -> MutexGuard<'_, Slab<Arc<Progress>>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The place of a response among the [`Responses`].
pub struct ResponseTimeout {
    responses: Arc<Responses>,
    key: usize,
    progress: Arc<Progress>,
}

impl ResponseTimeout {
    /// Records that the transport polled; `is_waiting` if there was nothing to send.
    fn polled(&self, is_waiting: bool) {
        let Progress {
            polled_ms,
            is_waiting: known,
            ..
        } = self.progress.as_ref();
        polled_ms.store(self.responses.now_ms(), Ordering::Relaxed);
        known.store(is_waiting, Ordering::Relaxed);
    }
}

impl Drop for ResponseTimeout {
    fn drop(&mut self) {
        self.responses.open().try_remove(self.key);
    }
}

/// Splits a body into short data frames.
pub fn in_pieces(body: Body, timeout: Option<ResponseTimeout>) -> Body {
    Body::new(Pieces {
        body,
        rest: Bytes::new(),
        timeout,
    })
}

struct Pieces {
    body: Body,
    /// Remainder of the body's last frame.
    rest: Bytes,
    timeout: Option<ResponseTimeout>,
}

impl http_body::Body for Pieces {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.rest.is_empty() {
            let polled = Pin::new(&mut self.body).poll_frame(context);
            if let Some(timeout) = &self.timeout {
                timeout.polled(polled.is_pending());
            }

            let Poll::Ready(Some(Ok(frame))) = polled else {
                return polled;
            };
            match frame.into_data() {
                Ok(data) => self.rest = data,
                Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
            }
        }

        if let Some(timeout) = &self.timeout {
            timeout.polled(false);
        }
        let length = self.rest.len().min(PIECE);
        let piece = self.rest.split_to(length);
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use http_body_util::{BodyExt, Full};

    /// Oracle: the definition: the same bytes, in full pieces and a shorter last one.
    #[tokio::test]
    async fn a_body_is_the_same_in_pieces() {
        let bytes: Vec<u8> = (0..PIECE * 2 + 5).map(|at| at as u8).collect();
        let mut body = in_pieces(Body::new(Full::new(Bytes::from(bytes.clone()))), None);

        let mut lengths = Vec::new();
        let mut all = Vec::new();
        while let Some(frame) = body.frame().await {
            let data = frame.unwrap().into_data().unwrap();
            lengths.push(data.len());
            all.extend(data);
        }
        assert_eq!(lengths, [PIECE, PIECE, 5]);
        assert_eq!(all, bytes);
    }
}

//! Sending responses to slow callers.
//!
//! HTTP/2 sends only what fits the caller's flow-control window and waits indefinitely with the
//! rest. Data that the transport has accepted is no longer counted, and it accepts a whole data
//! frame as soon as one byte fits. Frames are therefore kept short.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http_body::{Frame, SizeHint};
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tonic::Status;
use tonic::body::Body;

use super::super::connections::Peer;

/// Maximum data frame size, bytes; HTTP/2's default.
const PIECE: usize = 16 << 10;

/// Progress timeout of a response. A caller that receives nothing for that time, while there is
/// something to receive, loses its connection: data in flight cannot be withdrawn otherwise.
pub struct ResponseTimeout {
    progress: Arc<Progress>,
    waiting: JoinHandle<()>,
}

#[derive(Default)]
struct Progress {
    /// Notified whenever the transport polls for a piece.
    polled: Notify,
    /// Whether the handler has nothing to send: the caller need not receive anything.
    is_waiting: AtomicBool,
}

impl ResponseTimeout {
    /// Starts the timeout.
    pub fn new(peer: Peer, limit: Duration) -> Self {
        let progress = Arc::new(Progress::default());
        let watched = progress.clone();
        let waiting = tokio::spawn(async move {
            loop {
                let polled = tokio::time::timeout(limit, watched.polled.notified()).await;
                if polled.is_err() && !watched.is_waiting.load(Ordering::Relaxed) {
                    break;
                }
            }
            if peer.close() {
                let address = peer.address;
                tracing::warn!(%address, "response timeout: connection closed");
            }
        });

        Self { progress, waiting }
    }

    /// Records that the transport polled; `is_waiting` if there was nothing to send.
    fn polled(&self, is_waiting: bool) {
        self.progress
            .is_waiting
            .store(is_waiting, Ordering::Relaxed);
        self.progress.polled.notify_one();
    }
}

impl Drop for ResponseTimeout {
    fn drop(&mut self) {
        self.waiting.abort();
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

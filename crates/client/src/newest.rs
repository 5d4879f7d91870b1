//! Newest-frame mode: a camera that is faster than the server skips frames instead of falling
//! behind.

use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use tokio::task::JoinHandle;
use tokio_stream::{Stream, StreamExt};

/// The newest items of a stream, which a task reads as fast as it gives them.
///
/// An item that a newer one replaces before it is asked for is dropped and counted. The last item
/// is always returned. Dropping this ends the task.
///
/// Requests of a camera pass through it on their way to [`crate::Client::track`]; with
/// `BACK_PRESSURE_NEWEST`, the server skips frames too:
///
/// ```no_run
/// # use seese3_client::{Client, Error, Newest, proto::v1 as pb};
/// # use tokio_stream::Stream;
/// # async fn run(client: Client, frames: impl Stream<Item = pb::TrackRequest> + Send + Unpin + 'static) -> Result<(), Error> {
/// let requests = tokio_stream::iter([pb::TrackRequest::default()]); // the configuration
/// let answers = client.track(tokio_stream::StreamExt::chain(requests, Newest::of(frames))).await?;
/// # Ok(()) }
/// ```
#[derive(Debug)]
pub struct Newest<T> {
    shared: Arc<Mutex<Shared<T>>>,
    reader: JoinHandle<()>,
}

#[derive(Debug)]
struct Shared<T> {
    waiting: Option<T>,
    dropped: u64,
    is_over: bool,
    waker: Option<Waker>,
}

impl<T: Send + 'static> Newest<T> {
    /// Reads a stream on a task of the current Tokio runtime.
    ///
    /// # Panics
    /// Outside a Tokio runtime.
    pub fn of(mut source: impl Stream<Item = T> + Send + Unpin + 'static) -> Self {
        let shared = Arc::new(Mutex::new(Shared {
            waiting: None,
            dropped: 0,
            is_over: false,
            waker: None,
        }));
        let to = End(Arc::clone(&shared));
        let reader = tokio::spawn(async move {
            while let Some(item) = source.next().await {
                locked(&to.0).put(item);
            }
        });
        Self { shared, reader }
    }

    /// Number of items that were dropped.
    pub fn dropped(&self) -> u64 {
        locked(&self.shared).dropped
    }
}

/// Ends the items when it is dropped, also if the source panics.
struct End<T>(Arc<Mutex<Shared<T>>>);

impl<T> Drop for End<T> {
    fn drop(&mut self) {
        locked(&self.0).end();
    }
}

impl<T> Shared<T> {
    fn put(&mut self, item: T) {
        self.dropped += u64::from(self.waiting.replace(item).is_some());
        self.wake();
    }

    fn end(&mut self) {
        self.is_over = true;
        self.wake();
    }

    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }
}

impl<T> Stream for Newest<T> {
    type Item = T;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<T>> {
        let mut shared = locked(&self.shared);
        if let Some(item) = shared.waiting.take() {
            return Poll::Ready(Some(item));
        }
        if shared.is_over {
            return Poll::Ready(None);
        }
        shared.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

impl<T> Drop for Newest<T> {
    fn drop(&mut self) {
        self.reader.abort();
    }
}

fn locked<T>(shared: &Mutex<Shared<T>>) -> MutexGuard<'_, Shared<T>> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Five items are put before the first is asked for, then one at a time.
    #[tokio::test]
    async fn only_the_newest_item_waits() {
        let (send, receive) = tokio::sync::mpsc::unbounded_channel();
        let mut newest = Newest::of(tokio_stream::wrappers::UnboundedReceiverStream::new(
            receive,
        ));
        for number in 0..5 {
            send.send(number).unwrap();
        }
        while newest.dropped() < 4 {
            tokio::task::yield_now().await;
        }
        assert_eq!(newest.next().await, Some(4));

        for number in 5..8 {
            send.send(number).unwrap();
            assert_eq!(newest.next().await, Some(number));
        }
        send.send(8).unwrap();
        drop(send);
        assert_eq!(newest.next().await, Some(8));
        assert_eq!(newest.next().await, None);
        assert_eq!(newest.dropped(), 4);
    }

    /// Oracle: the channel, which notices that its reader is gone.
    #[tokio::test]
    async fn dropping_it_ends_the_reading() {
        let (send, receive) = tokio::sync::mpsc::unbounded_channel::<u8>();
        drop(Newest::of(
            tokio_stream::wrappers::UnboundedReceiverStream::new(receive),
        ));
        send.closed().await;
    }
}

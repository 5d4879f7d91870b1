//! Memory limit for requests, in bytes: received data, its decoded form, and responses not sent
//! yet.
//!
//! A request with one message is received completely, within a time limit, before its handler runs:
//! a slow caller costs only the bytes it has sent. The decoded size is computed before decoding,
//! see [`decoded`]. For a stream, the largest message so far counts, because a handler keeps one at
//! a time.

mod decoded;
mod layer;
mod response;

pub use layer::MemoryLayer;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use prost::Message;
use tonic::{Response, Status};

use super::Error;
use super::metrics::Metrics;
use super::status::Full;

/// Minimum size of a request, bytes: its headers, task and buffers.
const LEAST: usize = 16 << 10;

tokio::task_local! {
    /// The memory lease of the current request.
    static MEMORY_LEASE: MemoryLease;
}

/// A shared memory budget: bytes held by all requests, and their limit.
#[derive(Debug, Clone)]
pub struct Memory(Arc<Counter>);

#[derive(Debug)]
struct Counter {
    held: AtomicUsize,
    most: usize,
    /// Counts rejected requests.
    metrics: Metrics,
}

impl Memory {
    /// A budget of `most` bytes.
    pub fn new(most: usize, metrics: Metrics) -> Self {
        Self(Arc::new(Counter {
            held: AtomicUsize::new(0),
            most,
            metrics,
        }))
    }

    /// Counts a rejection and returns its error.
    fn full(&self) -> Error {
        self.0.metrics.shed(Full::Memory);
        Error::Full { what: Full::Memory }
    }

    /// Bytes currently held.
    pub fn held(&self) -> usize {
        self.0.held.load(Ordering::Relaxed)
    }

    /// Maximum decoded size of one request, bytes: a quarter of the budget, so that no single
    /// request exhausts it.
    fn largest_request(&self) -> usize {
        self.0.most / 4
    }

    /// Creates the lease of a new request.
    ///
    /// # Errors
    /// [`Error::Full`] if there is no memory for it.
    fn begin(&self) -> Result<MemoryLease, Error> {
        let held = MemoryLease(Arc::new(Share {
            memory: self.clone(),
            bytes: AtomicUsize::new(0),
        }));
        held.hold(LEAST)?;
        Ok(held)
    }
}

/// The memory held by one request, released when the last clone is dropped.
#[derive(Debug, Clone)]
struct MemoryLease(Arc<Share>);

#[derive(Debug)]
struct Share {
    memory: Memory,
    bytes: AtomicUsize,
}

impl MemoryLease {
    /// Reserves more bytes.
    ///
    /// # Errors
    /// [`Error::Full`] if the budget is exhausted; nothing is reserved then.
    fn hold(&self, bytes: usize) -> Result<(), Error> {
        let Share { memory, bytes: own } = &*self.0;
        let Counter { held, most, .. } = &*memory.0;
        let grown = |now: usize| now.checked_add(bytes).filter(|sum| sum <= most);

        held.try_update(Ordering::Relaxed, Ordering::Relaxed, grown)
            .map_err(|_| memory.full())?;
        own.fetch_add(bytes, Ordering::Relaxed);
        Ok(())
    }

    /// Reserves the decoded size of a message, bytes, less `held_already`.
    ///
    /// # Errors
    /// [`Error::Invalid`] if it exceeds the limit of one request, [`Error::Full`] if the budget is
    /// exhausted.
    fn hold_message(&self, bytes: usize, held_already: usize) -> Result<(), Error> {
        if bytes > self.0.memory.largest_request() {
            let problem = "exceeds the memory limit of one request when decoded; send less";
            return Err(Error::invalid("request", problem));
        }
        self.hold(bytes.saturating_sub(held_already))
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let bytes = *self.bytes.get_mut();
        self.memory.0.held.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// Wraps a response message, which counts as memory of the request until it is sent.
///
/// # Errors
/// RESOURCE_EXHAUSTED if there is no memory for it.
pub fn respond<A: Message>(answer: A) -> Result<Response<A>, Status> {
    // A response takes up to about twice its encoded size, and exists in both forms at once.
    let bytes = 3 * answer.encoded_len();

    // Outside of a request, as in unit tests, nothing is counted.
    MEMORY_LEASE
        .try_with(|held| held.hold(bytes))
        .unwrap_or(Ok(()))?;
    Ok(Response::new(answer))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: a message counts with its total size, in however many parts it arrives.
    #[test]
    fn a_message_is_no_larger_than_a_quarter_of_all() {
        let memory = Memory::new(40 * LEAST, Metrics::default());
        let held = memory.begin().unwrap();
        assert!(held.hold_message(6 * LEAST, 0).is_ok());
        assert!(held.hold_message(10 * LEAST, 6 * LEAST).is_ok());
        assert_eq!(memory.held(), 11 * LEAST);

        let refused = held.hold_message(10 * LEAST + 1, 10 * LEAST);
        assert!(matches!(refused, Err(Error::Invalid { .. })));
        assert_eq!(memory.held(), 11 * LEAST);
    }

    /// Oracle: by hand.
    #[test]
    fn what_is_held_is_bounded_and_free_again() {
        let memory = Memory::new(3 * LEAST, Metrics::default());
        let first = memory.begin().unwrap();
        let second = memory.begin().unwrap();
        assert!(first.hold(LEAST).is_ok());
        assert!(second.hold(1).is_err());
        assert!(memory.begin().is_err());
        assert_eq!(memory.held(), 3 * LEAST);

        drop(first);
        assert_eq!(memory.held(), LEAST);
        assert!(second.hold(usize::MAX).is_err());
        assert!(second.hold(2 * LEAST).is_ok());

        drop(second);
        assert_eq!(memory.held(), 0);
    }
}

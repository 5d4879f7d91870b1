//! A bound in bytes on what requests hold in memory: what has arrived of them, what it becomes when
//! it is decoded, and answers that were not sent yet.
//!
//! A request with one message is received as a whole, within a time limit, before a handler sees
//! it: a caller that sends slowly costs no more than the bytes that it has sent. How large the
//! message becomes is computed before it is decoded, see [`decoded`]. Of a stream of messages, the
//! largest one so far is counted, since a handler keeps one at a time.

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

/// What every request is counted for at least: its headers, its task and its buffers.
const LEAST: usize = 16 << 10;

tokio::task_local! {
    /// What the request that is being answered holds.
    static MEMORY_LEASE: MemoryLease;
}

/// The bytes that all requests hold together, and how many they may.
#[derive(Debug, Clone)]
pub struct Memory(Arc<Counter>);

#[derive(Debug)]
struct Counter {
    held: AtomicUsize,
    most: usize,
    /// Counts what is refused.
    metrics: Metrics,
}

impl Memory {
    /// Memory of which at most `most` bytes are held.
    pub fn new(most: usize, metrics: Metrics) -> Self {
        Self(Arc::new(Counter {
            held: AtomicUsize::new(0),
            most,
            metrics,
        }))
    }

    /// The refusal of a request for which there is no memory, which is counted.
    fn full(&self) -> Error {
        self.0.metrics.shed(Full::Memory);
        Error::Full { what: Full::Memory }
    }

    /// The bytes that are held now.
    pub fn held(&self) -> usize {
        self.0.held.load(Ordering::Relaxed)
    }

    /// The largest size of one decoded request, bytes: a quarter of all, so that none is
    /// everything.
    fn largest_request(&self) -> usize {
        self.0.most / 4
    }

    /// What a new request holds.
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

/// What one request holds. It is free again when the last clone is dropped.
#[derive(Debug, Clone)]
struct MemoryLease(Arc<Share>);

#[derive(Debug)]
struct Share {
    memory: Memory,
    bytes: AtomicUsize,
}

impl MemoryLease {
    /// Holds more bytes.
    ///
    /// # Errors
    /// [`Error::Full`] if there is no memory for them; then nothing changes.
    fn hold(&self, bytes: usize) -> Result<(), Error> {
        let Share { memory, bytes: own } = &*self.0;
        let Counter { held, most, .. } = &*memory.0;
        let grown = |now: usize| now.checked_add(bytes).filter(|sum| sum <= most);

        held.try_update(Ordering::Relaxed, Ordering::Relaxed, grown)
            .map_err(|_| memory.full())?;
        own.fetch_add(bytes, Ordering::Relaxed);
        Ok(())
    }

    /// Holds what a message takes when it is decoded, bytes, of which some are held already.
    ///
    /// # Errors
    /// [`Error::Invalid`] if it takes more than one request may, [`Error::Full`] if there is no memory
    /// for it now.
    fn hold_message(&self, bytes: usize, held_already: usize) -> Result<(), Error> {
        if bytes > self.0.memory.largest_request() {
            let problem = "takes more memory when it is decoded than one request may; send less";
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

/// The response with this answer, which counts as memory of the request until it is sent.
///
/// # Errors
/// RESOURCE_EXHAUSTED if there is no memory for it.
pub fn respond<A: Message>(answer: A) -> Result<Response<A>, Status> {
    // In memory an answer is at most about twice as large as encoded, and it is both at once.
    let bytes = 3 * answer.encoded_len();

    // Outside of a request, as in a unit test, nothing is counted.
    MEMORY_LEASE
        .try_with(|held| held.hold(bytes))
        .unwrap_or(Ok(()))?;
    Ok(Response::new(answer))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: a message counts as a whole, in however many parts it arrives.
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

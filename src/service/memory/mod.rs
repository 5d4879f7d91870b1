//! A bound in bytes on what requests hold in memory: what has arrived of them, what it becomes when
//! it is decoded, and answers that were not sent yet.
//!
//! A request with one message is received as a whole, within a time limit, before a handler sees it:
//! a caller that sends slowly costs no more than the bytes that it has sent. How large the message
//! becomes is computed before it is decoded, see [`decoded`]. Of a stream of messages, the
//! largest one so far is counted, since a handler keeps one at a time.

mod decoded;
mod layer;

pub use layer::MemoryLayer;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use prost::Message;

use super::Error;
use super::metrics::Metrics;
use super::status::Full;

/// What every request is counted for at least: its headers, its task and its buffers.
const LEAST: usize = 16 << 10;

tokio::task_local! {
    /// What the request that is being answered holds.
    static HELD: Held;
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

    /// The largest size of one decoded request, bytes: a quarter of all, so that none is everything.
    fn largest_request(&self) -> usize {
        self.0.most / 4
    }

    /// What a new request holds; none if there is no memory for it.
    fn begin(&self) -> Option<Held> {
        let share = Share {
            memory: self.clone(),
            bytes: AtomicUsize::new(0),
        };
        share.hold(LEAST).then(|| Held(Arc::new(share)))
    }
}

/// What one request holds. It is free again when the last clone is dropped.
#[derive(Debug, Clone)]
struct Held(Arc<Share>);

#[derive(Debug)]
struct Share {
    memory: Memory,
    bytes: AtomicUsize,
}

impl Share {
    /// Holds more bytes. Returns whether there is memory for them; if not, nothing changes.
    fn hold(&self, bytes: usize) -> bool {
        let Counter { held, most, .. } = &*self.memory.0;
        let grown = |now: usize| now.checked_add(bytes).filter(|sum| sum <= most);
        let is_held = held
            .try_update(Ordering::Relaxed, Ordering::Relaxed, grown)
            .is_ok();

        if is_held {
            self.bytes.fetch_add(bytes, Ordering::Relaxed);
        }
        is_held
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let bytes = *self.bytes.get_mut();
        self.memory.0.held.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// Counts an answer until it is sent: as it is, and as it is encoded.
///
/// # Errors
/// [`Error::Full`] if there is no memory for it.
pub fn hold_answer<A: Message>(answer: A) -> Result<A, Error> {
    // In memory an answer is at most about twice as large as encoded, and it is both at once.
    let bytes = 3 * answer.encoded_len();

    let counted = HELD.try_with(|held| match held.0.hold(bytes) {
        true => Ok(()),
        false => Err(held.0.memory.full()),
    });
    // Outside of a request, as in a unit test, nothing is counted.
    counted.unwrap_or(Ok(()))?;
    Ok(answer)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn what_is_held_is_bounded_and_free_again() {
        let memory = Memory::new(3 * LEAST, Metrics::default());
        let first = memory.begin().unwrap();
        let second = memory.begin().unwrap();
        assert!(first.0.hold(LEAST));
        assert!(!second.0.hold(1));
        assert!(memory.begin().is_none());
        assert_eq!(memory.held(), 3 * LEAST);

        drop(first);
        assert_eq!(memory.held(), LEAST);
        assert!(!second.0.hold(usize::MAX));
        assert!(second.0.hold(2 * LEAST));

        drop(second);
        assert_eq!(memory.held(), 0);
    }
}

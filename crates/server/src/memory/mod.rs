//! Memory limit for requests, in bytes: received data, its decoded form, and responses not sent
//! yet. Callers share it, see [`Shares`].
//!
//! A request with one message is received completely, within a time limit, before its handler runs:
//! a slow caller costs only the bytes it has sent. The decoded size is computed before decoding,
//! see [`decoded`]. A message of a stream counts until its handler has processed it, see
//! [`stream`].

mod decoded;
mod layer;
mod response;
mod stream;

pub use layer::MemoryLayer;
pub use response::Responses;
pub use stream::StreamMemory;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use prost::Message;
use tonic::{Response, Status};

use super::Error;
use super::caller::CallerId;
use super::metrics::Metrics;
use super::shares::{Exhausted, Share, Shares};
use super::status::Full;

/// Minimum size of a request, bytes: its headers, task and buffers.
const LEAST: usize = 16 << 10;

tokio::task_local! {
    /// The memory lease of the current request.
    static MEMORY_LEASE: MemoryLease;
}

/// The memory budget of all requests.
#[derive(Debug, Clone)]
pub struct Memory {
    shares: Arc<Shares>,
    /// Counts rejected requests.
    metrics: Metrics,
}

impl Memory {
    /// A budget of `most` bytes.
    pub fn new(most: usize, metrics: Metrics) -> Self {
        Self {
            shares: Shares::new(most),
            metrics,
        }
    }

    /// Counts a rejection and returns its error.
    fn full(&self, limit: Exhausted) -> Error {
        let what = match limit {
            Exhausted::Budget => Full::Memory,
            Exhausted::Share => Full::CallersMemory,
        };
        self.metrics.shed(what);
        Error::Full { what }
    }

    /// Bytes currently held.
    pub fn held(&self) -> usize {
        self.shares.held()
    }

    /// Maximum decoded size of one request, bytes: a quarter of the budget, half of the share of a
    /// single caller.
    fn largest_request(&self) -> usize {
        self.shares.budget() / 4
    }

    /// Creates the lease of a new request.
    ///
    /// # Errors
    /// [`Error::Full`] if there is no memory for it.
    fn begin(&self, caller: CallerId) -> Result<MemoryLease, Error> {
        let share = self.shares.take(caller.clone(), LEAST);
        let share = share.map_err(|limit| self.full(limit))?;
        Ok(MemoryLease {
            memory: self.clone(),
            caller,
            share: Arc::new(Mutex::new(share)),
            answer: Arc::default(),
        })
    }
}

/// The memory held by one request, released when the last clone is dropped.
#[derive(Debug, Clone)]
pub struct MemoryLease {
    memory: Memory,
    caller: CallerId,
    share: Arc<Mutex<Share>>,
    /// Bytes reserved for the answer by [`hold_for_answer`].
    answer: Arc<AtomicUsize>,
}

impl MemoryLease {
    /// The lease of the current request. `None` outside of a request, as in unit tests.
    pub fn current() -> Option<Self> {
        MEMORY_LEASE.try_with(Self::clone).ok()
    }

    /// Reserves more bytes.
    ///
    /// # Errors
    /// [`Error::Full`] if the budget or the caller's share of it is exhausted; nothing is reserved
    /// then.
    pub fn hold(&self, bytes: usize) -> Result<(), Error> {
        let grown = self.share().grow(bytes);
        grown.map_err(|limit| self.memory.full(limit))
    }

    /// Returns bytes that were reserved.
    pub fn release(&self, bytes: usize) {
        self.share().shrink(bytes);
    }

    /// Reserves the decoded size of a message, bytes.
    ///
    /// # Errors
    /// [`Error::Invalid`] if it exceeds the limit of one request, [`Error::Full`] if the budget is
    /// exhausted.
    fn hold_message(&self, bytes: usize) -> Result<(), Error> {
        self.check_message(bytes)?;
        self.hold(bytes)
    }

    fn check_message(&self, bytes: usize) -> Result<(), Error> {
        if bytes > self.memory.largest_request() {
            let problem = "exceeds the memory limit of one request when decoded; send less";
            return Err(Error::invalid("request", problem));
        }
        Ok(())
    }

    fn share(&self) -> MutexGuard<'_, Share> {
        self.share.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Reserves the memory of an answer before it is computed, from an upper bound of its encoded size,
/// bytes. [`respond`] replaces it by the actual size.
///
/// # Errors
/// [`Error::Full`] if there is no memory for it.
pub fn hold_for_answer(encoded: usize) -> Result<(), Error> {
    let Some(lease) = MemoryLease::current() else {
        return Ok(());
    };
    let bytes = answer_bytes(encoded);
    lease.hold(bytes)?;
    lease.answer.fetch_add(bytes, Ordering::Relaxed);
    Ok(())
}

/// Passes the current request's lease to `work`, which runs on another thread.
pub fn with_lease<C: ?Sized, T>(
    work: impl FnOnce(&C) -> T + Send + 'static,
) -> impl FnOnce(&C) -> T + Send + 'static {
    let lease = MemoryLease::current();
    move |context| match lease {
        Some(lease) => MEMORY_LEASE.sync_scope(lease, || work(context)),
        None => work(context),
    }
}

/// Wraps a response message, which counts as memory of the request until it is sent.
///
/// # Errors
/// RESOURCE_EXHAUSTED if there is no memory for it.
pub fn respond<A: Message>(answer: A) -> Result<Response<A>, Status> {
    let bytes = answer_bytes(answer.encoded_len());
    if let Some(lease) = MemoryLease::current() {
        let reserved = lease.answer.swap(0, Ordering::Relaxed);
        lease.release(reserved.saturating_sub(bytes));
        lease.hold(bytes.saturating_sub(reserved))?;
    }
    Ok(Response::new(answer))
}

/// Memory of an answer with this encoded size, bytes. An answer takes up to about twice its encoded
/// size, and exists in both forms at once.
fn answer_bytes(encoded: usize) -> usize {
    encoded.saturating_mul(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn memory(most: usize) -> Memory {
        Memory::new(most, Metrics::default())
    }

    fn caller(number: u64) -> CallerId {
        CallerId::Connection(number)
    }

    /// Oracle: by hand: a quarter of 40 units is the limit of a message.
    #[test]
    fn a_message_is_no_larger_than_a_quarter_of_all() {
        let memory = memory(40 * LEAST);
        let held = memory.begin(caller(1)).unwrap();
        assert!(held.hold_message(10 * LEAST).is_ok());
        assert_eq!(memory.held(), 11 * LEAST);

        let refused = held.hold_message(10 * LEAST + 1);
        assert!(matches!(refused, Err(Error::Invalid { .. })));
        assert_eq!(memory.held(), 11 * LEAST);
    }

    /// Oracle: by hand, from the rule of the shares: half of six units, then half of the rest.
    #[test]
    fn what_is_held_is_bounded_and_free_again() {
        let memory = memory(6 * LEAST);
        let first = memory.begin(caller(1)).unwrap();
        assert!(first.hold(2 * LEAST).is_ok());
        let full = |what| Err(Error::Full { what });
        assert_eq!(first.hold(1), full(Full::CallersMemory));
        assert_eq!(first.hold(4 * LEAST), full(Full::Memory));
        assert_eq!(memory.held(), 3 * LEAST);

        let second = memory.begin(caller(2)).unwrap();
        assert_eq!(memory.held(), 4 * LEAST);
        second.release(LEAST);
        drop(first);
        assert_eq!(memory.held(), 0);
    }
}

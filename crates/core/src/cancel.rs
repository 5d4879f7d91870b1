//! A flag with which a caller asks long work to stop, because nobody waits for its result any more.

use std::sync::atomic::{AtomicBool, Ordering};

/// Set once by the caller; the work reads it between its steps.
#[derive(Debug, Default)]
pub struct Cancellation(AtomicBool);

/// The work was abandoned before it was complete.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq, Eq)]
#[error("cancelled: the deadline passed or the caller went away")]
pub struct Cancelled;

impl Cancellation {
    /// Asks the work to stop.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Returns an error if the work was asked to stop.
    ///
    /// # Errors
    /// [`Cancelled`] after [`Cancellation::cancel`] was called.
    pub fn check(&self) -> Result<(), Cancelled> {
        if self.0.load(Ordering::Relaxed) {
            Err(Cancelled)
        } else {
            Ok(())
        }
    }
}

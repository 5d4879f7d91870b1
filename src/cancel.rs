//! A flag by which the one who asked for long work says that nobody waits for it any more.

use std::sync::atomic::{AtomicBool, Ordering};

/// Set once, read between pieces of work.
#[derive(Debug, Default)]
pub struct Cancellation(AtomicBool);

/// The work was given up before it was done.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq, Eq)]
#[error("cancelled: the deadline passed or the caller went away")]
pub struct Cancelled;

impl Cancellation {
    /// Asks the work to stop.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Goes on, unless the work was asked to stop.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn check(&self) -> Result<(), Cancelled> {
        if self.0.load(Ordering::Relaxed) {
            Err(Cancelled)
        } else {
            Ok(())
        }
    }
}

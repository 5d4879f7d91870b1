//! A cancellation flag for long computations.

use std::sync::atomic::{AtomicBool, Ordering};

/// Set by the caller; checked by the computation between steps.
#[derive(Debug, Default)]
pub struct Cancellation(AtomicBool);

/// The computation was cancelled.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq, Eq)]
#[error("cancelled: the deadline passed or the caller disconnected")]
pub struct Cancelled;

impl Cancellation {
    /// Requests cancellation.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Returns an error if cancellation was requested.
    ///
    /// # Errors
    /// [`Cancelled`] after [`Cancellation::cancel`].
    pub fn check(&self) -> Result<(), Cancelled> {
        if self.0.load(Ordering::Relaxed) {
            Err(Cancelled)
        } else {
            Ok(())
        }
    }
}

//! A cancellation flag for long computations.

use std::sync::atomic::{AtomicBool, Ordering};

/// Set by the caller; checked by the computation between steps.
#[derive(Debug, Default)]
pub struct Cancellation {
    is_requested: AtomicBool,
    checkpoint: Option<fn()>,
}

/// The computation was cancelled.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq, Eq)]
#[error("cancelled: the deadline passed or the caller disconnected")]
pub struct Cancelled;

impl Cancellation {
    /// A flag that is not set.
    pub const fn new() -> Self {
        Self {
            is_requested: AtomicBool::new(false),
            checkpoint: None,
        }
    }

    /// Calls `checkpoint` at each check, on the thread that checks. It may block, for instance to
    /// let other computations use the processor.
    pub fn with_checkpoint(checkpoint: fn()) -> Self {
        Self {
            checkpoint: Some(checkpoint),
            ..Self::new()
        }
    }

    /// Requests cancellation.
    pub fn cancel(&self) {
        self.is_requested.store(true, Ordering::Relaxed);
    }

    /// Returns an error if cancellation was requested.
    ///
    /// # Errors
    /// [`Cancelled`] after [`Cancellation::cancel`].
    pub fn check(&self) -> Result<(), Cancelled> {
        if let Some(checkpoint) = self.checkpoint {
            checkpoint();
        }
        if self.is_requested.load(Ordering::Relaxed) {
            return Err(Cancelled);
        }
        Ok(())
    }
}

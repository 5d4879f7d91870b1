//! Time limit of publications.
//!
//! A publication writes its objects first and its manifest last. Until then no manifest references
//! the objects, and only their age protects them from garbage collection. Two limits together make
//! that protection certain:
//!
//! - Garbage collection removes only files that are older than [`GRACE`] by the store's own clock.
//! - A publication that has taken longer than [`LONGEST_PUBLICATION`] writes no manifest.
//!
//! The difference between the two is time for writing the manifest itself.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Error;

/// Minimum age of files that garbage collection removes.
pub const GRACE: Duration = Duration::from_secs(3_600);
/// Maximum time from the first read or write of a publication to its manifest.
pub const LONGEST_PUBLICATION: Duration = Duration::from_secs(2_700);

/// Measures time since an arbitrary start. It need not agree with the clock of the store.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> Duration + Send + Sync>);

impl Clock {
    /// A clock that reads `elapsed`.
    pub fn new(elapsed: impl Fn() -> Duration + Send + Sync + 'static) -> Self {
        Self(Arc::new(elapsed))
    }

    pub(super) fn elapsed(&self) -> Duration {
        (self.0)()
    }
}

impl Default for Clock {
    /// The monotonic clock of this machine.
    fn default() -> Self {
        let start = Instant::now();
        Self::new(move || start.elapsed())
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Clock")
    }
}

/// A publication in progress.
pub(super) struct Publication {
    clock: Clock,
    began: Duration,
}

impl Publication {
    /// Begins a publication. Everything that its manifest references is read or written later.
    pub fn begin(clock: &Clock) -> Self {
        Self {
            clock: clock.clone(),
            began: clock.elapsed(),
        }
    }

    /// Checks that the manifest may still be written.
    ///
    /// # Errors
    /// [`Error::TooSlow`] after [`LONGEST_PUBLICATION`].
    pub fn check(&self, manifest: &str) -> Result<(), Error> {
        if self.clock.elapsed() - self.began <= LONGEST_PUBLICATION {
            return Ok(());
        }
        Err(Error::TooSlow {
            manifest: manifest.to_owned(),
        })
    }
}

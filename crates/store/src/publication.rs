//! Conditions of publications: quotas and a time limit.
//!
//! When a quota is reached, a publication writes nothing. It still succeeds if the newest revision
//! has the same content.
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

use super::{Error, Kind, Store};

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

/// What an upload may change. The same content again is always accepted and changes nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UploadPolicy {
    /// Creates a room or an adapter; one of this name must not exist.
    Create,
    /// Publishes a new revision of a room or an adapter that exists.
    Replace,
}

impl Store {
    /// Checks the condition of an upload that is not the same content again. `newest` is the newest
    /// revision of the room or adapter.
    ///
    /// # Errors
    /// [`Error::Exists`] or [`Error::Unknown`].
    pub(super) async fn check_policy(
        &self,
        kind: Kind,
        name: &str,
        newest: Option<u64>,
        policy: UploadPolicy,
    ) -> Result<(), Error> {
        match (policy, newest) {
            (UploadPolicy::Create, None) | (UploadPolicy::Replace, Some(_)) => Ok(()),
            (UploadPolicy::Create, Some(revision)) => Err(Error::Exists {
                kind: kind.into(),
                name: name.to_owned(),
                revision,
            }),
            (UploadPolicy::Replace, None) => Err(Error::Unknown {
                kind: kind.into(),
                name: name.to_owned(),
                known: self.names(kind).await?,
            }),
        }
    }
}

/// A publication in progress.
pub(super) struct Publication {
    clock: Clock,
    began: Duration,
    /// The quota that is reached, if one is.
    quota: Option<String>,
}

impl Publication {
    /// Begins a publication of a room, or of an adapter that belongs to it. Everything that its
    /// manifest references is read or written later.
    ///
    /// # Errors
    /// [`Error::Io`] if the store's usage cannot be read.
    pub async fn begin(store: &Store, room: Option<&str>) -> Result<Self, Error> {
        let began = store.clock.elapsed();
        let quota = match store.check_quotas(room).await {
            Ok(()) => None,
            Err(Error::Quota { used }) => Some(used),
            Err(error) => return Err(error),
        };

        Ok(Self {
            clock: store.clock.clone(),
            began,
            quota,
        })
    }

    /// Whether objects may be written.
    pub fn may_write(&self) -> bool {
        self.quota.is_none()
    }

    /// Checks that the manifest may be written.
    ///
    /// # Errors
    /// [`Error::Quota`] at a quota, [`Error::TooSlow`] after [`LONGEST_PUBLICATION`].
    pub fn check(&self, manifest: &str) -> Result<(), Error> {
        if let Some(used) = &self.quota {
            return Err(Error::Quota { used: used.clone() });
        }
        if self.clock.elapsed() - self.began <= LONGEST_PUBLICATION {
            return Ok(());
        }
        Err(Error::TooSlow {
            manifest: manifest.to_owned(),
        })
    }
}

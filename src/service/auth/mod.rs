//! Who may call, and what for.
//!
//! A server without credentials answers everybody. Once there are any, a call without one is
//! refused, and a caller sees only the rooms of its own: for everything else, a room outside of them
//! does not exist.
//!
//! | file | what |
//! | --- | --- |
//! | `credentials` | the file that an operator writes |
//! | `layer` | the check of every request |

mod credentials;
mod layer;

pub use credentials::{AuthError, Keyring};
pub use layer::AuthLayer;

use std::sync::Arc;

use serde::Deserialize;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// What a call is for. Each RPC belongs to one verb.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Verb {
    /// NavigationService.
    Navigate,
    /// LocalizationService.
    Localize,
    /// OdometryService: the motion between views, and tracking.
    Track,
    /// EvaluationService.
    Evaluate,
    /// What CatalogService lists, and reflection.
    Catalog,
    /// What CatalogService changes.
    Write,
}

impl Verb {
    /// The name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Navigate => "navigate",
            Self::Localize => "localize",
            Self::Track => "track",
            Self::Evaluate => "evaluate",
            Self::Catalog => "catalog",
            Self::Write => "write",
        }
    }
}

/// The rooms that a caller may see: names, or beginnings of names with a `*` behind them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RoomScope(Vec<String>);

impl RoomScope {
    /// Whether the room may be seen.
    pub fn contains(&self, room: &str) -> bool {
        self.0.iter().any(|given| match given.strip_suffix('*') {
            Some(beginning) => room.starts_with(beginning),
            None => room == given,
        })
    }

    /// Whether every room may be seen, whatever its name.
    pub fn is_all(&self) -> bool {
        self.0.iter().any(|given| given == "*")
    }
}

/// What a caller may do, as an operator gave it.
#[derive(Debug, PartialEq, Eq)]
struct Rights {
    name: String,
    verbs: Vec<Verb>,
    rooms: RoomScope,
    /// Track streams at a time.
    streams: usize,
    /// Requests and streams at a time.
    requests: usize,
}

/// A caller that is known, and what it has open.
#[derive(Debug)]
pub struct Principal {
    rights: Rights,
    streams: Arc<Semaphore>,
    requests: Arc<Semaphore>,
}

impl Principal {
    fn new(rights: Rights) -> Self {
        Self {
            streams: Arc::new(Semaphore::new(rights.streams)),
            requests: Arc::new(Semaphore::new(rights.requests)),
            rights,
        }
    }

    /// Its name, for the log.
    pub fn name(&self) -> &str {
        &self.rights.name
    }

    /// The rooms that it may see.
    pub fn rooms(&self) -> &RoomScope {
        &self.rights.rooms
    }

    fn may(&self, verb: Verb) -> bool {
        self.rights.verbs.contains(&verb)
    }

    /// A place for one more Track stream; none if it has as many as it may.
    pub fn stream_place(&self) -> Option<OwnedSemaphorePermit> {
        self.streams.clone().try_acquire_owned().ok()
    }

    /// A place for one more request or stream of any kind; none if it has as many as it may.
    fn request_place(&self) -> Option<OwnedSemaphorePermit> {
        self.requests.clone().try_acquire_owned().ok()
    }
}

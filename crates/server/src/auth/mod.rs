//! Who may call, and what for.
//!
//! A server without credentials answers everybody. Once there are any, a call without one is
//! refused, and a caller sees only the rooms of its own: for everything else, a room outside of
//! them does not exist.
//!
//! | file | what |
//! | --- | --- |
//! | `credentials` | the file that an operator writes |
//! | `issuers` | tokens that others signed (JWT) |
//! | `layer` | the check of every request |

mod credentials;
mod issuer_form;
mod issuers;
mod signed_tokens;
mod layer;

pub use credentials::{AuthError, Keyring};
pub use layer::AuthLayer;

use std::sync::Arc;
use std::time::SystemTime;

use issuers::Issuer;
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

/// The rooms that a caller may see: those that are in each of these lists. A list has names, and
/// beginnings of names with a `*` behind them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RoomScope(Vec<Vec<String>>);

impl RoomScope {
    /// Whether the room may be seen.
    pub fn contains(&self, room: &str) -> bool {
        let covers = |given: &String| match given.strip_suffix('*') {
            Some(beginning) => room.starts_with(beginning),
            None => room == given,
        };
        self.0.iter().all(|list| list.iter().any(covers))
    }

    /// Whether every room may be seen, whatever its name.
    pub fn is_all(&self) -> bool {
        let is_all = |list: &Vec<String>| list.iter().any(|given| given == "*");
        self.0.iter().all(is_all)
    }
}

/// What a caller may do.
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

/// What a caller has open: the places that are left.
#[derive(Debug)]
struct Places {
    streams: Arc<Semaphore>,
    requests: Arc<Semaphore>,
}

impl Places {
    fn new(rights: &Rights) -> Self {
        Self {
            streams: Arc::new(Semaphore::new(rights.streams)),
            requests: Arc::new(Semaphore::new(rights.requests)),
        }
    }
}

/// By whose signature a caller is known.
#[derive(Debug)]
struct Signed {
    issuer: Arc<Issuer>,
    /// When the token ends, if ever.
    until: Option<SystemTime>,
}

/// A caller that is known.
#[derive(Debug)]
pub struct Principal {
    rights: Rights,
    places: Arc<Places>,
    /// None if the file of credentials itself knows the caller.
    signed: Option<Signed>,
}

impl Principal {
    fn new(rights: Rights) -> Self {
        Self {
            places: Arc::new(Places::new(&rights)),
            rights,
            signed: None,
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
        self.places.streams.clone().try_acquire_owned().ok()
    }

    /// A place for one more request or stream of any kind; none if it has as many as it may.
    fn request_place(&self) -> Option<OwnedSemaphorePermit> {
        self.places.requests.clone().try_acquire_owned().ok()
    }
}

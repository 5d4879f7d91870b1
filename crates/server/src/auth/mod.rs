//! Authentication and authorization.
//!
//! Without an auth file, the server accepts every call. With one, a call without valid credentials
//! is rejected, and a caller sees only its own rooms: other rooms are reported as nonexistent.
//!
//! | file | what |
//! | --- | --- |
//! | `credentials` | the operator's auth file |
//! | `issuers` | tokens signed by external issuers (JWT) |
//! | `layer` | checks every request |

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
use seese3_store::Quota;
use serde::Deserialize;
use strum::IntoStaticStr;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// The permission that an RPC requires; each RPC requires one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, IntoStaticStr)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Verb {
    /// NavigationService.
    Navigate,
    /// LocalizationService.
    Localize,
    /// OdometryService: two-view motion and tracking.
    Track,
    /// EvaluationService.
    Evaluate,
    /// Read access to CatalogService without downloads, and reflection.
    Catalog,
    /// Downloads of rooms and adapters.
    Download,
    /// Write access to CatalogService.
    Write,
}

/// The rooms that a caller may access: those that match every list. A list has room names and
/// prefixes ending in `*`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RoomScope(Vec<Vec<String>>);

impl RoomScope {
    /// Whether the room may be accessed.
    pub fn contains(&self, room: &str) -> bool {
        let covers = |given: &String| match given.strip_suffix('*') {
            Some(beginning) => room.starts_with(beginning),
            None => room == given,
        };
        self.0.iter().all(|list| list.iter().any(covers))
    }

    /// Whether all rooms may be accessed.
    pub fn is_all(&self) -> bool {
        let is_all = |list: &Vec<String>| list.iter().any(|given| given == "*");
        self.0.iter().all(is_all)
    }
}

/// The rights of a caller.
#[derive(Debug, PartialEq, Eq)]
struct Rights {
    name: Arc<str>,
    verbs: Vec<Verb>,
    rooms: RoomScope,
    /// Maximum number of concurrent Track streams.
    streams: usize,
    /// Maximum number of concurrent requests and streams.
    requests: usize,
    /// The most that its rooms may take in the store.
    quota: Quota,
}

/// Semaphores of a caller's concurrency limits.
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

/// The issuer and expiry of a caller's signed token.
#[derive(Debug)]
struct Signed {
    issuer: Arc<Issuer>,
    /// Expiry time; `None` if it is too far in the future to represent.
    until: Option<SystemTime>,
}

/// An authenticated caller.
#[derive(Debug)]
pub struct Principal {
    rights: Rights,
    places: Arc<Places>,
    /// `None` if the auth file lists the caller itself.
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

    /// The caller's name, for the log.
    pub fn name(&self) -> &str {
        &self.rights.name
    }

    /// The caller's name, shared.
    pub fn shared_name(&self) -> Arc<str> {
        self.rights.name.clone()
    }

    /// The most that its rooms may take in the store.
    pub fn quota(&self) -> Quota {
        self.rights.quota
    }

    /// The rooms that it may access.
    pub fn rooms(&self) -> &RoomScope {
        &self.rights.rooms
    }

    pub fn may(&self, verb: Verb) -> bool {
        self.rights.verbs.contains(&verb)
    }

    /// A permit for one more Track stream; `None` at the limit.
    pub fn stream_place(&self) -> Option<OwnedSemaphorePermit> {
        self.places.streams.clone().try_acquire_owned().ok()
    }

    /// A permit for one more request or stream of any kind; `None` at the limit.
    fn request_place(&self) -> Option<OwnedSemaphorePermit> {
        self.places.requests.clone().try_acquire_owned().ok()
    }
}

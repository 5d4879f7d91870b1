//! The identity by which memory, queue places and worker time are divided.

use std::fmt;
use std::sync::Arc;

use http::Extensions;
use tonic::Request;

use super::auth::{Principal, RoomScope};
use super::connections::Peer;
use seese3_store::Quota;

/// A caller: the authenticated principal, or the connection on a server without credentials.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CallerId {
    /// Name of a principal. All tokens of one subject have the same name.
    Principal(Arc<str>),
    /// Number of a connection.
    Connection(u64),
    /// Unknown, as in unit tests without a connection.
    Unknown,
}

impl CallerId {
    /// The caller of a request with these extensions.
    pub fn of(extensions: &Extensions) -> Self {
        if let Some(principal) = extensions.get::<Arc<Principal>>() {
            return Self::Principal(principal.shared_name());
        }
        Self::connection(extensions)
    }

    /// The connection of a request, whoever the principal is.
    pub fn connection(extensions: &Extensions) -> Self {
        match extensions.get::<Peer>() {
            Some(peer) => Self::Connection(peer.id),
            None => Self::Unknown,
        }
    }
}

impl fmt::Display for CallerId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Principal(name) => write!(formatter, "{name}"),
            Self::Connection(number) => write!(formatter, "connection {number}"),
            Self::Unknown => write!(formatter, "unknown"),
        }
    }
}

/// The caller of a change.
#[derive(Debug, Clone)]
pub struct Requester {
    /// The authenticated caller; `None` on a server without credentials.
    principal: Option<Arc<Principal>>,
    /// The caller that is charged for the change.
    pub id: CallerId,
}

impl Requester {
    /// The caller of a request.
    pub fn of<T>(request: &Request<T>) -> Self {
        Self {
            principal: request.extensions().get().cloned(),
            id: CallerId::of(request.extensions()),
        }
    }

    /// The rooms that it may access; `None` for all.
    pub fn scope(&self) -> Option<&RoomScope> {
        let principal = self.principal.as_ref();
        principal.map(|principal| principal.rooms())
    }

    /// What it may store.
    pub fn quota(&self) -> Quota {
        let principal = self.principal.as_ref();
        principal.map_or_else(Quota::default, |principal| principal.quota())
    }

    /// Its name; empty on a server without credentials.
    pub fn name(&self) -> &str {
        let principal = self.principal.as_ref();
        principal.map_or("", |principal| principal.name())
    }
}

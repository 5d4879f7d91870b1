//! The `[[issuer]]` section of the auth file.

use serde::Deserialize;

use super::Verb;

/// An `[[issuer]]` entry of the auth file.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IssuerForm {
    pub issuer: String,
    pub audience: String,
    pub public_keys: Vec<String>,
    pub verbs: Vec<Verb>,
    pub rooms: Vec<String>,
    pub streams: Option<usize>,
    pub requests: Option<usize>,
    pub stored_revisions: Option<u64>,
    pub stored_bytes: Option<u64>,
}

/// Tolerated clock difference between an issuer and this server, seconds.
pub const LEEWAY_S: u64 = 60;

//! An issuer of tokens, as it stands in the file of credentials.

use serde::Deserialize;

use super::Verb;

/// An issuer as it stands in the file of credentials.
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
}

/// How far the clocks of an issuer and of this server may differ, seconds.
pub const LEEWAY_S: u64 = 60;

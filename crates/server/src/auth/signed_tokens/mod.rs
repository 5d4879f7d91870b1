//! Verification of the signature and validity times of JSON Web Tokens. Without the feature `jwt`,
//! every key is rejected.

#[cfg_attr(not(feature = "jwt"), path = "not_built.rs")]
mod public_key;

use serde::Deserialize;

pub use public_key::PublicKey;

/// The claims that are read, besides `iss`, `aud` and `nbf`.
#[derive(Debug, Deserialize)]
pub struct Claims {
    pub sub: String,
    /// Seconds since 1970, UTC.
    pub exp: f64,
    pub scope: Option<String>,
    pub seese3_rooms: Option<Vec<String>>,
}

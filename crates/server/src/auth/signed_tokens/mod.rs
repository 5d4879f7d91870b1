//! Checks the signature and the times of a JSON Web Token; without the feature `jwt`, refuses its keys.

#[cfg_attr(not(feature = "jwt"), path = "not_built.rs")]
mod public_key;

use serde::Deserialize;

pub use public_key::PublicKey;

/// The claims of a token that are read, besides `iss`, `aud` and `nbf`.
#[derive(Debug, Deserialize)]
pub struct Claims {
    pub sub: String,
    /// Seconds since 1970, UTC.
    pub exp: f64,
    pub scope: Option<String>,
    pub seese3_rooms: Option<Vec<String>>,
}

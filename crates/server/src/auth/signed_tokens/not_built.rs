//! Replacement for public keys in builds without the feature `jwt`.

use super::Claims;
use crate::auth::issuer_form::IssuerForm;

/// Uninhabited: this build cannot verify signatures.
pub enum PublicKey {}

impl PublicKey {
    /// Rejects the key.
    ///
    /// # Errors
    /// Always: a message that names the feature.
    pub fn new(_: &[u8], _: &IssuerForm) -> Result<Self, String> {
        Err(
            "this program was built without the feature `jwt`; build it with \
             `cargo install --path . --features jwt`"
                .to_owned(),
        )
    }

    /// Never called, since no key exists.
    pub fn claims(&self, _: &[u8]) -> Result<Option<Claims>, &'static str> {
        match *self {}
    }
}

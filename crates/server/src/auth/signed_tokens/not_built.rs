//! Public keys in a program without the feature `jwt`.

use super::Claims;
use crate::auth::issuer_form::IssuerForm;

/// No key: this program cannot check signatures.
pub enum PublicKey {}

impl PublicKey {
    /// Refuses the key.
    ///
    /// # Errors
    /// Always, in words.
    pub fn new(_: &[u8], _: &IssuerForm) -> Result<Self, String> {
        Err(
            "this program was built without the feature `jwt`; build it with \
             `cargo install --path . --features jwt`"
                .to_owned(),
        )
    }

    /// The claims of a token: there is no key that could check one.
    pub fn claims(&self, _: &[u8]) -> Result<Option<Claims>, &'static str> {
        match *self {}
    }
}

//! Resume tokens: stream state authenticated with the server's key, so that servers are stateless.
//!
//! A token is MAGIC, key id, state, and the HMAC-SHA-256 of these three. It is authenticated but
//! not encrypted: its holder can read the state.

use hmac::{Hmac, Mac};
use sha2::{Digest, Sha256};

use super::super::Error;

/// First bytes of a token: file type and layout version.
const MAGIC: &[u8; 4] = b"S3TD";
/// Length of the key id, bytes.
const KEY_ID: usize = 8;
/// Length of the HMAC-SHA-256 seal, bytes.
const SEAL: usize = 32;
/// Minimum length of the secret, bytes.
const LEAST_KEY_BYTES: usize = 16;

/// A key that seals and verifies tokens. Servers with the same key accept each other's tokens.
#[derive(Clone)]
pub struct TokenKey {
    /// HMAC-SHA-256 initialized with the key; cloned for every token.
    mac: Hmac<Sha256>,
    id: [u8; KEY_ID],
}

impl std::fmt::Debug for TokenKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("TokenKey(..)")
    }
}

impl TokenKey {
    /// A key derived from a secret.
    ///
    /// # Errors
    /// A message for the operator if the secret is too short.
    pub fn new(secret: &[u8]) -> Result<Self, String> {
        if secret.len() < LEAST_KEY_BYTES {
            return Err(format!(
                "has {} bytes; a secret has at least {LEAST_KEY_BYTES}",
                secret.len()
            ));
        }

        Ok(Self::of(secret))
    }

    fn of(secret: &[u8]) -> Self {
        // A hash turns secrets of any length into 32 bytes. The id is a hash with another prefix:
        // it is visible in tokens and must not reveal the key.
        let hash = |what: &[u8]| Sha256::digest([what, secret].concat());
        let mut id = [0; KEY_ID];
        id.copy_from_slice(&hash(b"seese3 token key id ")[..KEY_ID]);

        // The block size of SHA-256 is 64 bytes; HMAC pads a shorter key with zeros.
        let mut block = [0; 64];
        block[..32].copy_from_slice(&hash(b"seese3 token key "));

        Self {
            mac: <Hmac<Sha256> as Mac>::new(&block.into()),
            id,
        }
    }

    /// A random key. Its tokens become invalid when this server ends.
    pub fn random() -> Self {
        let secret: [u8; 32] = rand::random();
        // 32 bytes satisfy the length check in `new`.
        Self::of(&secret)
    }

    /// Seals a state into a token.
    pub fn seal(&self, state: &[u8]) -> Vec<u8> {
        let mut token = [MAGIC.as_slice(), &self.id, state].concat();
        let seal = self
            .mac
            .clone()
            .chain_update(&token)
            .finalize()
            .into_bytes();

        token.extend_from_slice(&seal);
        token
    }

    /// Verifies a token and returns its state.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `field` if it is not a token of this version, was sealed with another
    /// key, or was altered.
    pub fn open<'a>(&self, field: &str, token: &'a [u8]) -> Result<&'a [u8], Error> {
        let begins = MAGIC.len() + KEY_ID;
        if token.len() < begins + SEAL || &token[..MAGIC.len()] != MAGIC {
            return Err(Error::invalid(
                field,
                "is no resume token of this version; start without one",
            ));
        }

        // Compare the key id first, to distinguish a wrong key from an altered token.
        if token[MAGIC.len()..begins] != self.id {
            let problem = "was sealed with another key; give both servers one --token-key-file";
            return Err(Error::invalid(field, problem));
        }

        let (sealed, seal) = token.split_at(token.len() - SEAL);

        // Compare in constant time, so that timing reveals nothing about the correct seal.
        let genuine = self
            .mac
            .clone()
            .chain_update(sealed)
            .verify_slice(seal)
            .is_ok();

        if !genuine {
            return Err(Error::invalid(field, "was altered; start without one"));
        }

        Ok(&sealed[begins..])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key() -> TokenKey {
        TokenKey::new(b"sixteen bytes or more").unwrap()
    }

    /// Oracle: the contract: a sealed state can be opened, and a token with any bit changed is
    /// refused.
    #[test]
    fn an_altered_token_is_refused() {
        let state = b"where the camera was".as_slice();
        let token = key().seal(state);
        assert_eq!(key().open("t", &token).unwrap(), state);

        for place in 0..token.len() {
            for bit in 0..8 {
                let mut altered = token.clone();
                altered[place] ^= 1 << bit;

                assert!(
                    key().open("t", &altered).is_err(),
                    "byte {place}, bit {bit}"
                );
            }
        }

        for length in 0..token.len() {
            assert!(
                key().open("t", &token[..length]).is_err(),
                "cut to {length}"
            );
        }

        assert!(key().open("t", &[token.as_slice(), b"x"].concat()).is_err());
    }

    /// Oracle: the contract: tokens of another key are refused with an error that names the cause.
    #[test]
    fn another_keys_token_is_refused() {
        let other = TokenKey::new(b"another secret, as long").unwrap();
        let error = other
            .open("resume_token", &key().seal(b"state"))
            .unwrap_err();

        assert!(format!("{error:?}").contains("another key"), "{error:?}");
        assert!(TokenKey::new(b"too short").is_err());
    }
}

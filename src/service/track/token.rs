//! Resume tokens: a stream's state, sealed with the server's key, so that servers keep no session.

use hmac::{Hmac, Mac};
use sha2::{Digest, Sha256};

use super::super::Error;

/// What a token begins with: what it is, and the version of its layout.
const MAGIC: &[u8; 4] = b"S3T1";
/// Bytes that say which key sealed it.
const KEY_ID: usize = 8;
/// Bytes of the seal.
const SEAL: usize = 32;
/// The least that a key may be made from.
const LEAST_KEY_BYTES: usize = 16;

/// Seals states. Servers that share a key take one another's tokens.
#[derive(Clone)]
pub struct TokenKey {
    /// With the key, before any byte.
    mac: Hmac<Sha256>,
    id: [u8; KEY_ID],
}

impl std::fmt::Debug for TokenKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("TokenKey(..)")
    }
}

impl TokenKey {
    /// A key from a secret.
    ///
    /// # Errors
    /// What is wrong with it, in words.
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
        // Secrets of every length become 32 bytes; the id is another hash, and gives nothing of the
        // key away.
        let hash = |what: &[u8]| Sha256::digest([what, secret].concat());
        let mut id = [0; KEY_ID];
        id.copy_from_slice(&hash(b"seese3 token key id ")[..KEY_ID]);
        let mut block = [0; 64];
        block[..32].copy_from_slice(&hash(b"seese3 token key "));

        Self {
            mac: <Hmac<Sha256> as Mac>::new(&block.into()),
            id,
        }
    }

    /// A key that nobody else has: its tokens end with this server.
    pub fn random() -> Self {
        let secret: [u8; 32] = rand::random();
        // HMAC takes keys of every length, and this one is long enough.
        Self::of(&secret)
    }

    /// A state as a token.
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

    /// The state of a token.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `field` when it is no token, another key's, or was altered.
    pub fn open<'a>(&self, field: &str, token: &'a [u8]) -> Result<&'a [u8], Error> {
        let begins = MAGIC.len() + KEY_ID;
        if token.len() < begins + SEAL || &token[..MAGIC.len()] != MAGIC {
            return Err(Error::invalid(
                field,
                "is no resume token of this version; start without one",
            ));
        }

        if token[MAGIC.len()..begins] != self.id {
            let problem = "was sealed by a server with another key; servers that share streams share --token-key-file";
            return Err(Error::invalid(field, problem));
        }

        let (sealed, seal) = token.split_at(token.len() - SEAL);

        // In constant time.
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

    /// Oracle: the promise: what was sealed comes back; any other byte anywhere is refused.
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

    /// Oracle: the promise: another key's tokens are refused, and said to be that.
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

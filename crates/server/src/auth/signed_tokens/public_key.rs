//! Public keys of issuers, by the crate `jsonwebtoken`.

use jsonwebtoken::errors::ErrorKind;
use jsonwebtoken::{AlgorithmFamily, DecodingKey, DecodingKeyKind, Validation};

use super::Claims;
use crate::auth::issuer_form::{IssuerForm, LEEWAY_S};

/// A key that checks tokens of one issuer.
pub struct PublicKey {
    key: DecodingKey,
    validation: Validation,
}

impl PublicKey {
    /// Reads a key in PEM: RSA of 2048 bits and more, P-256, P-384 or Ed25519.
    ///
    /// # Errors
    /// In words: what is wrong with the key.
    pub fn new(pem: &[u8], form: &IssuerForm) -> Result<Self, String> {
        let key = public_key(pem)?;

        let mut validation = Validation::new_for_family(key.family());
        validation.leeway = LEEWAY_S;
        validation.validate_nbf = true;
        validation.set_issuer(&[&form.issuer]);
        validation.set_audience(&[&form.audience]);
        validation.set_required_spec_claims(&["exp", "iss", "aud", "sub"]);

        Ok(Self { key, validation })
    }

    /// The claims of a token; none if another key or issuer may have signed it.
    ///
    /// # Errors
    /// What is wrong with a token of this issuer: expired, not valid yet, for another audience.
    pub fn claims(&self, token: &[u8]) -> Result<Option<Claims>, &'static str> {
        // Extensions that have to be understood (`crit`, RFC 7515, section 4.1.11) are not.
        match jsonwebtoken::decode_header(token) {
            Ok(header) if header.crit.is_none() => {}
            _ => return Ok(None),
        }

        match jsonwebtoken::decode::<Claims>(token, &self.key, &self.validation) {
            Ok(decoded) => Ok(Some(decoded.claims)),
            Err(error) => match error.kind() {
                ErrorKind::ExpiredSignature => Err("the token has expired"),
                ErrorKind::ImmatureSignature => Err("the token is not good yet"),
                ErrorKind::InvalidAudience => Err("the token is for another audience"),
                ErrorKind::MissingRequiredClaim(_)
                | ErrorKind::InvalidClaimFormat(_)
                | ErrorKind::Json(_) => {
                    Err("the token must have iss, aud, sub and exp, each of its kind")
                }
                _ => Ok(None),
            },
        }
    }
}

/// A public key in PEM. Keys that both sides share (HMAC) are not taken: who checks could also
/// sign.
fn public_key(pem: &[u8]) -> Result<DecodingKey, String> {
    const KINDS: &str = "RSA of 2048 bits or more, P-256, P-384 or Ed25519";

    let text = String::from_utf8_lossy(pem);
    if text.contains("PRIVATE KEY") {
        return Err("has a private key; give the public one alone".to_owned());
    }
    if text.matches("-----BEGIN").count() > 1 {
        return Err("has several keys; give a file to each".to_owned());
    }

    let key = DecodingKey::from_rsa_pem(pem)
        .or_else(|_| DecodingKey::from_ec_pem(pem))
        .or_else(|_| DecodingKey::from_ed_pem(pem))
        .map_err(|_| format!("is no public key in PEM ({KINDS})"))?;

    // A key that no token can be checked with is found now, by its length. An RSA key has its
    // modulus, a point on a curve two coordinates and a byte before them.
    let length = match key.kind() {
        DecodingKeyKind::SecretOrDer(bytes) => bytes.len(),
        DecodingKeyKind::RsaModulusExponent { n, .. } => n.len(),
    };
    let is_taken = match key.family() {
        AlgorithmFamily::Rsa => length >= 2_048 / 8,
        AlgorithmFamily::Ec => [1 + 2 * 32, 1 + 2 * 48].contains(&length),
        AlgorithmFamily::Ed => length == 32,
        AlgorithmFamily::Hmac => false,
    };
    match is_taken {
        true => Ok(key),
        false => Err(format!("is a key of another length or curve than {KINDS}")),
    }
}

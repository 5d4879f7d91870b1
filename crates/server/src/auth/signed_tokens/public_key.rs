//! Public keys of issuers, using the crate `jsonwebtoken`.

use jsonwebtoken::errors::ErrorKind;
use jsonwebtoken::{AlgorithmFamily, DecodingKey, DecodingKeyKind, Validation};

use super::Claims;
use crate::auth::issuer_form::{IssuerForm, LEEWAY_S};

/// A key that verifies the tokens of one issuer.
pub struct PublicKey {
    key: DecodingKey,
    validation: Validation,
}

impl PublicKey {
    /// Reads a PEM key: RSA of at least 2048 bits, P-256, P-384 or Ed25519.
    ///
    /// # Errors
    /// A message that describes the problem.
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

    /// The claims of a token; `None` if another key or issuer may have signed it.
    ///
    /// # Errors
    /// The problem of a token of this issuer: expired, not valid yet, for another audience, or with
    /// a missing or malformed claim.
    pub fn claims(&self, token: &[u8]) -> Result<Option<Claims>, &'static str> {
        // Critical extensions (`crit`, RFC 7515, section 4.1.11) are not supported.
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
                    Err("the token must have valid claims iss, aud, sub and exp")
                }
                _ => Ok(None),
            },
        }
    }
}

/// Reads a PEM public key. Shared keys (HMAC) are rejected: the verifier could also sign.
fn public_key(pem: &[u8]) -> Result<DecodingKey, String> {
    const KINDS: &str = "RSA of 2048 bits or more, P-256, P-384 or Ed25519";

    let text = String::from_utf8_lossy(pem);
    if text.contains("PRIVATE KEY") {
        return Err("has a private key; give only the public key".to_owned());
    }
    if text.matches("-----BEGIN").count() > 1 {
        return Err("has several keys; use one file per key".to_owned());
    }

    let key = DecodingKey::from_rsa_pem(pem)
        .or_else(|_| DecodingKey::from_ec_pem(pem))
        .or_else(|_| DecodingKey::from_ed_pem(pem))
        .map_err(|_| format!("is no public key in PEM ({KINDS})"))?;

    // Reject unsupported keys now, by length. For RSA it is the length of the modulus; for a curve
    // point, two coordinates and a prefix byte.
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

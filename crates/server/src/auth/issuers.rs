//! Tokens signed by external issuers (JSON Web Tokens, RFC 7519): accepted issuers and the rights
//! they grant.
//!
//! ```toml
//! [[issuer]]
//! issuer = "https://login.example.org"     # the token's `iss`
//! audience = "seese3"                      # one of the token's `aud`
//! public_keys = ["login.pem"]              # PEM files, relative to the auth file
//! verbs = ["navigate", "localize", "track"]
//! rooms = ["lab-*"]
//! streams = 4                              # for each subject (`sub`)
//! requests = 64
//! ```
//!
//! A token never grants more than its issuer's verbs and rooms. The optional claims `scope` (verbs,
//! separated by spaces; other words are ignored) and `seese3_rooms` (a list like `rooms`) restrict
//! it further. The claims `sub` and `exp` are required. Supported keys: RSA of at least 2048 bits,
//! P-256, P-384 and Ed25519.

use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, SystemTime};

use super::super::Error;
use super::issuer_form::{IssuerForm, LEEWAY_S};
use super::signed_tokens::{Claims, PublicKey};
use super::{Places, Principal, Rights, RoomScope, Signed, Verb};

/// Maximum length of a subject name, characters.
const LONGEST_SUBJECT: usize = 200;

/// An accepted token issuer.
pub struct Issuer {
    form: IssuerForm,
    /// Contents of the key files.
    pems: Vec<Vec<u8>>,
    keys: Vec<PublicKey>,
    /// Upper bound of every subject's rights.
    rights: Rights,
    /// Concurrency limits of the subjects that have open requests or streams.
    subjects: Mutex<HashMap<String, Weak<Places>>>,
}

impl std::fmt::Debug for Issuer {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("Issuer")
            .field("form", &self.form)
            .finish_non_exhaustive()
    }
}

impl Issuer {
    /// Reads an issuer's keys; relative paths are relative to `folder`. `rights` is the upper bound
    /// of every subject's rights.
    ///
    /// # Errors
    /// A message that names the invalid setting or key file.
    pub fn new(form: IssuerForm, rights: Rights, folder: &Path) -> Result<Self, String> {
        if form.issuer.is_empty() || form.audience.is_empty() {
            return Err("issuer and audience must not be empty".to_owned());
        }
        if form.public_keys.is_empty() {
            return Err("public_keys is empty: no token could be checked".to_owned());
        }

        let mut pems = Vec::new();
        let mut keys = Vec::new();
        for name in &form.public_keys {
            let unfit = |problem: String| format!("public_keys: {name}: {problem}");
            let pem = seese3_files::read(&folder.join(name), seese3_files::SMALL_FILE_BYTES)
                .map_err(|error| unfit(format!("cannot be read: {error}")))?;
            let key = PublicKey::new(&pem, &form).map_err(unfit)?;
            pems.push(pem);
            keys.push(key);
        }

        Ok(Self {
            form,
            pems,
            keys,
            rights,
            subjects: Mutex::default(),
        })
    }

    /// Whether both have the same issuer and audience, which would be ambiguous.
    pub fn has_tokens_of(&self, other: &Self) -> bool {
        (&self.form.issuer, &self.form.audience) == (&other.form.issuer, &other.form.audience)
    }

    /// Whether both accept the same tokens with the same rights.
    pub fn is_like(&self, other: &Self) -> bool {
        (&self.form, &self.pems) == (&other.form, &other.pems)
    }

    /// Contents of the key files.
    pub fn pems(&self) -> &[Vec<u8>] {
        &self.pems
    }

    /// The principal of a token; `None` if the token is not from this issuer.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] if the token is from this issuer but is expired, not valid yet,
    /// malformed or for another audience.
    pub fn principal_of(self: &Arc<Self>, token: &[u8]) -> Result<Option<Principal>, Error> {
        for key in &self.keys {
            match key.claims(token) {
                Ok(Some(claims)) => return self.principal(claims).map(Some),
                // Another key or issuer may accept it.
                Ok(None) => {}
                Err(problem) => return Err(Error::Unauthenticated { problem }),
            }
        }

        Ok(None)
    }

    fn principal(self: &Arc<Self>, claims: Claims) -> Result<Principal, Error> {
        let Claims {
            sub,
            exp,
            scope,
            seese3_rooms,
        } = claims;

        let is_name = !sub.is_empty() && !sub.chars().any(char::is_control);
        if !is_name || sub.chars().count() > LONGEST_SUBJECT {
            let problem = "the token's `sub` must be one line of text, 200 characters at most";
            return Err(Error::Unauthenticated { problem });
        }

        let in_scope = |verb: &&Verb| {
            let words = scope.as_deref().map(str::split_whitespace);
            words.is_none_or(|mut words| words.any(|word| word == <&str>::from(*verb)))
        };
        let rights = Rights {
            name: format!("{sub}@{}", self.form.issuer).into(),
            verbs: self.rights.verbs.iter().filter(in_scope).copied().collect(),
            rooms: match seese3_rooms {
                Some(rooms) => self.rights.rooms.and(rooms),
                None => self.rights.rooms.clone(),
            },
            ..self.rights
        };

        let places = self.places(&rights.name);
        Ok(Principal {
            rights,
            places,
            signed: Some(Signed {
                issuer: self.clone(),
                until: expiry(exp),
            }),
        })
    }

    /// The concurrency limits of a subject, shared by all its tokens.
    fn places(&self, name: &str) -> Arc<Places> {
        let mut subjects = self.subjects.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = subjects.get(name).and_then(Weak::upgrade) {
            return known;
        }

        // Before the map would grow, drop subjects without requests and connections.
        if subjects.len() == subjects.capacity() {
            subjects.retain(|_, places| places.strong_count() > 0);
        }
        let places = Arc::new(Places::new(&self.rights));
        subjects.insert(name.to_owned(), Arc::downgrade(&places));
        places
    }
}

/// Expiry of a token: `exp` plus the clock tolerance. `None` if the system cannot represent that
/// time.
fn expiry(exp: f64) -> Option<SystemTime> {
    let since_1970 = Duration::try_from_secs_f64(exp + LEEWAY_S as f64).ok()?;
    SystemTime::UNIX_EPOCH.checked_add(since_1970)
}

impl RoomScope {
    /// The intersection of this scope and a list.
    fn and(&self, rooms: Vec<String>) -> Self {
        let mut lists = self.0.clone();
        lists.push(rooms);
        Self(lists)
    }
}

#[cfg(test)]
#[cfg(feature = "jwt")]
mod tests {
    use super::super::credentials::Credentials;
    use super::*;

    /// Folder with tokens and keys made by PyJWT.
    fn golden() -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/jwt")
    }

    fn tokens() -> serde_json::Value {
        let text = std::fs::read(golden().join("tokens.json")).unwrap();
        serde_json::from_slice(&text).unwrap()
    }

    /// Credentials with an issuer that has these keys.
    fn taking(keys: &[&str]) -> Result<Credentials, String> {
        // Quoted paths, for a TOML list.
        let keys: Vec<String> = keys
            .iter()
            .map(|key| format!("{:?}", golden().join(key)))
            .collect();
        let text = format!(
            "[[issuer]]\nissuer = \"https://login.example.org\"\naudience = \"seese3\"\npublic_keys = [{}]\n\
             verbs = [\"navigate\", \"track\"]\nrooms = [\"lab-*\"]\nstreams = 1\n",
            keys.join(", ")
        );
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("auth.toml");
        std::fs::write(&file, text).unwrap();
        Credentials::read(&file).map_err(|error| error.to_string())
    }

    const ALL: [&str; 4] = ["rsa.pem", "p256.pem", "p384.pem", "ed25519.pem"];

    /// Oracle: PyJWT, which signed the tokens, and RFC 7519.
    #[test]
    fn good_tokens_are_known_and_others_are_not() {
        let credentials = taking(&ALL).unwrap();
        let tokens = tokens();

        for (what, token) in tokens["good"].as_object().unwrap() {
            let token = token.as_str().unwrap().as_bytes();
            let robot = credentials.by_token(token);
            let robot = robot.unwrap_or_else(|error| panic!("{what}: {error}"));
            assert_eq!(robot.name(), "robot-7@https://login.example.org");
            assert!(
                robot.may(Verb::Navigate) && !robot.may(Verb::Write),
                "{what}"
            );
            assert!(robot.rooms().contains("lab-1") && !robot.rooms().contains("kitchen"));
        }

        for (what, case) in tokens["bad"].as_object().unwrap() {
            let [token, word] = [0, 1].map(|at| case[at].as_str().unwrap());
            let error = credentials.by_token(token.as_bytes()).unwrap_err();
            assert!(error.to_string().contains(word), "{what}: {error}");
        }

        // Tokens of a removed key are rejected.
        let fewer = taking(&["rsa.pem"]).unwrap();
        let token = |name: &str| tokens["good"][name].as_str().unwrap().as_bytes();
        assert!(fewer.by_token(token("RS256")).is_ok());
        assert!(fewer.by_token(token("ES256")).is_err());
    }

    /// Oracle: the definition of the claims: they restrict rights and never add any.
    #[test]
    fn a_token_allows_no_more_than_its_issuer() {
        let credentials = taking(&ALL).unwrap();
        let tokens = tokens();
        let caller = |name: &str| {
            let token = tokens["narrowed"][name].as_str().unwrap();
            credentials.by_token(token.as_bytes()).unwrap()
        };

        let scoped = caller("scope");
        assert!(scoped.may(Verb::Navigate) && !scoped.may(Verb::Track));
        assert!(!scoped.may(Verb::Write), "the issuer does not grant it");
        let none = caller("no verb in scope");
        assert!(!none.may(Verb::Navigate) && !none.may(Verb::Track));

        let rooms = caller("rooms");
        assert!(rooms.rooms().contains("lab-2") && !rooms.rooms().contains("lab-1"));
        assert!(
            !rooms.rooms().contains("kitchen"),
            "the issuer does not grant it"
        );

        // Limits apply per subject, over all its tokens.
        let place = rooms.stream_place();
        assert!(place.is_some() && none.stream_place().is_none());
        drop(place);
        assert!(none.stream_place().is_some());
    }

    /// Oracle: the signature: no altered token is accepted.
    #[test]
    fn altered_tokens_are_not_known() {
        let credentials = taking(&ALL).unwrap();
        let tokens = tokens();
        for name in ["RS256", "PS384", "ES256", "EdDSA"] {
            let token = tokens["good"][name].as_str().unwrap().as_bytes();
            for at in 0..token.len() {
                let mut altered = token.to_vec();
                altered[at] = if altered[at] == b'A' { b'B' } else { b'A' };
                assert!(credentials.by_token(&altered).is_err(), "{name} at {at}");
                assert!(
                    credentials.by_token(&token[..at]).is_err(),
                    "{name} cut at {at}"
                );
            }
        }
    }

    /// Oracle: the contract: the message names the invalid setting.
    #[test]
    fn an_issuer_that_cannot_be_used_is_named() {
        let error = taking(&["tokens.json"]).unwrap_err();
        assert!(
            error.contains("https://login.example.org") && error.contains("tokens.json"),
            "{error}"
        );
        assert!(taking(&["absent.pem"]).unwrap_err().contains("absent.pem"));
        assert!(taking(&[]).unwrap_err().contains("public_keys"));

        let private = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(private.path(), "-----BEGIN PRIVATE KEY-----").unwrap();
        let unfit = taking(&[private.path().to_str().unwrap()]).unwrap_err();
        assert!(unfit.contains("private key"), "{unfit}");
        for name in ["rsa1024.pem", "p521.pem", "two.pem"] {
            let unfit = taking(&[&format!("unfit/{name}")]).unwrap_err();
            assert!(unfit.contains(name), "{unfit}");
        }
    }
}

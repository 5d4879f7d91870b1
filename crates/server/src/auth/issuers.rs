//! Tokens that others signed (JSON Web Tokens, RFC 7519): whose are taken, and what they may allow.
//!
//! ```toml
//! [[issuer]]
//! issuer = "https://login.example.org"     # the token's `iss`
//! audience = "seese3"                      # one of the token's `aud`
//! public_keys = ["login.pem"]              # PEM files, beside the file of credentials
//! verbs = ["navigate", "localize", "track"]
//! rooms = ["lab-*"]
//! streams = 4                              # for each subject (`sub`)
//! requests = 64
//! ```
//!
//! A token never allows more than its issuer's verbs and rooms. It allows less where it has `scope`
//! (verbs, separated by spaces; other words mean nothing here) or `seese3_rooms` (a list as
//! `rooms`). It must have `sub` and `exp`. Keys are RSA of 2048 bits and more, P-256, P-384 or
//! Ed25519.

use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, SystemTime};

use super::super::Error;
use super::issuer_form::{IssuerForm, LEEWAY_S};
use super::signed_tokens::{Claims, PublicKey};
use super::{Places, Principal, Rights, RoomScope, Signed, Verb};

/// The longest name of a subject, characters.
const LONGEST_SUBJECT: usize = 200;

/// Somebody whose tokens are taken.
pub struct Issuer {
    form: IssuerForm,
    /// The content of the files of its keys.
    pems: Vec<Vec<u8>>,
    keys: Vec<PublicKey>,
    /// What every subject may at most.
    rights: Rights,
    /// What is open of each subject that has anything open.
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
    /// Reads the keys of an issuer, which are in or below `folder` unless their paths are absolute.
    /// `rights` is what every subject may at most.
    ///
    /// # Errors
    /// In words: the key that is wrong, and how.
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
            let pem = std::fs::read(folder.join(name))
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

    /// Whether both are for the same tokens, so that it would be by chance which of them decides.
    pub fn has_tokens_of(&self, other: &Self) -> bool {
        (&self.form.issuer, &self.form.audience) == (&other.form.issuer, &other.form.audience)
    }

    /// Whether both take the same tokens for the same rights.
    pub fn is_like(&self, other: &Self) -> bool {
        (&self.form, &self.pems) == (&other.form, &other.pems)
    }

    /// The files of the keys, as they were read.
    pub fn pems(&self) -> &[Vec<u8>] {
        &self.pems
    }

    /// The principal of a token; none if it is not one of this issuer.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] if it is, and is not good any more, not yet, or not for us.
    pub fn principal_of(self: &Arc<Self>, token: &[u8]) -> Result<Option<Principal>, Error> {
        for key in &self.keys {
            match key.claims(token) {
                Ok(Some(claims)) => return self.principal(claims).map(Some),
                // Another key or another issuer may know it.
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
            words.is_none_or(|mut words| words.any(|word| word == verb.name()))
        };
        let rights = Rights {
            name: format!("{sub}@{}", self.form.issuer),
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

    /// What a subject has open, over all of its tokens.
    fn places(&self, name: &str) -> Arc<Places> {
        let mut subjects = self.subjects.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = subjects.get(name).and_then(Weak::upgrade) {
            return known;
        }

        // Those that have nothing open are forgotten before the map would grow.
        if subjects.len() == subjects.capacity() {
            subjects.retain(|_, places| places.strong_count() > 0);
        }
        let places = Arc::new(Places::new(&self.rights));
        subjects.insert(name.to_owned(), Arc::downgrade(&places));
        places
    }
}

/// When a token ends: at `exp`, and later by as much as clocks may differ. None if the system
/// cannot represent that time.
fn expiry(exp: f64) -> Option<SystemTime> {
    let since_1970 = Duration::try_from_secs_f64(exp + LEEWAY_S as f64).ok()?;
    SystemTime::UNIX_EPOCH.checked_add(since_1970)
}

impl RoomScope {
    /// The rooms that are both in this and in a list.
    fn and(&self, rooms: Vec<String>) -> Self {
        let mut lists = self.0.clone();
        lists.push(rooms);
        Self(lists)
    }
}

#[cfg(all(test, feature = "jwt"))]
mod tests {
    use super::super::credentials::Credentials;
    use super::*;

    /// Tokens and keys that PyJWT made.
    fn golden() -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/jwt")
    }

    fn tokens() -> serde_json::Value {
        let text = std::fs::read(golden().join("tokens.json")).unwrap();
        serde_json::from_slice(&text).unwrap()
    }

    /// The credentials of a server that takes the tokens of these keys.
    fn taking(keys: &[&str]) -> Result<Credentials, String> {
        // Paths in quotes, as a list of TOML.
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

        // A key that the issuer has no more takes its tokens with it.
        let fewer = taking(&["rsa.pem"]).unwrap();
        let token = |name: &str| tokens["good"][name].as_str().unwrap().as_bytes();
        assert!(fewer.by_token(token("RS256")).is_ok());
        assert!(fewer.by_token(token("ES256")).is_err());
    }

    /// Oracle: the meaning of the claims: they take away, and never add.
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
        assert!(!scoped.may(Verb::Write), "the issuer may not say so");
        let none = caller("no verb in scope");
        assert!(!none.may(Verb::Navigate) && !none.may(Verb::Track));

        let rooms = caller("rooms");
        assert!(rooms.rooms().contains("lab-2") && !rooms.rooms().contains("lab-1"));
        assert!(
            !rooms.rooms().contains("kitchen"),
            "the issuer may not say so"
        );

        // Its limits are those of the subject, whatever its token.
        let place = rooms.stream_place();
        assert!(place.is_some() && none.stream_place().is_none());
        drop(place);
        assert!(none.stream_place().is_some());
    }

    /// Oracle: signatures: no altered token is good.
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

    /// Oracle: the promise: what is wrong in the file is named.
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

//! The auth file.
//!
//! ```toml
//! [[principal]]
//! name = "robot-7"
//! token_sha256 = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b"
//! verbs = ["navigate", "localize", "track"]
//! rooms = ["kitchen", "lab-*"]
//! streams = 4       # concurrent Track streams; default 4
//! requests = 64     # concurrent requests and streams; default 64
//! ```
//!
//! The file has no secrets: it has the SHA-256 of a token (`printf %s "$TOKEN" | sha256sum`) or the
//! fingerprint of a client certificate (`certificate_sha256`, the SHA-256 of its DER). Tokens of
//! external issuers are accepted by `[[issuer]]`, see [`super::issuers`].

use seese3_core::Cause;
use seese3_store::Quota;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use serde::Deserialize;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;
use tokio::sync::watch;

use super::super::Error;
use super::super::slow_files::read_logged_if_slow;
use super::issuer_form::IssuerForm;
use super::issuers::Issuer;
use super::{Principal, Rights, RoomScope, Signed, Verb};

/// Polling interval of the file.
const LOOK: Duration = Duration::from_secs(5);

const MOST_STREAMS: usize = 4;
const MOST_REQUESTS: usize = 64;
/// Maximum of `streams` and `requests`.
const LARGEST_LIMIT: usize = 1_000_000;

/// Errors of reading an auth file.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum AuthError {
    #[error("--auth-file: {} cannot be read: {problem}", file.display())]
    Unreadable {
        file: PathBuf,
        #[source]
        problem: std::io::Error,
    },
    #[error("--auth-file: {}: {problem}", file.display())]
    Syntax {
        file: PathBuf,
        #[source]
        problem: Cause,
    },
    #[error("--auth-file: {}: principal '{name}': {problem}", file.display())]
    Principal {
        file: PathBuf,
        name: String,
        problem: String,
    },
    #[error("--auth-file: {}: issuer '{issuer}': {problem}", file.display())]
    Issuer {
        file: PathBuf,
        issuer: String,
        problem: String,
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileForm {
    #[serde(default)]
    principal: Vec<PrincipalForm>,
    #[serde(default)]
    issuer: Vec<IssuerForm>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PrincipalForm {
    name: String,
    token_sha256: Option<String>,
    certificate_sha256: Option<String>,
    verbs: Vec<Verb>,
    rooms: Vec<String>,
    streams: Option<usize>,
    requests: Option<usize>,
    stored_revisions: Option<u64>,
    stored_bytes: Option<u64>,
}

/// Proof of a caller's identity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Proof {
    /// SHA-256 of a bearer token.
    Token([u8; 32]),
    /// SHA-256 of a client certificate.
    Certificate([u8; 32]),
}

/// The principals and issuers of an auth file.
#[derive(Debug, Default)]
pub struct Credentials {
    known: Vec<(Proof, Arc<Principal>)>,
    issuers: Vec<Arc<Issuer>>,
    /// SHA-256 of the auth file and the key files, to detect changes.
    digest: [u8; 32],
}

impl Credentials {
    /// Reads an auth file and the key files it references.
    ///
    /// # Errors
    /// [`AuthError`], which names the principal or issuer and the key. A file without principals
    /// and issuers is rejected: it would lock out every caller.
    pub fn read(file: &Path) -> Result<Self, AuthError> {
        let text =
            seese3_files::read_text(file, seese3_files::SMALL_FILE_BYTES).map_err(|problem| {
                AuthError::Unreadable {
                    file: file.to_owned(),
                    problem,
                }
            })?;

        Self::of(file, &text)
    }

    fn of(file: &Path, text: &str) -> Result<Self, AuthError> {
        let syntax = |problem: seese3_core::Cause| AuthError::Syntax {
            file: file.to_owned(),
            problem,
        };

        let form: FileForm = toml::from_str(text).map_err(|error| syntax(error.into()))?;
        if form.principal.is_empty() && form.issuer.is_empty() {
            let problem = "has no [[principal]] and no [[issuer]]: every call would be rejected";
            return Err(syntax(problem.into()));
        }

        let mut names = BTreeSet::new();
        let mut known: Vec<(Proof, Arc<Principal>)> = Vec::new();
        for form in form.principal {
            let name = form.name.clone();
            let unfit = |problem: String| AuthError::Principal {
                file: file.to_owned(),
                name: name.clone(),
                problem,
            };

            if !names.insert(name.clone()) {
                return Err(unfit("is given twice".to_owned()));
            }
            let (proof, principal) = principal(form).map_err(unfit)?;

            // Two principals with the same token would make the caller's rights ambiguous.
            if known.iter().any(|(other, _)| *other == proof) {
                return Err(unfit(
                    "has the token or certificate of another principal".to_owned(),
                ));
            }
            known.push((proof, Arc::new(principal)));
        }

        let mut digest = Sha256::new_with_prefix(text);
        let mut issuers: Vec<Arc<Issuer>> = Vec::new();
        for form in form.issuer {
            let name = form.issuer.clone();
            let unfit = |problem: String| AuthError::Issuer {
                file: file.to_owned(),
                issuer: name.clone(),
                problem,
            };

            let issuer = issuer(form, file).map_err(unfit)?;
            if issuers.iter().any(|other| other.has_tokens_of(&issuer)) {
                return Err(unfit("is given twice for one audience".to_owned()));
            }
            issuer.pems().iter().for_each(|pem| digest.update(pem));
            issuers.push(Arc::new(issuer));
        }

        Ok(Self {
            known,
            issuers,
            digest: digest.finalize().into(),
        })
    }

    /// Keeps the unchanged principals and issuers of `before`, so that their open streams continue
    /// and still count toward their limits.
    fn taking_over(mut self, before: &Self) -> Self {
        for (proof, principal) in &mut self.known {
            let same = before
                .known
                .iter()
                .find(|(other, old)| other == proof && old.rights == principal.rights);
            if let Some((_, old)) = same {
                *principal = old.clone();
            }
        }
        for issuer in &mut self.issuers {
            let same = before.issuers.iter().find(|old| old.is_like(issuer));
            if let Some(old) = same {
                *issuer = old.clone();
            }
        }
        self
    }

    fn holds(&self, principal: &Arc<Principal>) -> bool {
        match &principal.signed {
            Some(Signed { issuer, .. }) => {
                self.issuers.iter().any(|known| Arc::ptr_eq(known, issuer))
            }
            None => self
                .known
                .iter()
                .any(|(_, known)| Arc::ptr_eq(known, principal)),
        }
    }

    /// The principal of a token.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] if the token is unknown, or its issuer rejects it.
    pub fn by_token(&self, token: &[u8]) -> Result<Arc<Principal>, Error> {
        let known = self.by_proof(&Sha256::digest(token).into(), |proof| match proof {
            Proof::Token(digest) => Some(digest),
            Proof::Certificate(_) => None,
        });
        if let Some(principal) = known {
            return Ok(principal);
        }

        let mut refusal = Error::Unauthenticated {
            problem: "the token is not known",
        };
        for issuer in &self.issuers {
            match issuer.principal_of(token) {
                Ok(Some(principal)) => return Ok(Arc::new(principal)),
                Ok(None) => {}
                // The token may be for the next issuer's audience.
                Err(error) => refusal = error,
            }
        }
        Err(refusal)
    }

    /// The principal of a client certificate, by fingerprint.
    pub fn by_certificate(&self, fingerprint: &[u8; 32]) -> Option<Arc<Principal>> {
        self.by_proof(fingerprint, |proof| match proof {
            Proof::Certificate(digest) => Some(digest),
            Proof::Token(_) => None,
        })
    }

    /// Compares all digests, each in constant time, so that the duration reveals nothing about a
    /// token.
    fn by_proof(
        &self,
        given: &[u8; 32],
        of_kind: impl Fn(&Proof) -> Option<&[u8; 32]>,
    ) -> Option<Arc<Principal>> {
        let mut found = None;
        for (proof, principal) in &self.known {
            let is_equal = of_kind(proof).is_some_and(|digest| digest.ct_eq(given).into());
            if is_equal {
                found = Some(principal.clone());
            }
        }

        found
    }
}

fn principal(form: PrincipalForm) -> Result<(Proof, Principal), String> {
    let PrincipalForm {
        name,
        token_sha256,
        certificate_sha256,
        verbs,
        rooms,
        streams,
        requests,
        stored_revisions,
        stored_bytes,
    } = form;

    let proof = match (token_sha256, certificate_sha256) {
        (Some(token), None) => Proof::Token(digest("token_sha256", &token)?),
        (None, Some(certificate)) => {
            Proof::Certificate(digest("certificate_sha256", &certificate)?)
        }
        _ => return Err("needs either token_sha256 or certificate_sha256".to_owned()),
    };

    if name.is_empty() || name.chars().any(char::is_control) {
        return Err("name must be one line of text".to_owned());
    }
    let mut rights = rights(name, verbs, rooms, [streams, requests])?;
    rights.quota = Quota {
        revisions: stored_revisions,
        bytes: stored_bytes,
    };
    Ok((proof, Principal::new(rights)))
}

fn issuer(form: IssuerForm, file: &Path) -> Result<Issuer, String> {
    let limits = [form.streams, form.requests];
    let mut rights = rights(
        form.issuer.clone(),
        form.verbs.clone(),
        form.rooms.clone(),
        limits,
    )?;
    rights.quota = Quota {
        revisions: form.stored_revisions,
        bytes: form.stored_bytes,
    };
    Issuer::new(form, rights, file.parent().unwrap_or(Path::new("")))
}

/// Validates the rights of an entry; the limits are `streams` and `requests`.
fn rights(
    name: String,
    verbs: Vec<Verb>,
    rooms: Vec<String>,
    [streams, requests]: [Option<usize>; 2],
) -> Result<Rights, String> {
    if verbs.is_empty() {
        return Err("verbs is empty: every call would be rejected".to_owned());
    }
    if rooms.is_empty() {
        return Err("rooms is empty; give names, or \"*\" for all".to_owned());
    }
    for room in &rooms {
        let plain = room.strip_suffix('*').unwrap_or(room);
        if plain.contains('*') {
            return Err(format!("rooms: '{room}' has a * that is not at its end"));
        }
    }

    let limit = |key: &str, given: Option<usize>, default| match given.unwrap_or(default) {
        limit if (1..=LARGEST_LIMIT).contains(&limit) => Ok(limit),
        limit => Err(format!("{key} must be 1 to {LARGEST_LIMIT}, got {limit}")),
    };
    Ok(Rights {
        streams: limit("streams", streams, MOST_STREAMS)?,
        requests: limit("requests", requests, MOST_REQUESTS)?,
        name: name.into(),
        verbs,
        rooms: RoomScope(vec![rooms]),
        quota: Quota::default(),
    })
}

fn digest(key: &str, text: &str) -> Result<[u8; 32], String> {
    let bytes = hex::decode(text).ok();
    bytes
        .and_then(|bytes| bytes.try_into().ok())
        .ok_or_else(|| format!("{key} must be 64 hexadecimal digits"))
}

/// The server's current credentials, reloaded when their file changes.
#[derive(Debug)]
pub struct Keyring {
    file: PathBuf,
    current: watch::Sender<Arc<Credentials>>,
}

impl Keyring {
    /// Reads the file.
    ///
    /// # Errors
    /// [`AuthError`], naming the principal and the key.
    pub fn open(file: PathBuf) -> Result<Self, AuthError> {
        let current = watch::Sender::new(Arc::new(Credentials::read(&file)?));
        Ok(Self { file, current })
    }

    /// The current credentials.
    pub fn current(&self) -> Arc<Credentials> {
        self.current.borrow().clone()
    }

    /// Whether the principal's rights are unchanged and its token has not expired.
    pub fn is_valid(&self, principal: &Arc<Principal>) -> bool {
        let until = principal.signed.as_ref().and_then(|signed| signed.until);
        let has_expired = until.is_some_and(|until| left(until, SystemTime::now()).is_none());
        !has_expired && self.current.borrow().holds(principal)
    }

    fn replace(&self, credentials: Credentials) {
        let credentials = credentials.taking_over(&self.current());
        self.current.send_replace(Arc::new(credentials));
    }

    /// Completes when the principal's rights have changed or been removed, or its token has
    /// expired.
    pub async fn revoked(&self, principal: &Arc<Principal>) {
        let mut changes = self.current.subscribe();
        let changed = changes.wait_for(|credentials| !credentials.holds(principal));
        let until = principal.signed.as_ref().and_then(|signed| signed.until);

        tokio::select! {
            // An error means that the server has stopped.
            _ = changed => {}
            () = passed(until, SystemTime::now) => {}
        }
    }

    /// Polls the file for changes; never completes. An invalid file is logged, and the current
    /// credentials stay in effect.
    pub async fn follow_file(&self) {
        let mut trouble = String::new();

        loop {
            let file = self.file.clone();
            let credentials = read_logged_if_slow("--auth-file", move || Credentials::read(&file));
            let Ok(credentials) = credentials.await else {
                return;
            };
            match credentials {
                Ok(credentials) => {
                    trouble.clear();
                    if credentials.digest != self.current().digest {
                        self.replace(credentials);
                        tracing::info!("credentials reloaded");
                    }
                }
                // Log a persistent error once.
                Err(error) if error.to_string() == trouble => {}
                Err(error) => {
                    tracing::error!(%error, "invalid --auth-file; the previous credentials remain");
                    trouble = error.to_string();
                }
            }
            tokio::time::sleep(LOOK).await;
        }
    }
}

/// The time from `now` until `until`; `None` if that has come.
fn left(until: SystemTime, now: SystemTime) -> Option<Duration> {
    let left = until.duration_since(now).ok();
    left.filter(|left| !left.is_zero())
}

/// Completes when the system clock `now` reaches a time; never if `until` is `None`.
async fn passed(until: Option<SystemTime>, now: impl Fn() -> SystemTime) {
    let Some(until) = until else {
        return std::future::pending().await;
    };
    while let Some(left) = left(until, now()) {
        // The clock may be adjusted during the wait, so wake up regularly.
        tokio::time::sleep(left.min(Duration::from_secs(60))).await;
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicI64, Ordering};

    use super::*;

    /// SHA-256 of "secret", as `printf %s secret | sha256sum` prints it.
    const SECRET: &str = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b";

    fn read(text: &str) -> Result<Credentials, AuthError> {
        Credentials::of(Path::new("auth.toml"), text)
    }

    fn principal(extra: &str) -> String {
        format!(
            "[[principal]]\nname = \"robot\"\ntoken_sha256 = \"{SECRET}\"\nverbs = [\"track\"]\nrooms = [\"kitchen\", \"lab-*\"]\n{extra}\n"
        )
    }

    /// Oracle: sha256sum, and the meaning of the file's keys.
    #[test]
    fn a_token_is_known_by_its_digest() {
        let credentials = read(&principal("")).unwrap();
        let robot = credentials.by_token(b"secret").unwrap();

        assert_eq!(robot.name(), "robot");
        assert!(robot.may(Verb::Track) && !robot.may(Verb::Navigate));
        assert!(robot.rooms().contains("kitchen") && robot.rooms().contains("lab-2"));
        assert!(!robot.rooms().contains("kitchen2") && !robot.rooms().is_all());

        assert!(credentials.by_token(b"Secret").is_err());
        assert!(credentials.by_token(b"").is_err());

        // The digest of a token does not authenticate a certificate.
        let digest = hex::decode(SECRET).unwrap().try_into().unwrap();
        assert!(credentials.by_certificate(&digest).is_none());
    }

    /// Oracle: the contract: an invalid file is rejected, and the message names the key.
    #[test]
    fn a_file_that_is_wrong_names_what_is() {
        let twice = principal("") + &principal("").replace("robot", "other");
        for (text, word) in [
            (String::new(), "principal"),
            (principal("").replace(SECRET, "abc"), "token_sha256"),
            (principal("").replace("track", "fly"), "fly"),
            (principal("").replace("lab-*", "l*b"), "l*b"),
            (principal("streams = 0"), "streams"),
            (principal("secret = \"x\""), "secret"),
            (principal("").replace("[\"track\"]", "[]"), "verbs"),
            (twice, "another"),
            (principal("") + &principal(""), "twice"),
        ] {
            let error = read(&text).unwrap_err().to_string();
            assert!(
                error.contains(word) && error.contains("auth.toml"),
                "{error}"
            );
        }
    }

    /// Oracle: the contract: callers with unchanged rights keep their open streams; `revoked`
    /// completes for callers with changed or removed rights.
    #[tokio::test]
    async fn only_changed_rights_are_revoked() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("auth.toml");
        let other = "[[principal]]\nname = \"other\"\ncertificate_sha256 = \"{}\"\nverbs = [\"track\"]\nrooms = [\"*\"]\n"
            .replace("{}", SECRET);
        std::fs::write(&file, principal("") + &other).unwrap();
        let keyring = Keyring::open(file).unwrap();

        let digest = hex::decode(SECRET).unwrap().try_into().unwrap();
        let robot = keyring.current().by_token(b"secret").unwrap();
        let other_one = keyring.current().by_certificate(&digest).unwrap();

        let changed = read(&(principal("streams = 2") + &other)).unwrap();
        keyring.replace(changed);
        keyring.revoked(&robot).await;
        let now = keyring.current().by_certificate(&digest).unwrap();
        assert!(Arc::ptr_eq(&other_one, &now));

        keyring.replace(read(&principal("streams = 2")).unwrap());
        keyring.revoked(&other_one).await;
    }

    /// Oracle: the definition, on a simulated clock: a token of one hour ends after one hour; a
    /// clock that is set back or forward in between is noticed within a minute.
    #[tokio::test(start_paused = true)]
    async fn a_token_holds_until_it_ends() {
        let started = tokio::time::Instant::now();
        let set_forward_s = AtomicI64::new(0);
        let now = || {
            let ahead = set_forward_s.load(Ordering::Relaxed);
            let since_1970 = 1_000_000 + started.elapsed().as_secs() as i64 + ahead;
            SystemTime::UNIX_EPOCH + Duration::from_secs(since_1970 as u64)
        };
        let hour = Duration::from_secs(3_600);
        let adjust = async |seconds| {
            tokio::time::sleep(hour / 2).await;
            set_forward_s.fetch_add(seconds, Ordering::Relaxed);
        };

        // By how much the clock is set after half an hour, and when the token ends.
        for (seconds, least_s, most_s) in [
            (0, 3_600, 3_600),
            (-600, 4_200, 4_200),
            (7_200, 1_800, 1_860),
        ] {
            let began = tokio::time::Instant::now();
            tokio::join!(passed(Some(now() + hour), now), adjust(seconds));
            let took_s = began.elapsed().as_secs();
            assert!(
                (least_s..=most_s).contains(&took_s),
                "set by {seconds} s: {took_s} s"
            );
        }

        passed(Some(SystemTime::UNIX_EPOCH), now).await;
        let never = tokio::time::timeout(100 * hour, passed(None, now));
        assert!(never.await.is_err());
    }
}

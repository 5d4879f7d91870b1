//! The file of credentials.
//!
//! ```toml
//! [[principal]]
//! name = "robot-7"
//! token_sha256 = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b"
//! verbs = ["navigate", "localize", "track"]
//! rooms = ["kitchen", "lab-*"]
//! streams = 4       # Track streams at a time; 4 if absent
//! requests = 64     # requests and streams at a time; 64 if absent
//! ```
//!
//! The file has no secret in it: of a token it has the SHA-256 (`printf %s "$TOKEN" | sha256sum`),
//! of a client's certificate the fingerprint (`certificate_sha256`, that of its DER). Tokens that
//! others signed are taken by `[[issuer]]`, see [`super::issuers`].

use seese3_core::Cause;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use serde::Deserialize;
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;
use tokio::sync::watch;

use super::super::Error;
use super::issuer_form::IssuerForm;
use super::issuers::Issuer;
use super::{Principal, Rights, RoomScope, Signed, Verb};

/// The time between two looks at the file.
const LOOK: Duration = Duration::from_secs(5);

const MOST_STREAMS: usize = 4;
const MOST_REQUESTS: usize = 64;
/// The largest limit that can be given.
const LARGEST_LIMIT: usize = 1_000_000;

/// Why a file of credentials cannot be used.
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
}

/// What proves who is calling.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Proof {
    /// SHA-256 of a bearer token.
    Token([u8; 32]),
    /// SHA-256 of a client's certificate.
    Certificate([u8; 32]),
}

/// The principals of a server.
#[derive(Debug, Default)]
pub struct Credentials {
    known: Vec<(Proof, Arc<Principal>)>,
    issuers: Vec<Arc<Issuer>>,
    /// SHA-256 of all files that were read.
    digest: [u8; 32],
}

impl Credentials {
    /// Reads a file.
    ///
    /// # Errors
    /// [`AuthError`], naming the principal or issuer and the key. A file without any is refused: it
    /// would lock everybody out.
    pub fn read(file: &Path) -> Result<Self, AuthError> {
        let text = std::fs::read_to_string(file).map_err(|problem| AuthError::Unreadable {
            file: file.to_owned(),
            problem,
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
            let problem = "has no [[principal]] and no [[issuer]]: nobody could call";
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

            // Two principals with one token would be one caller with an arbitrary choice of rights.
            if known.iter().any(|(other, _)| *other == proof) {
                return Err(unfit(
                    "has the token or certificate of another one".to_owned(),
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

    /// The same, with what did not change taken over from `before`: a caller's open streams go on,
    /// and count towards its limits as before.
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

    /// The principal with this token.
    ///
    /// # Errors
    /// [`Error::Unauthenticated`] if nobody has it, or its issuer says that it is not good now.
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
                // It may be for the audience of the next one.
                Err(error) => refusal = error,
            }
        }
        Err(refusal)
    }

    /// The principal with the certificate of this fingerprint.
    pub fn by_certificate(&self, fingerprint: &[u8; 32]) -> Option<Arc<Principal>> {
        self.by_proof(fingerprint, |proof| match proof {
            Proof::Certificate(digest) => Some(digest),
            Proof::Token(_) => None,
        })
    }

    /// All digests are compared, each in constant time: how long it takes tells nothing of a token.
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
    let rights = rights(name, verbs, rooms, [streams, requests])?;
    Ok((proof, Principal::new(rights)))
}

fn issuer(form: IssuerForm, file: &Path) -> Result<Issuer, String> {
    let limits = [form.streams, form.requests];
    let rights = rights(
        form.issuer.clone(),
        form.verbs.clone(),
        form.rooms.clone(),
        limits,
    )?;
    Issuer::new(form, rights, file.parent().unwrap_or(Path::new("")))
}

/// Rights as a file gives them; the limits are those of streams and of requests.
fn rights(
    name: String,
    verbs: Vec<Verb>,
    rooms: Vec<String>,
    [streams, requests]: [Option<usize>; 2],
) -> Result<Rights, String> {
    if verbs.is_empty() {
        return Err("verbs is empty: it could call nothing".to_owned());
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
        name,
        verbs,
        rooms: RoomScope(vec![rooms]),
    })
}

fn digest(key: &str, text: &str) -> Result<[u8; 32], String> {
    let bytes = hex::decode(text).ok();
    bytes
        .and_then(|bytes| bytes.try_into().ok())
        .ok_or_else(|| format!("{key} must be 64 hexadecimal digits"))
}

/// The credentials of a server, as their file is now.
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

    /// The credentials of now.
    pub fn current(&self) -> Arc<Credentials> {
        self.current.borrow().clone()
    }

    fn replace(&self, credentials: Credentials) {
        let credentials = credentials.taking_over(&self.current());
        self.current.send_replace(Arc::new(credentials));
    }

    /// Completes once the principal has other rights than when it was admitted, or none, or its
    /// token has expired.
    pub async fn revoked(&self, principal: &Arc<Principal>) {
        let mut changes = self.current.subscribe();
        let changed = changes.wait_for(|credentials| !credentials.holds(principal));
        let until = principal.signed.as_ref().and_then(|signed| signed.until);

        tokio::select! {
            // An error means that the server is gone.
            _ = changed => {}
            () = passed(until) => {}
        }
    }

    /// Looks from time to time whether the file has changed; never completes. A file that cannot be
    /// used changes nothing.
    pub async fn follow_file(&self) {
        // A file system that does not answer must hold up nothing but this.
        let read = || {
            let file = self.file.clone();
            tokio::task::spawn_blocking(move || Credentials::read(&file))
        };
        let mut trouble = String::new();

        loop {
            let Ok(credentials) = read().await else {
                return;
            };
            match credentials {
                Ok(credentials) => {
                    trouble.clear();
                    if credentials.digest != self.current().digest {
                        self.replace(credentials);
                        tracing::info!("the credentials were replaced");
                    }
                }
                // Trouble that lasts is logged once.
                Err(error) if error.to_string() == trouble => {}
                Err(error) => {
                    tracing::error!(%error, "the new credentials cannot be used; those before stay");
                    trouble = error.to_string();
                }
            }
            tokio::time::sleep(LOOK).await;
        }
    }
}

/// Completes at a time of the system's clock; never if there is none.
async fn passed(until: Option<SystemTime>) {
    let Some(until) = until else {
        return std::future::pending().await;
    };
    while let Ok(left) = until.duration_since(SystemTime::now()) {
        // The clock may be set while this waits.
        tokio::time::sleep(left.min(Duration::from_secs(60))).await;
    }
}

#[cfg(test)]
mod tests {
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

        // A certificate with the digest of a token is no token.
        let digest = hex::decode(SECRET).unwrap().try_into().unwrap();
        assert!(credentials.by_certificate(&digest).is_none());
    }

    /// Oracle: the promise: what is wrong is refused, and the message has the key.
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

    /// Oracle: the promise: who keeps its rights keeps what it has open; who has others, or none,
    /// is told so.
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

    /// Oracle: the clock: what ends when a token ends does not end before.
    #[tokio::test]
    async fn a_token_holds_until_it_ends() {
        let begun = SystemTime::now();
        passed(Some(begun + Duration::from_millis(200))).await;
        assert!(begun.elapsed().unwrap() >= Duration::from_millis(200));
        passed(Some(SystemTime::UNIX_EPOCH)).await;

        let never = tokio::time::timeout(Duration::from_millis(50), passed(None));
        assert!(never.await.is_err());
    }
}

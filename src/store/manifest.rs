//! The manifest of a revision: JSON that carries its own checksum.
//!
//! `{"sha256": "…", "body": {…}}`, the checksum being that of the body's bytes as they stand in the
//! file.

use object_store::path::Path;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

use super::{Error, sha256};

/// The version of the manifests that this program writes, and the newest that it reads.
pub const SCHEMA: u64 = 1;

/// A file of a revision.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectRef {
    /// Its name under `objects/`.
    pub file: String,
    /// Of its content, in hexadecimal.
    pub sha256: String,
    /// Its size.
    pub bytes: u64,
}

#[derive(Serialize, Deserialize)]
struct Envelope<'a> {
    sha256: String,
    #[serde(borrow)]
    body: &'a RawValue,
}

#[derive(Deserialize)]
struct Versioned {
    schema: u64,
}

/// The bytes of a manifest with this body.
pub fn encode(file: &str, body: &impl Serialize) -> Result<Vec<u8>, Error> {
    let damaged = |error: serde_json::Error| Error::Damaged {
        file: file.to_owned(),
        problem: error.to_string(),
    };
    let body = serde_json::to_string_pretty(body).map_err(damaged)?;
    let sha256 = sha256(body.as_bytes());

    let body = RawValue::from_string(body).map_err(damaged)?;
    serde_json::to_vec_pretty(&Envelope {
        sha256,
        body: &body,
    })
    .map_err(damaged)
}

/// Refuses a manifest that was moved or copied from another room, adapter or revision.
pub fn check_place(
    file: &str,
    folder: &Path,
    says: (&str, u64),
    revision: u64,
) -> Result<(), Error> {
    if says == (folder.filename().unwrap_or_default(), revision) {
        return Ok(());
    }

    let problem = format!(
        "says it is revision {} of '{}': it was moved or copied; remove it",
        says.1, says.0
    );

    Err(Error::Damaged {
        file: file.to_owned(),
        problem,
    })
}

/// The body of a manifest, if it is whole.
pub fn decode<T: DeserializeOwned>(file: &str, bytes: &[u8]) -> Result<T, Error> {
    let damaged = |problem: String| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let envelope: Envelope<'_> = serde_json::from_slice(bytes).map_err(|error| {
        damaged(format!(
            "is no manifest ({error}): it was truncated or altered; restore it, or remove it to go back to the \
             revision before"
        ))
    })?;

    if sha256(envelope.body.get().as_bytes()) != envelope.sha256 {
        return Err(damaged("does not have its own checksum: it was altered; restore it, or remove it to go back to the revision before".to_owned()));
    }

    let Versioned { schema } =
        serde_json::from_str(envelope.body.get()).map_err(|error| damaged(error.to_string()))?;
    if schema > SCHEMA {
        return Err(Error::Schema {
            file: file.to_owned(),
            schema,
        });
    }

    serde_json::from_str(envelope.body.get()).map_err(|error| damaged(error.to_string()))
}

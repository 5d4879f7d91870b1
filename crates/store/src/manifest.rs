//! The manifest of a revision: JSON that contains its own checksum.
//!
//! The format is `{"sha256": "…", "body": {…}}`. The checksum covers the body's bytes exactly as
//! stored in the file.

use object_store::path::Path;
use seese3_core::Cause;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

use super::{Error, sha256};

/// Manifest schema version that this program writes, and the newest that it reads.
pub const SCHEMA: u64 = 1;

/// A reference from a manifest to an object file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectRef {
    /// The name of the file under `objects/`.
    pub file: String,
    /// The SHA-256 of its content, in hexadecimal.
    pub sha256: String,
    /// Its size in bytes.
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

/// Serializes a body with its checksum. `file` is the name used in errors.
pub fn encode(file: &str, body: &impl Serialize) -> Result<Vec<u8>, Error> {
    let damaged = |error: serde_json::Error| Error::Damaged {
        file: file.to_owned(),
        problem: error.into(),
    };
    let body = serde_json::to_string_pretty(body).map_err(damaged)?;
    let sha256 = sha256(body.as_bytes());

    // A `RawValue` is written verbatim, so the text in the file is the text that was hashed.
    let body = RawValue::from_string(body).map_err(damaged)?;
    serde_json::to_vec_pretty(&Envelope {
        sha256,
        body: &body,
    })
    .map_err(damaged)
}

/// Rejects a manifest that was moved or copied from another room, adapter or revision. `says` is
/// the name and revision in the manifest.
pub fn check_place(
    file: &str,
    folder: &Path,
    says: (&str, u64),
    revision: u64,
) -> Result<(), Error> {
    // The checksum cannot detect this: a copied manifest is intact.
    if says == (folder.filename().unwrap_or_default(), revision) {
        return Ok(());
    }

    let problem = format!(
        "is the manifest of revision {} of '{}': it was moved or copied; remove it",
        says.1, says.0
    );

    Err(Error::Damaged {
        file: file.to_owned(),
        problem: problem.into(),
    })
}

/// Reads the body of a manifest and checks its checksum and schema version.
pub fn decode<T: DeserializeOwned>(file: &str, bytes: &[u8]) -> Result<T, Error> {
    let damaged = |problem: Cause| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let envelope: Envelope<'_> = serde_json::from_slice(bytes).map_err(|error| {
        damaged(format!(
            "is not a valid manifest ({error}): it was truncated or altered; restore it, or remove \
            it to return to the previous revision"
        ).into())
    })?;

    // The checksum covers the raw text of the body, so compare it before parsing.
    if sha256(envelope.body.get().as_bytes()) != envelope.sha256 {
        return Err(damaged(
            "does not have the checksum that it states: it was altered; restore it, or remove it \
        to return to the previous revision"
                .into(),
        ));
    }

    // Parse the schema version first. A body of a newer schema may not fit `T`, and the error
    // should then request an update instead of reporting damage.
    let Versioned { schema } =
        serde_json::from_str(envelope.body.get()).map_err(|error| damaged(error.into()))?;
    if schema > SCHEMA {
        return Err(Error::Schema {
            file: file.to_owned(),
            schema,
        });
    }

    serde_json::from_str(envelope.body.get()).map_err(|error| damaged(error.into()))
}

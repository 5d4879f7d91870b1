//! The store: versioned, checksummed rooms and adapters, in a folder or a bucket.
//!
//! ```text
//! rooms/NAME/objects/…            tensors, named by their content
//! rooms/NAME/revisions/000001.json   the manifest, written last: a version is visible whole or not at all
//! adapters/NAME/…                 the same
//! ```
//!
//! Tensors are safetensors files; in Python: `safetensors.numpy.load_file(path)`. Published
//! revisions never change.

mod adapters;
mod calibration;
mod format;
mod manifest;
mod rooms;
mod tensors;

pub use adapters::StoredAdapter;
pub use rooms::{RoomSummary, StoredRoom, check_features};

use std::sync::Arc;

use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload};
use sha2::{Digest, Sha256};
use tokio_stream::StreamExt;

/// What can go wrong with stored things. Each names the place and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("store '{location}' cannot be opened: {problem}")]
    Open { location: String, problem: String },
    #[error(
        "store '{location}' does not exist; make one with `seese3 import … --store {location}`"
    )]
    Missing { location: String },
    #[error("{kind} '{name}' is not in the store; it has {}", listed(known))]
    Unknown {
        kind: &'static str,
        name: String,
        known: Vec<String>,
    },
    #[error("{kind} '{name}' has no revision {revision}; its newest is {newest}")]
    UnknownRevision {
        kind: &'static str,
        name: String,
        revision: u64,
        newest: u64,
    },
    #[error("room '{room}' has no features '{name}'; it has {}", listed(known))]
    UnknownFeatures {
        room: String,
        name: String,
        known: Vec<String>,
    },
    #[error("room '{room}' has {}; name one", several(known))]
    WhichFeatures { room: String, known: Vec<String> },
    #[error("{name:?} is no name for {what}: use 1 to 100 letters, digits, '.', '-' or '_'")]
    Name { what: &'static str, name: String },
    #[error("{file}: {problem}")]
    Damaged { file: String, problem: String },
    #[error(
        "{file} was written by a newer version (schema {schema}, this program reads {}); update the program",
        manifest::SCHEMA
    )]
    Schema { file: String, schema: u64 },
    #[error("{file}: {cause}")]
    Io { file: String, cause: String },
    #[error(
        "could not publish '{name}': another publisher took every revision number that was tried"
    )]
    Contended { name: String },
    #[error("features '{name}' have {rows} rows, room '{room}' has {frame_count} frames")]
    FeatureRows {
        name: String,
        rows: usize,
        room: String,
        frame_count: usize,
    },
    #[error("features '{name}' were given twice")]
    DuplicateFeatures { name: String },
}

fn several(names: &[String]) -> String {
    if names.is_empty() {
        "no features".to_owned()
    } else {
        format!("several features ({})", names.join(", "))
    }
}

fn listed(names: &[String]) -> String {
    if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(", ")
    }
}

/// A version that was published, or found to be there already.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Published {
    /// Counted from 1.
    pub revision: u64,
    /// Whether it is new; publishing the same content again is not.
    pub is_new: bool,
    /// The manifest, relative to the store.
    pub manifest: String,
}

/// How often publishing tries again when another publisher was faster.
const ATTEMPTS: u64 = 16;

/// An opened store.
#[derive(Debug, Clone)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    location: String,
}

/// Rooms or adapters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Room,
    Adapter,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Room => "room",
            Self::Adapter => "adapter",
        }
    }

    fn folder(self) -> &'static str {
        match self {
            Self::Room => "rooms",
            Self::Adapter => "adapters",
        }
    }
}

impl Store {
    /// Opens a folder, making it if it is not there, or a bucket by its URL.
    ///
    /// # Errors
    /// [`Error::Open`].
    pub fn create(location: &str) -> Result<Self, Error> {
        if !location.contains("://") {
            std::fs::create_dir_all(location).map_err(|error| Error::Open {
                location: location.to_owned(),
                problem: error.to_string(),
            })?;
        }

        Self::open(location)
    }

    /// Opens a folder that exists, or a bucket by its URL.
    ///
    /// # Errors
    /// [`Error::Missing`] or [`Error::Open`].
    pub fn open(location: &str) -> Result<Self, Error> {
        let failed = |problem: String| Error::Open {
            location: location.to_owned(),
            problem,
        };

        if location.contains("://") {
            let url = url::Url::parse(location).map_err(|error| failed(error.to_string()))?;
            let (objects, prefix) =
                object_store::parse_url(&url).map_err(|error| failed(error.to_string()))?;
            let objects = object_store::prefix::PrefixStore::new(objects, prefix);

            return Ok(Self {
                objects: Arc::new(objects),
                location: location.to_owned(),
            });
        }

        if !std::path::Path::new(location).is_dir() {
            return Err(Error::Missing {
                location: location.to_owned(),
            });
        }

        let objects = LocalFileSystem::new_with_prefix(location)
            .map_err(|error| failed(error.to_string()))?;
        let objects = objects.with_fsync(true);

        Ok(Self {
            objects: Arc::new(objects),
            location: location.to_owned(),
        })
    }

    /// A store in any object store; `location` names it in messages.
    pub fn with_objects(objects: Arc<dyn ObjectStore>, location: &str) -> Self {
        Self {
            objects,
            location: location.to_owned(),
        }
    }

    /// Where it is, as it was given.
    pub fn location(&self) -> &str {
        &self.location
    }

    /// The name of a file of this store, for people.
    fn shown(&self, path: &Path) -> String {
        format!("{}/{path}", self.location.trim_end_matches('/'))
    }

    /// What the object store said, without the path that it repeats.
    fn io(&self, path: &Path, error: &object_store::Error) -> Error {
        let cause = match error {
            object_store::Error::NotFound { .. } => {
                "is missing; restore it, or publish again".to_owned()
            }
            other => other.to_string(),
        };
        Error::Io {
            file: self.shown(path),
            cause,
        }
    }

    async fn read(&self, path: &Path) -> Result<Vec<u8>, Error> {
        let io = |error| self.io(path, &error);
        let bytes = self
            .objects
            .get(path)
            .await
            .map_err(io)?
            .bytes()
            .await
            .map_err(io)?;

        Ok(bytes.to_vec())
    }

    /// Reads an object and checks that it is the one its manifest means.
    async fn read_object(
        &self,
        folder: &Path,
        object: &manifest::ObjectRef,
    ) -> Result<(String, Vec<u8>), Error> {
        let path = folder.clone().join("objects").join(object.file.as_str());
        let file = self.shown(&path);
        let bytes = self.read(&path).await?;

        let problem = if bytes.len() as u64 != object.bytes {
            format!(
                "is {} bytes long, its manifest says {}: it was truncated or altered",
                bytes.len(),
                object.bytes
            )
        } else if sha256(&bytes) != object.sha256 {
            "does not have the checksum of its manifest: it was altered".to_owned()
        } else {
            return Ok((file, bytes));
        };

        Err(Error::Damaged {
            file,
            problem: format!("{problem}; publish it again"),
        })
    }

    /// Writes an object under a name made of its content; writing it twice is harmless.
    async fn write_object(
        &self,
        folder: &Path,
        stem: &str,
        extension: &str,
        bytes: Vec<u8>,
    ) -> Result<manifest::ObjectRef, Error> {
        let sha256 = sha256(&bytes);
        let file = format!("{stem}-{}.{extension}", &sha256[..16]);
        let path = folder.clone().join("objects").join(file.as_str());
        let size = bytes.len() as u64;

        let written = self.objects.put(&path, PutPayload::from(bytes)).await;
        written.map_err(|error| self.io(&path, &error))?;

        Ok(manifest::ObjectRef {
            file,
            sha256,
            bytes: size,
        })
    }

    /// Writes a manifest if no other has that revision; false if one has.
    async fn write_manifest(
        &self,
        folder: &Path,
        revision: u64,
        bytes: Vec<u8>,
    ) -> Result<bool, Error> {
        let path = revision_path(folder, revision);
        let options = PutOptions::from(PutMode::Create);
        match self
            .objects
            .put_opts(&path, PutPayload::from(bytes), options)
            .await
        {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(self.io(&path, &error)),
        }
    }

    /// Names of a kind that have at least one revision, in order.
    async fn names(&self, kind: Kind) -> Result<Vec<String>, Error> {
        let folder = Path::from(kind.folder());
        let listed = self.objects.list_with_delimiter(Some(&folder)).await;
        let listed = listed.map_err(|error| self.io(&folder, &error))?;
        let mut names = Vec::new();

        for prefix in listed.common_prefixes {
            let Some(name) = prefix.filename().map(str::to_owned) else {
                continue;
            };
            if crate::room::is_plain_name(&name) && !self.revisions(&prefix).await?.is_empty() {
                names.push(name);
            }
        }

        names.sort();
        Ok(names)
    }

    /// Revisions of a room or an adapter, in order.
    async fn revisions(&self, folder: &Path) -> Result<Vec<u64>, Error> {
        let prefix = folder.clone().join("revisions");
        let mut listed = self.objects.list(Some(&prefix));
        let mut revisions = Vec::new();
        while let Some(entry) = listed.next().await {
            let entry = entry.map_err(|error| self.io(&prefix, &error))?;
            let name = entry.location.filename().unwrap_or_default();
            revisions.extend(
                name.strip_suffix(".json")
                    .and_then(|number| number.parse::<u64>().ok()),
            );
        }

        revisions.sort_unstable();
        Ok(revisions)
    }

    /// The revision asked for, or the newest.
    async fn resolve(
        &self,
        kind: Kind,
        name: &str,
        revision: Option<u64>,
    ) -> Result<(Path, u64), Error> {
        let folder = Path::from(kind.folder()).join(name);
        let revisions = if crate::room::is_plain_name(name) {
            self.revisions(&folder).await?
        } else {
            Vec::new()
        };

        let Some(&newest) = revisions.last() else {
            let known = self.names(kind).await?;
            return Err(Error::Unknown {
                kind: kind.name(),
                name: name.to_owned(),
                known,
            });
        };

        match revision {
            None => Ok((folder, newest)),
            Some(wanted) if revisions.contains(&wanted) => Ok((folder, wanted)),
            Some(revision) => Err(Error::UnknownRevision {
                kind: kind.name(),
                name: name.to_owned(),
                revision,
                newest,
            }),
        }
    }
}

fn revision_path(folder: &Path, revision: u64) -> Path {
    folder
        .clone()
        .join("revisions")
        .join(format!("{revision:06}.json"))
}

/// The beginning of a text's SHA-256, for names of files.
pub fn short_digest(text: &str) -> String {
    sha256(text.as_bytes())[..16].to_owned()
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

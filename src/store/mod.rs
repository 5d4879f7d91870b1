//! The store: versioned, checksummed rooms and adapters, in a local folder or an object store.
//!
//! ```text
//! rooms/NAME/objects/…               tensors and lists of names; the file name contains the hash
//! rooms/NAME/revisions/000001.json   the manifest, written last: a revision is visible completely
//!                                    or not at all
//! adapters/NAME/…                    the same for an adapter
//! ```
//!
//! Tensors are safetensors files; Python reads them with `safetensors.numpy.load_file(path)`.
//! Published revisions never change.

mod adapters;
mod error_model;
mod format;
mod manifest;
mod room_files;
mod room_fit;
mod rooms;
mod tensors;

pub use adapters::{BaseAdapter, RoomFit, StoredAdapter};
pub use rooms::{RoomSummary, StoredRoom, check_features};

use std::path::PathBuf;
use std::sync::Arc;

use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload};
use sha2::{Digest, Sha256};
use tokio_stream::StreamExt;

/// Why the store could not be read or written. Each message names the file, room or adapter
/// concerned; where there is a remedy, it says so.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
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
    #[error("{name:?} cannot name {what}: use 1 to 100 letters, digits, '.', '-' or '_'")]
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

/// The result of publishing: a new revision, or the existing one with the same content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Published {
    /// The number of the revision, counted from 1.
    pub revision: u64,
    /// Whether this call created the revision. Publishing unchanged content creates none.
    pub is_new: bool,
    /// The path of the manifest, relative to the root of the store.
    pub manifest: String,
}

/// How many revision numbers publishing tries before it fails, each lost to a faster publisher.
const ATTEMPTS: u64 = 16;

/// An opened store.
#[derive(Debug, Clone)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    location: String,
    /// The folder of a local store.
    folder: Option<PathBuf>,
}

/// The two kinds of content in a store.
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
    /// Opens the store in a folder, which is created if necessary, or at an object-store URL.
    ///
    /// # Errors
    /// [`Error::Open`] if the folder cannot be created or the store cannot be opened.
    pub fn create(location: &str) -> Result<Self, Error> {
        if !location.contains("://") {
            std::fs::create_dir_all(location).map_err(|error| Error::Open {
                location: location.to_owned(),
                problem: error.to_string(),
            })?;
        }

        Self::open(location)
    }

    /// Opens the store in an existing folder, or at an object-store URL.
    ///
    /// # Errors
    /// [`Error::Missing`] if the folder does not exist; [`Error::Open`] if the URL is not valid or
    /// not supported, or if the folder cannot be opened.
    pub fn open(location: &str) -> Result<Self, Error> {
        let failed = |problem: String| Error::Open {
            location: location.to_owned(),
            problem,
        };

        if location.contains("://") {
            let url = url::Url::parse(location).map_err(|error| failed(error.to_string()))?;
            let (objects, prefix) =
                object_store::parse_url(&url).map_err(|error| failed(error.to_string()))?;

            // From here on, all paths are relative to the folder in the URL, as they are for a
            // local store.
            let objects = object_store::prefix::PrefixStore::new(objects, prefix);

            return Ok(Self {
                objects: Arc::new(objects),
                location: location.to_owned(),
                folder: None,
            });
        }

        if !std::path::Path::new(location).is_dir() {
            return Err(Error::Missing {
                location: location.to_owned(),
            });
        }

        let objects = LocalFileSystem::new_with_prefix(location)
            .map_err(|error| failed(error.to_string()))?;

        // Every write reaches the disk before the next one starts. Otherwise a power failure could
        // leave a manifest whose objects were lost.
        let objects = objects.with_fsync(true);

        Ok(Self {
            objects: Arc::new(objects),
            location: location.to_owned(),
            folder: Some(PathBuf::from(location)),
        })
    }

    /// Uses an object store that is already open; `location` is its name in error messages.
    pub fn with_objects(objects: Arc<dyn ObjectStore>, location: &str) -> Self {
        Self {
            objects,
            location: location.to_owned(),
            folder: None,
        }
    }

    /// The folder or URL, exactly as the caller gave it.
    pub fn location(&self) -> &str {
        &self.location
    }

    /// The full path of a file of this store, for error messages.
    fn shown(&self, path: &Path) -> String {
        format!("{}/{path}", self.location.trim_end_matches('/'))
    }

    /// Converts an error of the object store. A missing object gets a message of its own that says
    /// what to do.
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
        // Opening a pipe would wait for someone to write into it.
        if let Some(folder) = &self.folder
            && std::fs::metadata(folder.join(path.as_ref())).is_ok_and(|found| !found.is_file())
        {
            return Err(Error::Damaged {
                file: self.shown(path),
                problem: "is not a regular file; restore it, or publish again".to_owned(),
            });
        }

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

    /// Reads an object and checks its length and checksum against the manifest. Returns the name of
    /// the file, for error messages, and its bytes.
    async fn read_object(
        &self,
        folder: &Path,
        object: &manifest::ObjectRef,
    ) -> Result<(String, Vec<u8>), Error> {
        let path = folder.clone().join("objects").join(object.file.as_str());
        let file = self.shown(&path);
        let bytes = self.read(&path).await?;

        // The length is compared first: it needs no hashing, and its difference points to a
        // truncated file.
        let problem = if bytes.len() as u64 != object.bytes {
            format!(
                "is {} bytes long, its manifest says {}: it was truncated or altered",
                bytes.len(),
                object.bytes
            )
        } else if sha256(&bytes) != object.sha256 {
            "does not have the checksum that its manifest states: it was altered".to_owned()
        } else {
            return Ok((file, bytes));
        };

        Err(Error::Damaged {
            file,
            problem: format!("{problem}; publish it again"),
        })
    }

    /// Writes an object under a name that contains the hash of its content, so that writing the
    /// same content twice is harmless.
    async fn write_object(
        &self,
        folder: &Path,
        stem: &str,
        extension: &str,
        bytes: Vec<u8>,
    ) -> Result<manifest::ObjectRef, Error> {
        let sha256 = sha256(&bytes);

        // 64 bits of the hash keep different contents apart: an existing object is only ever
        // replaced by the same bytes.
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

    /// Writes a manifest unless the revision already exists. Returns whether it was written.
    async fn write_manifest(
        &self,
        folder: &Path,
        revision: u64,
        bytes: Vec<u8>,
    ) -> Result<bool, Error> {
        let path = revision_path(folder, revision);

        // `Create` fails if the object exists. This one atomic write decides which of several
        // concurrent publishers gets the revision.
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

    /// The names of all rooms, or of all adapters, that have at least one revision; sorted.
    async fn names(&self, kind: Kind) -> Result<Vec<String>, Error> {
        let newest = self.newest(kind).await?;
        Ok(newest.into_iter().map(|(name, _)| name).collect())
    }

    /// The same, each with its newest revision.
    async fn newest(&self, kind: Kind) -> Result<Vec<(String, u64)>, Error> {
        let folder = Path::from(kind.folder());
        let listed = self.objects.list_with_delimiter(Some(&folder)).await;
        let listed = listed.map_err(|error| self.io(&folder, &error))?;
        let mut newest = Vec::new();

        for prefix in listed.common_prefixes {
            let Some(name) = prefix.filename().map(str::to_owned) else {
                continue;
            };
            if !seese3_core::room::is_plain_name(&name) {
                continue;
            }

            // A folder without a revision was left by an interrupted publication, since the
            // manifest is written last. It does not count as published.
            if let Some(&revision) = self.revisions(&prefix).await?.last() {
                newest.push((name, revision));
            }
        }

        newest.sort();
        Ok(newest)
    }

    /// The revision numbers of a room or an adapter, in ascending order.
    async fn revisions(&self, folder: &Path) -> Result<Vec<u64>, Error> {
        let prefix = folder.clone().join("revisions");
        let mut listed = self.objects.list(Some(&prefix));
        let mut revisions = Vec::new();
        while let Some(entry) = listed.next().await {
            let entry = entry.map_err(|error| self.io(&prefix, &error))?;
            let name = entry.location.filename().unwrap_or_default();
            let number = name
                .strip_suffix(".json")
                .and_then(|number| number.parse::<u64>().ok());

            // Only names that publishing gives count: a copy such as `2.json` is no revision.
            revisions.extend(number.filter(|&revision| name == manifest_name(revision)));
        }

        revisions.sort_unstable();
        Ok(revisions)
    }

    /// The folder of a room or an adapter, and the requested revision or else the newest.
    async fn resolve(
        &self,
        kind: Kind,
        name: &str,
        revision: Option<u64>,
    ) -> Result<(Path, u64), Error> {
        let folder = Path::from(kind.folder()).join(name);

        // A name that is not valid cannot have been published. It is treated like an unknown one
        // and never listed as a path.
        let revisions = if seese3_core::room::is_plain_name(name) {
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
        .join(manifest_name(revision))
}

fn manifest_name(revision: u64) -> String {
    format!("{revision:06}.json")
}

/// The first 16 hexadecimal digits of a text's SHA-256, for use in file names.
pub fn short_digest(text: &str) -> String {
    sha256(text.as_bytes())[..16].to_owned()
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

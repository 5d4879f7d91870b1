//! Versioned, checksummed storage of rooms and adapters, in a local folder or an object store.
//!
//! ```text
//! rooms/NAME/objects/…               tensors and lists of names; the file name contains the hash
//! rooms/NAME/revisions/000001.json   the manifest, written last, so that a revision appears
//!                                    atomically
//! rooms/NAME/revisions/000002.gone   a removed revision; its number is not reused
//! adapters/NAME/…                    the same for an adapter
//! defaults/000001.json               the operator's defaults, see [`Defaults`]
//! derived/…                          what servers have derived from rooms, see [`Derived`]
//! ```
//!
//! Tensors are safetensors files; Python reads them with `safetensors.numpy.load_file(path)`.
//! Published revisions never change.
//!
//! ```
//! use seese3_core::geometry::Pose;
//! use seese3_core::room::{Frames, Provenance, Room, RoomId};
//! use seese3_store::Store;
//!
//! # #[tokio::main]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! # let location = folder.path().to_str().unwrap();
//! let frames = Frames {
//!     poses: vec![Pose::default(); 3],
//!     ..Frames::default()
//! };
//! let room = Room::new(RoomId::new("hall")?, frames, Provenance::default())?;
//!
//! let store = Store::create(location)?;
//! let published = store.publish_room(&room, &[]).await?;
//! assert!(published.is_new && published.revision == 1);
//! assert_eq!(store.load_room("hall", None).await?.room.frame_count(), 3);
//! # Ok(()) }
//! ```

pub mod fit_stored_room;
mod bucket;
mod conditional_writes;
mod object_cache;
mod publication;
mod manifest;
mod resource;
mod stored_adapter;
mod tensors;
mod room_keypoints;
mod defaults;
mod error_model;
mod relational_reader;
mod format;
mod derived;
mod room_files;
mod verification;
mod contents;
mod garbage;
mod removal;
mod quota;
mod room_fit;
mod rooms;
mod room_publishing;
mod adapter_files;
mod foreign_adapter;
mod extension;
mod map_edits;
mod adapters;
pub mod adapter_choice;

pub use adapter_files::{check_adapter_files, stated_weights_size};
pub use foreign_adapter::{ForeignAdapter, read_foreign_adapter};

pub use contents::{Contents, RevisionContents, Usage};
pub use defaults::{Choice, Cleared, Defaults, StandingDefaults};
pub use derived::{Derived, DerivedKey};
pub use extension::{AddedPart, ExtendedRoom, OtherFeatures};
pub use garbage::{Garbage, GarbageFile, GarbagePolicy, Publishers};
pub use map_edits::EditedRoom;
pub use object_cache::ObjectCache;
pub use publication::{Clock, GRACE, LONGEST_PUBLICATION, UploadPolicy};
pub use quota::{Quota, Quotas, Scope};
pub use removal::Removed;
pub use resource::{Kind, ResourceName, ResourceNameError};
pub use room_keypoints::{HeaderError, KeypointsHeader, RoomKeypoints};
pub use room_publishing::{RoomContents, check_features};
pub use rooms::{RoomSummary, StoredRoom};
pub use stored_adapter::{BaseAdapter, RoomFit, StoredAdapter};
pub use verification::Finding;

use seese3_core::Cause;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::Arc;

use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload};
use publication::Publication;
use sha2::{Digest, Sha256};
use tokio::sync::OnceCell;

/// Errors of reading and writing the store. Each message names the file, room or adapter and, where
/// there is a remedy, the remedy.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("store '{location}' cannot be opened: {problem}")]
    Open {
        location: String,
        #[source]
        problem: Cause,
    },
    #[error("store '{location}' cannot be written: {problem}")]
    ReadOnly {
        location: String,
        #[source]
        problem: Cause,
    },
    #[error(
        "store '{location}' does not support writes with If-None-Match, so that concurrent publishers could overwrite each \
         other's revisions; use a server that supports this header"
    )]
    NotConditional { location: String },
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
    #[error(
        "{manifest}: the publication took longer than {} minutes, so garbage collection may have removed its \
         objects; publish again, over a faster connection",
        LONGEST_PUBLICATION.as_secs() / 60
    )]
    TooSlow { manifest: String },
    #[error(
        "files younger than {} minutes may belong to a publication in progress; keep them, or state that \
         nothing publishes to the store: --no-concurrent-publishers",
        GRACE.as_secs() / 60
    )]
    Grace,
    #[error(
        "{used}; delete revisions that are not needed, or ask the operator for a larger quota; bytes \
         are free again after garbage collection"
    )]
    Quota { used: String },
    #[error(
        "{kind} '{name}' exists in revision {revision} with other content; upload under another name, or state \
         that it is to be replaced{}",
        if *kind == "room" { " or extended" } else { "" }
    )]
    Exists {
        kind: &'static str,
        name: String,
        revision: u64,
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
    #[error("room '{room}': {problem}")]
    Join {
        room: String,
        #[source]
        problem: seese3_core::features::Error,
    },
    #[error("room '{room}' has {}; name one", several(known))]
    WhichFeatures { room: String, known: Vec<String> },
    #[error("{name:?} cannot name {what}: use 1 to 100 letters, digits, '.', '-' or '_'")]
    Name { what: &'static str, name: String },
    #[error("{file}: {problem}")]
    Damaged {
        file: String,
        #[source]
        problem: Cause,
    },
    #[error(
        "{file} was written by a newer version (schema {schema}, this program reads {}); update the program",
        manifest::SCHEMA
    )]
    Schema { file: String, schema: u64 },
    #[error("{file}: {cause}")]
    Io {
        file: String,
        #[source]
        cause: Cause,
    },
    #[error("{file} is missing; restore it, or publish again")]
    Absent { file: String },
    #[error(
        "could not publish '{name}': every number tried is taken, by another publisher or by \
         an entry that is not a file"
    )]
    Contended { name: String },
    #[error("features '{name}' have {rows} rows, room '{room}' has {frame_count} frames")]
    FeatureRows {
        name: String,
        rows: usize,
        room: String,
        frame_count: usize,
    },
    #[error("the keypoints are of {frames} frames, room '{room}' has {frame_count}")]
    KeypointFrames {
        room: String,
        frames: usize,
        frame_count: usize,
    },
    #[error("features '{name}' were given twice")]
    DuplicateFeatures { name: String },
    #[error(
        "room '{room}' has other frames since revision {revision}; use another name, or \
         replace the room explicitly"
    )]
    OtherFrames { room: String, revision: u64 },
    #[error("frames cannot be added to room '{room}': {problem}")]
    CannotAdd {
        room: String,
        part: AddedPart,
        #[source]
        problem: Cause,
    },
    #[error("the tracking parameters of room '{room}' cannot be published: {problem}")]
    TrackingParameters {
        room: String,
        #[source]
        problem: seese3_robot::pose_filter::ParameterError,
    },
    #[error("room '{room}' cannot be changed like that: {problem}")]
    CannotEdit {
        room: String,
        #[source]
        problem: Cause,
    },
    #[error("{resource} cannot be removed: {reason}")]
    InUse { resource: String, reason: String },
    #[error("there is no change of the defaults to roll back")]
    NothingToTakeBack,
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

/// Largest number of a revision or defaults file; files with larger numbers are ignored.
const HIGHEST: u64 = 999_999_999_999;
/// Number of attempts at publishing; each fails if another publisher took the revision number
/// first.
const ATTEMPTS: u64 = 16;

/// An opened store.
#[derive(Debug, Clone)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    location: String,
    /// The folder of a local store.
    folder: Option<PathBuf>,
    /// Measures how long publications take.
    clock: Clock,
    /// Limits of publications.
    quotas: Arc<Quotas>,
    /// Objects that were read before.
    cache: Option<Arc<ObjectCache>>,
    /// Set once the server was seen to support conditional writes; `None` for a store opened as a
    /// folder.
    is_conditional: Option<Arc<OnceCell<()>>>,
}

/// The numbers of the files in a folder of numbered files, such as `revisions/`.
#[derive(Debug, Default)]
struct Numbers {
    /// Numbers of the existing files, in ascending order.
    present: Vec<u64>,
    /// The highest number ever assigned, including removed revisions; 0 if none.
    highest: u64,
}

impl Store {
    /// Opens the store in a folder, creating the folder if necessary, or at an object-store URL.
    ///
    /// # Errors
    /// [`Error::Open`] if the folder cannot be created or the store cannot be opened.
    pub fn create(location: &str) -> Result<Self, Error> {
        if !location.contains("://") {
            std::fs::create_dir_all(location).map_err(|error| Error::Open {
                location: location.to_owned(),
                problem: error.into(),
            })?;
        }

        Self::open(location)
    }

    /// Checks that the store can be written, by an empty object that is removed again. For commands
    /// that compute for minutes before they publish.
    ///
    /// # Errors
    /// [`Error::ReadOnly`] if it cannot be written; in a bucket also as
    /// [`Store::check_conditional_writes`].
    pub async fn check_writable(&self) -> Result<(), Error> {
        let since = std::time::UNIX_EPOCH.elapsed().unwrap_or_default();
        let probe = format!("probe-{}-{}", std::process::id(), since.as_nanos());
        let probe = Path::from(probe);
        let read_only = |error: object_store::Error| Error::ReadOnly {
            location: self.location().to_owned(),
            problem: error.into(),
        };
        let written = self.objects.put(&probe, PutPayload::new()).await;
        written.map_err(read_only)?;
        self.objects.delete(&probe).await.map_err(read_only)?;
        self.check_conditional_writes().await
    }

    /// Opens the store in an existing folder, or at an object-store URL.
    ///
    /// # Errors
    /// [`Error::Missing`] if the folder does not exist; [`Error::Open`] if the URL is not valid or
    /// not supported, or if the folder cannot be opened.
    pub fn open(location: &str) -> Result<Self, Error> {
        let text = |(name, value): (OsString, OsString)| {
            Some((name.into_string().ok()?, value.into_string().ok()?))
        };
        Self::open_with(
            location,
            &std::env::vars_os().filter_map(text).collect::<Vec<_>>(),
        )
    }

    /// As [`Store::open`], where `variables` stand for the environment, from which the settings of
    /// a bucket are read: names and values.
    ///
    /// # Errors
    /// As [`Store::open`].
    pub fn open_with(location: &str, variables: &[(String, String)]) -> Result<Self, Error> {
        let failed = |problem: Cause| Error::Open {
            location: location.to_owned(),
            problem,
        };

        if location.contains("://") {
            let url = url::Url::parse(location).map_err(|error| failed(error.into()))?;
            let (objects, prefix) =
                bucket::open(&url, variables).map_err(|problem| failed(problem.into()))?;

            // From here on, all paths are relative to the folder in the URL, as they are for a
            // local store.
            let objects = object_store::prefix::PrefixStore::new(objects, prefix);

            return Ok(Self::with_objects(Arc::new(objects), location).with_write_check());
        }

        if !std::path::Path::new(location).is_dir() {
            return Err(Error::Missing {
                location: location.to_owned(),
            });
        }

        let objects =
            LocalFileSystem::new_with_prefix(location).map_err(|error| failed(error.into()))?;

        // Every write reaches the disk before the next one starts. Otherwise a power failure could
        // leave a manifest whose objects were lost.
        let objects = objects.with_fsync(true);

        Ok(Self {
            folder: Some(PathBuf::from(location)),
            ..Self::with_objects(Arc::new(objects), location)
        })
    }

    /// Uses an object store that is already open; `location` is its name in error messages.
    pub fn with_objects(objects: Arc<dyn ObjectStore>, location: &str) -> Self {
        Self {
            objects,
            location: location.to_owned(),
            folder: None,
            clock: Clock::default(),
            quotas: Arc::default(),
            cache: None,
            is_conditional: None,
        }
    }

    /// The same store, which verifies the server's support for conditional writes before the first
    /// one.
    pub fn with_write_check(self) -> Self {
        Self {
            is_conditional: Some(Arc::default()),
            ..self
        }
    }

    /// Whether the store is at an object-store URL.
    pub fn is_bucket(&self) -> bool {
        self.is_conditional.is_some()
    }

    /// The same store with a cache of the objects that it reads.
    pub fn with_cache(self, cache: ObjectCache) -> Self {
        Self {
            cache: Some(Arc::new(cache)),
            ..self
        }
    }

    /// The same store with another clock for the time limit of publications.
    pub fn with_clock(self, clock: Clock) -> Self {
        Self { clock, ..self }
    }

    /// The folder or URL, exactly as the caller gave it.
    pub fn location(&self) -> &str {
        &self.location
    }

    /// The full path of a file of this store, for error messages.
    fn shown(&self, path: &Path) -> String {
        format!("{}/{path}", self.location.trim_end_matches('/'))
    }

    /// Converts an object-store error. A missing object becomes [`Error::Absent`], whose message
    /// states the remedy.
    fn io(&self, path: &Path, error: object_store::Error) -> Error {
        let file = self.shown(path);
        match error {
            object_store::Error::NotFound { .. } => Error::Absent { file },
            // Only the file system's message, without the prefix that the library adds.
            object_store::Error::Generic { source, .. } => Error::Io {
                file,
                cause: source,
            },
            other => Error::Io {
                file,
                cause: other.into(),
            },
        }
    }

    async fn read(&self, path: &Path) -> Result<Vec<u8>, Error> {
        // Opening a named pipe would block until another process writes to it.
        if let Some(folder) = &self.folder
            && std::fs::metadata(folder.join(path.as_ref())).is_ok_and(|found| !found.is_file())
        {
            return Err(Error::Damaged {
                file: self.shown(path),
                problem: "is not a regular file; restore it, or publish again".into(),
            });
        }

        let io = |error| self.io(path, error);
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
        let cache = self.cache.as_deref();
        if let Some(bytes) = cache.and_then(|cache| cache.get(&object.sha256)) {
            return Ok((file, bytes));
        }
        let bytes = match self.read(&path).await {
            Err(Error::Absent { file }) => self
                .read_from_quarantine(folder, &object.file)
                .await?
                .ok_or(Error::Absent { file })?,
            read => read?,
        };

        // The length is compared first: it needs no hashing, and a difference indicates truncation.
        let problem = if bytes.len() as u64 != object.bytes {
            format!(
                "is {} bytes long but its manifest states {}: it was truncated or altered",
                bytes.len(),
                object.bytes
            )
        } else if sha256(&bytes) != object.sha256 {
            "does not have the checksum that its manifest states: it was altered".to_owned()
        } else {
            if let Some(Err(problem)) = cache.map(|cache| cache.put(&object.sha256, &bytes)) {
                tracing::warn!(%problem, file, "cannot write to the store cache");
            }
            return Ok((file, bytes));
        };

        Err(Error::Damaged {
            file,
            problem: format!("{problem}; publish it again").into(),
        })
    }

    /// Writes an object under a name that contains the hash of its content, so that writing the
    /// same content twice is harmless. Writes nothing if a quota is reached.
    async fn write_object(
        &self,
        publication: &Publication,
        folder: &Path,
        stem: &str,
        extension: &str,
        bytes: Vec<u8>,
    ) -> Result<manifest::ObjectRef, Error> {
        let sha256 = sha256(&bytes);

        // 64 bits of the hash identify the content: an existing object is only ever replaced by
        // identical bytes.
        let file = format!("{stem}-{}.{extension}", &sha256[..16]);
        let path = folder.clone().join("objects").join(file.as_str());
        let size = bytes.len() as u64;

        if publication.may_write() {
            let written = self.objects.put(&path, PutPayload::from(bytes)).await;
            written.map_err(|error| self.io(&path, error))?;
        }

        Ok(manifest::ObjectRef {
            file,
            sha256,
            bytes: size,
        })
    }

    /// Whether an object referenced by a revision is missing or incomplete: a concurrent garbage
    /// collection may have removed it during publication, and a publication of the same content may
    /// have been interrupted.
    async fn lacks<'a>(
        &self,
        folder: &Path,
        objects: impl Iterator<Item = &'a manifest::ObjectRef>,
    ) -> Result<bool, Error> {
        for object in objects {
            let path = folder.clone().join("objects").join(object.file.as_str());
            match self.objects.head(&path).await {
                Ok(found) if found.size == object.bytes => {}
                Ok(_) | Err(object_store::Error::NotFound { .. }) => return Ok(true),
                Err(error) => return Err(self.io(&path, error)),
            }
        }

        Ok(false)
    }

    /// Writes a manifest unless the revision exists or was removed. Returns whether the revision
    /// exists now.
    ///
    /// # Errors
    /// As [`Publication::check`]; [`Error::Io`] if the store cannot be written.
    async fn write_manifest(
        &self,
        publication: &Publication,
        folder: &Path,
        revision: u64,
        bytes: Vec<u8>,
    ) -> Result<bool, Error> {
        let path = revision_path(folder, revision);
        publication.check(&self.shown(&path))?;
        if !self.write_new(&path, bytes).await? {
            return Ok(false);
        }

        // The number may have been published and removed since it was chosen. Then the revision
        // is not visible, and its number is not used again.
        let gone = folder.clone().join("revisions").join(gone_name(revision));
        match self.objects.head(&gone).await {
            Ok(_) => Ok(false),
            Err(object_store::Error::NotFound { .. }) => Ok(true),
            Err(error) => Err(self.io(&gone, error)),
        }
    }

    /// Writes a file unless it exists. Returns whether it was written. Atomic, also between
    /// concurrent writers.
    async fn write_new(&self, path: &Path, bytes: Vec<u8>) -> Result<bool, Error> {
        self.check_conditional_writes().await?;

        // `Create` fails if the object exists, so exactly one of several concurrent writers gets
        // the number.
        let options = PutOptions::from(PutMode::Create);
        match self
            .objects
            .put_opts(path, PutPayload::from(bytes.clone()), options)
            .await
        {
            Ok(_) => Ok(true),
            // The answer to this write, or to a first attempt at it, may have been lost.
            Err(error) if self.is_conditional.is_some() => match self.read(path).await {
                Ok(found) if found == bytes => Ok(true),
                _ if matches!(error, object_store::Error::AlreadyExists { .. }) => Ok(false),
                _ => Err(self.io(path, error)),
            },
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(self.io(path, error)),
        }
    }

    /// The names of all rooms, or of all adapters, that have at least one revision; sorted.
    async fn names(&self, kind: Kind) -> Result<Vec<String>, Error> {
        let numbered = self.numbered(kind).await?;
        Ok(numbered.into_iter().map(|(name, _)| name).collect())
    }

    /// Like `names`, each with its current revision under `defaults`: the chosen one, else the
    /// newest.
    async fn current(&self, kind: Kind, defaults: &Defaults) -> Result<Vec<(String, u64)>, Error> {
        let current = |(name, numbers): (String, Numbers)| {
            let chosen = defaults.revision(kind, &name);
            let newest = numbers.present.last().copied();
            chosen.or(newest).map(|revision| (name, revision))
        };

        let numbered = self.numbered(kind).await?;
        Ok(numbered.into_iter().filter_map(current).collect())
    }

    /// The names of all rooms, or of all adapters, each with its revisions; sorted.
    async fn numbered(&self, kind: Kind) -> Result<Vec<(String, Numbers)>, Error> {
        let mut numbered = Vec::new();

        for (name, folder) in self.folders(kind).await? {
            // A folder without a revision is left over from a removal or from an interrupted
            // publication, since the manifest is written last. It does not count as published.
            let numbers = self.revisions(&folder).await?;
            if !numbers.present.is_empty() {
                numbered.push((name, numbers));
            }
        }

        Ok(numbered)
    }

    /// Whether the store has, or ever had, a room or adapter of this kind.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn remembers(&self, kind: Kind) -> Result<bool, Error> {
        for (_, folder) in self.folders(kind).await? {
            if self.revisions(&folder).await?.highest > 0 {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Rejects a path of a local store that exists and is not a folder; it would be listed as an
    /// empty folder.
    fn check_folder(&self, path: &Path) -> Result<(), Error> {
        let Some(root) = &self.folder else {
            return Ok(());
        };
        let place = root.join(path.as_ref());
        if std::fs::symlink_metadata(&place).is_ok() && !place.is_dir() {
            return Err(Error::Damaged {
                file: self.shown(path),
                problem: "is not a folder; restore it".into(),
            });
        }
        Ok(())
    }

    /// All folders of a kind, including those without a revision; sorted by name.
    async fn folders(&self, kind: Kind) -> Result<Vec<(String, Path)>, Error> {
        let folder = Path::from(kind.collection());
        self.check_folder(&folder)?;
        let listed = self.objects.list_with_delimiter(Some(&folder)).await;
        let listed = listed.map_err(|error| self.io(&folder, error))?;

        let named = |prefix: Path| {
            let name = prefix.filename().map(str::to_owned)?;
            seese3_core::room::is_plain_name(&name).then_some((name, prefix))
        };
        let mut folders: Vec<(String, Path)> = listed
            .common_prefixes
            .into_iter()
            .filter_map(named)
            .collect();

        folders.sort();
        Ok(folders)
    }

    /// The revisions of a room or an adapter.
    async fn revisions(&self, folder: &Path) -> Result<Numbers, Error> {
        self.numbered_files(&folder.clone().join("revisions")).await
    }

    /// The numbers of the files in a folder.
    async fn numbered_files(&self, folder: &Path) -> Result<Numbers, Error> {
        self.check_folder(folder)?;
        let mut numbers = Numbers::default();
        let mut gone = BTreeSet::new();

        for name in &self.file_names(folder).await? {
            let Some((number, extension)) = name.split_once('.') else {
                continue;
            };
            let Some(number) = number.parse().ok().filter(|number| *number <= HIGHEST) else {
                continue;
            };

            // Only canonical names count: a copy such as `2.json` is not a revision.
            match extension {
                "json" if *name == manifest_name(number) => numbers.present.push(number),
                "gone" if *name == gone_name(number) => {
                    gone.insert(number);
                }
                _ => continue,
            }
            numbers.highest = numbers.highest.max(number);
        }

        // A removal may be interrupted before it deletes the manifest, and a stalled publication
        // may write the manifest of a number that was published and removed meanwhile.
        numbers.present.retain(|number| !gone.contains(number));
        numbers.present.sort_unstable();
        Ok(numbers)
    }

    /// The names of the files in a folder. In a folder of this machine, only the names are read:
    /// the object store would also ask for the size and the time of each file.
    async fn file_names(&self, folder: &Path) -> Result<Vec<String>, Error> {
        let Some(root) = &self.folder else {
            let listed = self.objects.list_with_delimiter(Some(folder)).await;
            let listed = listed.map_err(|error| self.io(folder, error))?;
            let names = listed
                .objects
                .iter()
                .filter_map(|file| file.location.filename());
            return Ok(names.map(str::to_owned).collect());
        };

        let io = |cause: std::io::Error| Error::Io {
            file: self.shown(folder),
            cause: cause.into(),
        };
        let entries = match std::fs::read_dir(root.join(folder.as_ref())) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries.map_err(io)?,
        };
        let mut names = Vec::new();
        for entry in entries {
            names.extend(entry.map_err(io)?.file_name().into_string());
        }
        Ok(names)
    }

    /// The folder of a room or adapter, and the requested revision or else the current one: the
    /// operator's default, or the newest.
    async fn resolve(
        &self,
        kind: Kind,
        name: &str,
        revision: Option<u64>,
    ) -> Result<(Path, u64), Error> {
        let revision = match revision {
            Some(revision) => Some(revision),
            None => self.defaults().await?.revision(kind, name),
        };

        self.published(kind, name, revision).await
    }

    /// The folder of a room or an adapter, and the requested revision or else the newest.
    async fn published(
        &self,
        kind: Kind,
        name: &str,
        revision: Option<u64>,
    ) -> Result<(Path, u64), Error> {
        let folder = folder_of(kind, name);

        // An invalid name cannot have been published: treat it as unknown, and never use it as a
        // path.
        let revisions = if seese3_core::room::is_plain_name(name) {
            self.revisions(&folder).await?.present
        } else {
            Vec::new()
        };

        let Some(&newest) = revisions.last() else {
            let known = self.names(kind).await?;
            return Err(Error::Unknown {
                kind: kind.into(),
                name: name.to_owned(),
                known,
            });
        };

        match revision {
            None => Ok((folder, newest)),
            Some(wanted) if revisions.contains(&wanted) => Ok((folder, wanted)),
            Some(revision) => Err(Error::UnknownRevision {
                kind: kind.into(),
                name: name.to_owned(),
                revision,
                newest,
            }),
        }
    }
}

fn folder_of(kind: Kind, name: &str) -> Path {
    Path::from(kind.collection()).join(name)
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

/// The file name that marks a removed revision.
fn gone_name(revision: u64) -> String {
    format!("{revision:06}.gone")
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

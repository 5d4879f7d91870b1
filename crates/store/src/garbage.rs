//! Collecting what nothing needs: objects of publications that were interrupted or removed, and
//! files that a write left unfinished.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use chrono::{DateTime, Utc};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt};
use tokio_stream::StreamExt;

use super::format::{AdapterBody, RoomBody};
use super::{Error, Kind, Store, gone_name, manifest};

/// The folders of a store; what else is beside them belongs to somebody else.
const STORE_FOLDERS: [&str; 3] = ["rooms", "adapters", "defaults"];

/// What nothing in the store needs.
#[derive(Debug, Clone, Default)]
pub struct Garbage {
    /// The files.
    pub files: Vec<GarbageFile>,
    /// Folders that were left alone, with the reason: a manifest in them cannot be read, so nobody
    /// knows what it needs.
    pub left_alone: Vec<String>,
}

/// A file that nothing needs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GarbageFile {
    /// Its path, relative to the root of the store.
    pub path: String,
    /// Its size, bytes.
    pub bytes: u64,
}

impl Garbage {
    /// The size of all files, bytes.
    pub fn bytes(&self) -> u64 {
        self.files.iter().map(|file| file.bytes).sum()
    }
}

impl Store {
    /// Finds what nothing needs and nobody has written for `older_than`. A publication that is being
    /// written has objects that no manifest names yet: give it the time that the longest one takes.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be read.
    pub async fn find_garbage(&self, older_than: Duration) -> Result<Garbage, Error> {
        let mut garbage = Garbage::default();
        let before = written_before(older_than);

        for kind in Kind::ALL {
            for (_, folder) in self.folders(kind).await? {
                self.find_objects(kind, &folder, before, &mut garbage)
                    .await?;
            }
        }
        self.find_unfinished(before, &mut garbage)?;

        Ok(garbage)
    }

    /// Removes what [`Store::find_garbage`] finds, and returns it.
    ///
    /// # Errors
    /// As [`Store::find_garbage`]; [`Error::Io`] if a file cannot be removed.
    pub async fn collect_garbage(&self, older_than: Duration) -> Result<Garbage, Error> {
        let before = written_before(older_than);
        let mut garbage = self.find_garbage(older_than).await?;
        let mut removed = Vec::with_capacity(garbage.files.len());

        for file in garbage.files {
            // Somebody who publishes the same content again has written the object anew.
            let path = Path::from(file.path.as_str());
            let now = self.objects.head(&path).await;
            if now.is_ok_and(|now| now.last_modified > before) {
                continue;
            }

            self.remove_file(&file.path).await?;
            removed.push(file);
        }

        garbage.files = removed;
        Ok(garbage)
    }

    /// Removes a file, unless it is gone already.
    async fn remove_file(&self, file: &str) -> Result<(), Error> {
        let path = Path::from(file);

        // The names of unfinished files are none that the object store would accept.
        if let Some(folder) = &self.folder {
            return match std::fs::remove_file(folder.join(file)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(Error::Io {
                    file: self.shown(&path),
                    cause: error.into(),
                }),
                _ => Ok(()),
            };
        }

        match self.objects.delete(&path).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.io(&path, error)),
        }
    }

    /// Finds the objects of one room or adapter that no manifest names.
    async fn find_objects(
        &self,
        kind: Kind,
        folder: &Path,
        before: DateTime<Utc>,
        garbage: &mut Garbage,
    ) -> Result<(), Error> {
        // The objects are listed before the manifests are read. What is published in between finds
        // its objects either too young or named.
        let objects = self.listed(&folder.clone().join("objects")).await?;
        let needed = match self.needed(kind, folder, before).await {
            Ok(needed) => needed,
            Err(error @ (Error::Damaged { .. } | Error::Schema { .. })) => {
                garbage.left_alone.push(format!("{folder}: {error}"));
                return Ok(());
            }
            Err(error) => return Err(error),
        };

        let is_garbage = |object: &&ObjectMeta| {
            let name = object.location.filename().unwrap_or_default();
            object.last_modified <= before && !needed.contains(name)
        };
        garbage
            .files
            .extend(objects.iter().filter(is_garbage).map(|object| GarbageFile {
                path: object.location.to_string(),
                bytes: object.size,
            }));

        Ok(())
    }

    /// The names of the objects that the manifests of a folder need. Revisions that were removed
    /// lately count: a publication may have begun from one of them.
    async fn needed(
        &self,
        kind: Kind,
        folder: &Path,
        before: DateTime<Utc>,
    ) -> Result<BTreeSet<String>, Error> {
        let mut needed = BTreeSet::new();

        for entry in self.listed(&folder.clone().join("revisions")).await? {
            let name = entry.location.filename().unwrap_or_default();
            let is_gone = name
                .strip_suffix(".gone")
                .and_then(|number| number.parse().ok())
                .is_some_and(|number| name == gone_name(number));
            if !name.ends_with(".json") && !is_gone || is_gone && entry.last_modified <= before {
                continue;
            }

            let file = self.shown(&entry.location);
            let bytes = match self.read(&entry.location).await {
                Ok(bytes) => bytes,
                // It was removed since it was listed.
                Err(Error::Absent { .. }) => match self.read(&gone_path(&entry.location)).await {
                    Ok(bytes) => bytes,
                    Err(Error::Absent { .. }) => continue,
                    Err(error) => return Err(error),
                },
                Err(error) => return Err(error),
            };
            let objects: Vec<String> = match kind {
                Kind::Room => {
                    let body: RoomBody = manifest::decode(&file, &bytes)?;
                    body.objects().map(|object| object.file.clone()).collect()
                }
                Kind::Adapter => {
                    let body: AdapterBody = manifest::decode(&file, &bytes)?;
                    body.objects().map(|object| object.file.clone()).collect()
                }
            };
            needed.extend(objects);
        }

        Ok(needed)
    }

    async fn listed(&self, folder: &Path) -> Result<Vec<ObjectMeta>, Error> {
        let mut listed = self.objects.list(Some(folder));
        let mut entries = Vec::new();
        while let Some(entry) = listed.next().await {
            entries.push(entry.map_err(|error| self.io(folder, error))?);
        }

        entries.sort_by(|a, b| a.location.cmp(&b.location));
        Ok(entries)
    }

    /// Finds files of a local store that were being written when the program ended. They are called
    /// as what they were to become, with `#` and a number after it.
    fn find_unfinished(&self, before: DateTime<Utc>, garbage: &mut Garbage) -> Result<(), Error> {
        let Some(root) = &self.folder else {
            return Ok(());
        };
        let io = |path: &std::path::Path, error: std::io::Error| Error::Io {
            file: path.display().to_string(),
            cause: error.into(),
        };

        // Files that have got their name, or are gone, since they were listed need no care.
        let is_gone = |error: &std::io::Error| error.kind() == std::io::ErrorKind::NotFound;

        let mut folders: Vec<PathBuf> = STORE_FOLDERS.iter().map(|name| root.join(name)).collect();
        while let Some(folder) = folders.pop() {
            let entries = match std::fs::read_dir(&folder) {
                Err(error) if is_gone(&error) => continue,
                entries => entries.map_err(|error| io(&folder, error))?,
            };
            for entry in entries {
                let entry = entry.map_err(|error| io(&folder, error))?;
                let path = entry.path();
                let found = match entry.metadata() {
                    Err(error) if is_gone(&error) => continue,
                    found => found.map_err(|error| io(&path, error))?,
                };
                if found.is_dir() {
                    folders.push(path);
                    continue;
                }

                let name = entry.file_name();
                let is_unfinished = name
                    .to_str()
                    .and_then(|name| name.rsplit_once('#'))
                    .is_some_and(|(_, number)| number.parse::<u64>().is_ok());
                let modified = found.modified().map_err(|error| io(&path, error))?;
                if is_unfinished && DateTime::<Utc>::from(modified) <= before {
                    let relative = path.strip_prefix(root).unwrap_or(&path);
                    garbage.files.push(GarbageFile {
                        path: relative.to_string_lossy().into_owned(),
                        bytes: found.len(),
                    });
                }
            }
        }

        Ok(())
    }
}

/// The time before which a file that is older than this was written.
fn written_before(older_than: Duration) -> DateTime<Utc> {
    let age = chrono::TimeDelta::from_std(older_than).unwrap_or(chrono::TimeDelta::MAX);
    let before = Utc::now().checked_sub_signed(age);
    before.unwrap_or(DateTime::<Utc>::MIN_UTC)
}

/// Where the manifest is once its revision was removed.
fn gone_path(manifest: &Path) -> Path {
    let name = manifest.as_ref();
    Path::from(format!(
        "{}.gone",
        name.strip_suffix(".json").unwrap_or(name)
    ))
}

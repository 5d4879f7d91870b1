//! Garbage collection: objects of interrupted or removed publications, and unfinished writes.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use chrono::{DateTime, Utc};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt};
use strum::VariantArray;
use tokio_stream::StreamExt;

use super::format::{AdapterBody, RoomBody};
use super::{Error, Kind, Store, gone_name, manifest};

/// The top-level folders of a store. Other files in the same location are never touched.
const STORE_FOLDERS: [&str; 3] = ["rooms", "adapters", "defaults"];

/// Files that no revision references.
#[derive(Debug, Clone, Default)]
pub struct Garbage {
    /// The unreferenced files.
    pub files: Vec<GarbageFile>,
    /// Skipped folders, each with the reason: one of their manifests cannot be read, so their
    /// references are unknown.
    pub left_alone: Vec<String>,
}

/// An unreferenced file.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
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
    /// Finds unreferenced files that were last written at least `older_than` ago. During a
    /// publication, objects are not yet referenced by a manifest: choose `older_than` above the
    /// longest publication time.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be read.
    pub async fn find_garbage(&self, older_than: Duration) -> Result<Garbage, Error> {
        let mut garbage = Garbage::default();
        let before = written_before(older_than);

        for &kind in Kind::VARIANTS {
            for (_, folder) in self.folders(kind).await? {
                self.find_objects(kind, &folder, before, &mut garbage)
                    .await?;
            }
        }
        self.find_unfinished(before, &mut garbage)?;

        Ok(garbage)
    }

    /// Removes what [`Store::find_garbage`] finds, except files rewritten meanwhile; returns the
    /// removed files.
    ///
    /// # Errors
    /// As [`Store::find_garbage`]; [`Error::Io`] if a file cannot be removed.
    pub async fn collect_garbage(&self, older_than: Duration) -> Result<Garbage, Error> {
        let before = written_before(older_than);
        let mut garbage = self.find_garbage(older_than).await?;
        let mut removed = Vec::with_capacity(garbage.files.len());

        for file in garbage.files {
            // A concurrent publication of the same content may have rewritten the object.
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

    /// Removes a file. A missing file is not an error.
    async fn remove_file(&self, file: &str) -> Result<(), Error> {
        let path = Path::from(file);

        // The object store does not accept the names of unfinished files, so local files are
        // removed through the file system.
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

    /// Finds the objects of one room or adapter that no manifest references.
    async fn find_objects(
        &self,
        kind: Kind,
        folder: &Path,
        before: DateTime<Utc>,
        garbage: &mut Garbage,
    ) -> Result<(), Error> {
        // List objects before reading manifests: objects published in between are then either too
        // young or referenced.
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

    /// The names of all objects that the manifests of a folder reference. Recently removed
    /// revisions count, because a publication may be based on one.
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
                // The revision was removed after it was listed.
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

    /// Finds unfinished writes of a local store, left by an interrupted program. Their names are
    /// the final name, `#` and a number.
    fn find_unfinished(&self, before: DateTime<Utc>, garbage: &mut Garbage) -> Result<(), Error> {
        let Some(root) = &self.folder else {
            return Ok(());
        };
        let io = |path: &std::path::Path, error: std::io::Error| Error::Io {
            file: path.display().to_string(),
            cause: error.into(),
        };

        // Files that were renamed or removed after they were listed are skipped.
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

/// The latest modification time of a file that is at least this old.
fn written_before(older_than: Duration) -> DateTime<Utc> {
    let age = chrono::TimeDelta::from_std(older_than).unwrap_or(chrono::TimeDelta::MAX);
    let before = Utc::now().checked_sub_signed(age);
    before.unwrap_or(DateTime::<Utc>::MIN_UTC)
}

/// The path of the manifest after its revision is removed.
fn gone_path(manifest: &Path) -> Path {
    let name = manifest.as_ref();
    Path::from(format!(
        "{}.gone",
        name.strip_suffix(".json").unwrap_or(name)
    ))
}

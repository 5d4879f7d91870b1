//! Garbage collection: objects of interrupted or removed publications, and unfinished writes.
//!
//! Only files that are old by the store's own clock are removed, see [`publication`]. A publication
//! may still use an old object again at any moment, so each is removed in steps: it is copied to a
//! quarantine, removed, restored if a manifest references it by then, and removed from the
//! quarantine. A publication that writes its manifest later writes missing objects again. An
//! interrupted collection leaves its quarantine, which the next one empties.
//!
//! [`publication`]: super::publication

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher, RandomState};
use std::path::PathBuf;
use std::time::Duration;

use chrono::{DateTime, TimeDelta, Utc};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt, PutPayload};
use strum::VariantArray;
use tokio_stream::StreamExt;

use super::format::{AdapterBody, RoomBody};
use super::publication::GRACE;
use super::{Error, Kind, Store, derived, folder_of, gone_name, manifest, sha256};

/// The top-level folders of a store. Other files in the same location are never touched.
const STORE_FOLDERS: [&str; 4] = ["rooms", "adapters", "defaults", derived::FOLDER];

/// Folder of the quarantines of a room or adapter.
const QUARANTINES: &str = "quarantine";
/// Age from which a quarantine is taken for that of an interrupted collection.
const ABANDONED_QUARANTINE: TimeDelta = TimeDelta::hours(24);
/// Time after which a collection removes nothing more.
const LONGEST_COLLECTION: Duration = Duration::from_secs(12 * 3_600);
/// File that is written to read the store's clock.
const CLOCK_FILE: &str = "clock-of-garbage-collection";
/// Number of attempts to read the clock.
const CLOCK_ATTEMPTS: u32 = 8;

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

impl GarbageFile {
    fn of(file: &ObjectMeta) -> Self {
        Self {
            path: file.location.to_string(),
            bytes: file.size,
        }
    }
}

impl Garbage {
    /// The size of all files, bytes.
    pub fn bytes(&self) -> u64 {
        self.files.iter().map(|file| file.bytes).sum()
    }
}

/// Which files may be removed.
#[derive(Debug, Clone, Copy)]
pub struct GarbagePolicy {
    /// Minimum age, by the store's own clock.
    pub older_than: Duration,
    /// Whether other programs may publish to the store meanwhile.
    pub publishers: Publishers,
}

/// Whether other programs may publish to the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Publishers {
    /// They may: files younger than [`GRACE`] are kept.
    Concurrent,
    /// They do not, as the operator states.
    None,
}

impl Default for GarbagePolicy {
    fn default() -> Self {
        Self {
            older_than: GRACE,
            publishers: Publishers::Concurrent,
        }
    }
}

impl Store {
    /// Finds unreferenced files that were last written at least `policy.older_than` ago.
    ///
    /// # Errors
    /// [`Error::Grace`] if the age is below [`GRACE`] although there may be publishers,
    /// [`Error::Io`] if the store cannot be read, or written to read its clock.
    pub async fn find_garbage(&self, policy: GarbagePolicy) -> Result<Garbage, Error> {
        let before = written_before(self.time().await?, policy)?;
        self.garbage_before(before).await
    }

    async fn garbage_before(&self, before: DateTime<Utc>) -> Result<Garbage, Error> {
        let mut garbage = Garbage::default();

        for &kind in Kind::VARIANTS {
            for (_, folder) in self.folders(kind).await? {
                self.find_objects(kind, &folder, before, &mut garbage)
                    .await?;
            }
        }
        self.find_derived(before, &mut garbage).await?;
        self.find_unfinished(before, &mut garbage)?;

        Ok(garbage)
    }

    /// Finds what was derived from revisions that are gone.
    async fn find_derived(
        &self,
        before: DateTime<Utc>,
        garbage: &mut Garbage,
    ) -> Result<(), Error> {
        let files = self.listed(&Path::from(derived::FOLDER)).await?;
        if files.is_empty() {
            return Ok(());
        }

        match self.derived_paths().await {
            Ok(needed) => {
                let is_garbage = |file: &&ObjectMeta| {
                    file.last_modified <= before && !needed.contains(file.location.as_ref())
                };
                let found = files.iter().filter(is_garbage).map(GarbageFile::of);
                garbage.files.extend(found);
            }
            Err(error @ (Error::Damaged { .. } | Error::Schema { .. })) => {
                garbage
                    .left_alone
                    .push(format!("{}: {error}", derived::FOLDER));
            }
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Removes what [`Store::find_garbage`] finds, except files that were rewritten or referenced
    /// meanwhile; returns the removed files.
    ///
    /// # Errors
    /// As [`Store::find_garbage`]; [`Error::Io`] if a file cannot be removed.
    pub async fn collect_garbage(&self, policy: GarbagePolicy) -> Result<Garbage, Error> {
        let time = self.time().await?;
        let before = written_before(time, policy)?;
        let abandoned = match policy.publishers {
            // A full store without files has no time.
            Publishers::Concurrent => time
                .checked_sub_signed(ABANDONED_QUARANTINE)
                .unwrap_or(DateTime::<Utc>::MIN_UTC),
            Publishers::None => time,
        };
        self.empty_quarantines(before, abandoned).await?;
        let began = self.clock.elapsed();

        let mut garbage = self.garbage_before(before).await?;
        let mut removed = Vec::with_capacity(garbage.files.len());
        let mut manifests = Manifests::default();
        let quarantine = quarantine_name(time);

        for file in garbage.files {
            // Another collection would take the quarantine for abandoned.
            if self.clock.elapsed() - began > LONGEST_COLLECTION {
                break;
            }

            // A publication may have begun to use the object since it was found.
            if self.is_needed_now(&file, before, &mut manifests).await? {
                continue;
            }

            // A concurrent publication of the same content may have rewritten the object.
            let path = Path::from(file.path.as_str());
            let now = self.objects.head(&path).await;
            if now.is_ok_and(|now| now.last_modified > before) {
                continue;
            }

            let removal = match policy.publishers {
                Publishers::Concurrent => {
                    self.remove_unless_needed(&file, &quarantine, before, &mut manifests)
                        .await?
                }
                Publishers::None => {
                    self.remove_file(&file.path).await?;
                    Removal::Done
                }
            };
            match removal {
                Removal::Done => removed.push(file),
                Removal::Needed => {}
                Removal::NotRestorable { problem } => garbage.left_alone.push(format!(
                    "{problem}; it could not be restored for a publication that uses it meanwhile, but \
                     --no-concurrent-publishers removes it"
                )),
            }
        }

        garbage.files = removed;
        Ok(garbage)
    }

    /// Removes an object, and restores it if a manifest references it by then.
    ///
    /// A publication may use the object again at any moment. If its manifest is written before the
    /// removal, the object is restored here. If it is written later, the publication finds the
    /// object missing and writes it again.
    async fn remove_unless_needed(
        &self,
        file: &GarbageFile,
        quarantine: &str,
        before: DateTime<Utc>,
        manifests: &mut Manifests,
    ) -> Result<Removal, Error> {
        let path = Path::from(file.path.as_str());
        let Some(object) = StoredObject::of(&path) else {
            self.remove_file(&file.path).await?;
            return Ok(Removal::Done);
        };

        let kept = object
            .folder
            .join(QUARANTINES)
            .join(quarantine)
            .join(object.name.as_str());
        match self.objects.copy(&path, &kept).await {
            Ok(()) => {}
            Err(object_store::Error::NotFound { .. }) => return Ok(Removal::Done),
            Err(error) => {
                let problem = self.io(&path, error).to_string();
                return Ok(Removal::NotRestorable { problem });
            }
        }
        if !is_intact(&object.name, &self.read(&kept).await?) {
            self.remove_file(kept.as_ref()).await?;
            let problem = format!("{}: is damaged", file.path);
            return Ok(Removal::NotRestorable { problem });
        }

        self.remove_file(&file.path).await?;
        let is_needed = self.is_needed_now(file, before, manifests).await?;
        if is_needed {
            self.restore(&kept, &path).await?;
        }
        self.remove_file(kept.as_ref()).await?;
        Ok(match is_needed {
            true => Removal::Needed,
            false => Removal::Done,
        })
    }

    /// Copies an object back from a quarantine.
    async fn restore(&self, kept: &Path, path: &Path) -> Result<(), Error> {
        match self.objects.copy(kept, path).await {
            Ok(()) => Ok(()),
            Err(error) => Err(self.io(kept, error)),
        }
    }

    /// Restores or removes what interrupted collections have left in their quarantines.
    async fn empty_quarantines(
        &self,
        before: DateTime<Utc>,
        abandoned: DateTime<Utc>,
    ) -> Result<(), Error> {
        for &kind in Kind::VARIANTS {
            for (_, folder) in self.folders(kind).await? {
                let kept = self.listed(&folder.clone().join(QUARANTINES)).await?;
                for file in kept {
                    self.empty_quarantine(&folder, &file, before, abandoned)
                        .await?;
                }
            }
        }
        Ok(())
    }

    /// Finds an object in the quarantine of a collection that was interrupted.
    pub(super) async fn read_from_quarantine(
        &self,
        folder: &Path,
        object: &str,
    ) -> Result<Option<Vec<u8>>, Error> {
        for kept in self.listed(&folder.clone().join(QUARANTINES)).await? {
            if kept.location.filename() == Some(object) {
                let bytes = self.read(&kept.location).await?;
                if is_intact(object, &bytes) {
                    return Ok(Some(bytes));
                }
            }
        }
        Ok(None)
    }

    async fn empty_quarantine(
        &self,
        folder: &Path,
        kept: &ObjectMeta,
        before: DateTime<Utc>,
        abandoned: DateTime<Utc>,
    ) -> Result<(), Error> {
        let parts: Vec<_> = kept.location.parts().collect();
        let [.., quarantine, name] = parts.as_slice() else {
            return Ok(());
        };
        let began = quarantine.as_ref().split_once('-');
        let began = began.and_then(|(seconds, _)| seconds.parse().ok());
        // A collection that began later may still be running.
        if began.is_none_or(|began: i64| began > abandoned.timestamp()) {
            return Ok(());
        }

        let path = folder.clone().join("objects").join(name.as_ref());
        let file = GarbageFile {
            path: path.to_string(),
            bytes: kept.size,
        };
        let mut manifests = Manifests::default();
        if self.is_needed_now(&file, before, &mut manifests).await? {
            let found = self.objects.head(&path).await;
            let is_whole = found.is_ok_and(|found| found.size == kept.size);
            if !is_whole && is_intact(name.as_ref(), &self.read(&kept.location).await?) {
                self.restore(&kept.location, &path).await?;
            }
        }
        self.remove_file(kept.location.as_ref()).await
    }

    /// The store's own time: the modification time of a file that is written now. The clock of this
    /// machine may be wrong. If nothing can be written, as on a full disk, it is the modification
    /// time of the newest file: the store's time is later.
    async fn time(&self) -> Result<DateTime<Utc>, Error> {
        let path = Path::from(CLOCK_FILE);
        let mut attempts = 0..CLOCK_ATTEMPTS;
        loop {
            let written = self.objects.put(&path, PutPayload::default()).await;
            if written.is_err() {
                return self.newest_file_time().await;
            }

            match self.objects.head(&path).await {
                Ok(found) => {
                    self.remove_file(CLOCK_FILE).await?;
                    return Ok(found.last_modified);
                }
                // Another garbage collection has removed it.
                Err(object_store::Error::NotFound { .. }) if attempts.next().is_some() => {}
                Err(error) => return Err(self.io(&path, error)),
            }
        }
    }

    async fn newest_file_time(&self) -> Result<DateTime<Utc>, Error> {
        let mut newest = DateTime::<Utc>::MIN_UTC;
        for folder in STORE_FOLDERS {
            for file in self.listed(&Path::from(folder)).await? {
                newest = newest.max(file.last_modified);
            }
        }
        Ok(newest)
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
        let mut manifests = Manifests::default();
        let needed = match self.needed(kind, folder, before, &mut manifests).await {
            Ok(needed) => needed,
            Err(error @ (Error::Damaged { .. } | Error::Schema { .. })) => {
                garbage.left_alone.push(format!("{folder}: {error}"));
                return Ok(());
            }
            Err(error) => return Err(error),
        };

        // Manifests that an interrupted removal has left.
        let revisions = self.listed(&folder.clone().join("revisions")).await?;
        let is_removed = |file: &&ObjectMeta| {
            let gone = gone_path(&file.location);
            file.location.as_ref().ends_with(".json")
                && file.last_modified <= before
                && revisions.iter().any(|other| other.location == gone)
        };
        garbage
            .files
            .extend(revisions.iter().filter(is_removed).map(GarbageFile::of));

        let is_garbage = |object: &&ObjectMeta| {
            let name = object.location.filename().unwrap_or_default();
            object.last_modified <= before && !needed.contains(name)
        };
        garbage
            .files
            .extend(objects.iter().filter(is_garbage).map(GarbageFile::of));

        Ok(())
    }

    /// Whether a manifest references this file of a room or adapter now, or cannot be read.
    async fn is_needed_now(
        &self,
        file: &GarbageFile,
        before: DateTime<Utc>,
        manifests: &mut Manifests,
    ) -> Result<bool, Error> {
        let path = Path::from(file.path.as_str());
        let Some(object) = StoredObject::of(&path) else {
            return Ok(false);
        };

        let StoredObject { kind, folder, name } = object;
        match self.needed(kind, &folder, before, manifests).await {
            Ok(needed) => Ok(needed.contains(&name)),
            Err(Error::Damaged { .. } | Error::Schema { .. }) => Ok(true),
            Err(error) => Err(error),
        }
    }

    /// The names of all objects that the manifests of a folder reference. Recently removed
    /// revisions count, because a publication may be based on one. Manifests in `known` are not
    /// read again: they never change.
    async fn needed(
        &self,
        kind: Kind,
        folder: &Path,
        before: DateTime<Utc>,
        known: &mut Manifests,
    ) -> Result<BTreeSet<String>, Error> {
        let mut needed = BTreeSet::new();

        let entries = self.listed(&folder.clone().join("revisions")).await?;
        let gone: BTreeSet<Path> = entries
            .iter()
            .filter(|entry| is_gone(&entry.location))
            .map(|entry| entry.location.clone())
            .collect();
        for entry in entries {
            let is_manifest = entry.location.as_ref().ends_with(".json");
            let is_wanted = match is_manifest {
                true => !gone.contains(&gone_path(&entry.location)),
                false => gone.contains(&entry.location) && entry.last_modified > before,
            };
            if !is_wanted {
                continue;
            }

            if let Some(objects) = known.0.get(&entry.location) {
                needed.extend(objects.iter().cloned());
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
            needed.extend(objects.iter().cloned());
            known.0.insert(entry.location, objects);
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

/// A new name for the quarantine of a collection that begins at `time`.
fn quarantine_name(time: DateTime<Utc>) -> String {
    // A hasher of the standard library begins with random keys.
    let random = RandomState::new().hash_one(std::process::id());
    format!("{}-{random:016x}", time.timestamp())
}

/// Result of the removal of a file.
enum Removal {
    Done,
    /// A manifest references it by now.
    Needed,
    /// It could not be restored if a manifest referenced it later.
    NotRestorable {
        problem: String,
    },
}

/// Whether an object's content has the hash in its name.
fn is_intact(name: &str, bytes: &[u8]) -> bool {
    let (stem, _) = name.rsplit_once('.').unwrap_or((name, ""));
    stem.ends_with(&format!("-{}", &sha256(bytes)[..16]))
}

/// An object of a room or adapter.
struct StoredObject {
    kind: Kind,
    /// The folder of the room or adapter.
    folder: Path,
    name: String,
}

impl StoredObject {
    /// The object of a path; `None` for other files.
    fn of(path: &Path) -> Option<Self> {
        let parts: Vec<_> = path.parts().collect();
        let [collection, owner, objects, name] = parts.as_slice() else {
            return None;
        };
        let mut kinds = Kind::VARIANTS.iter().copied();
        let kind = kinds.find(|kind| kind.collection() == collection.as_ref())?;

        (objects.as_ref() == "objects").then(|| Self {
            kind,
            folder: folder_of(kind, owner.as_ref()),
            name: name.as_ref().to_owned(),
        })
    }
}

/// The latest modification time of a file that may be removed.
///
/// # Errors
/// [`Error::Grace`] if the age is below [`GRACE`] although there may be publishers.
fn written_before(time: DateTime<Utc>, policy: GarbagePolicy) -> Result<DateTime<Utc>, Error> {
    if policy.publishers == Publishers::Concurrent && policy.older_than < GRACE {
        return Err(Error::Grace);
    }

    let age = TimeDelta::from_std(policy.older_than);
    let before = time.checked_sub_signed(age.unwrap_or(TimeDelta::MAX));
    Ok(before.unwrap_or(DateTime::<Utc>::MIN_UTC))
}

/// The objects that manifests reference, by the path of the manifest.
#[derive(Debug, Default)]
struct Manifests(BTreeMap<Path, Vec<String>>);

/// Whether this is the manifest of a removed revision.
fn is_gone(path: &Path) -> bool {
    let name = path.filename().unwrap_or_default();
    let number = name.strip_suffix(".gone");
    let number = number.and_then(|number| number.parse().ok());
    number.is_some_and(|number| name == gone_name(number))
}

/// The path of the manifest after its revision is removed.
fn gone_path(manifest: &Path) -> Path {
    let name = manifest.as_ref();
    Path::from(format!(
        "{}.gone",
        name.strip_suffix(".json").unwrap_or(name)
    ))
}

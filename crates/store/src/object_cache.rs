//! A cache of objects on the local disk, for stores in a bucket.
//!
//! The files are named after the SHA-256 of their content, and are compared with it whenever they
//! are read. So a file that was altered is fetched again, and several processes may share the
//! folder.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use seese3_core::Cause;

use super::{Error, sha256};

/// Part of the limit that a process writes before it lists the files again: 1/16.
const RELISTED: u64 = 16;

/// A cache of objects in a folder.
#[derive(Debug)]
pub struct ObjectCache {
    folder: PathBuf,
    /// Maximum size of all files together, bytes.
    most_bytes: u64,
    held: Mutex<Held>,
}

/// Sizes of the cache's files, bytes.
#[derive(Debug, Default)]
struct Held {
    /// When they were last listed.
    listed: u64,
    /// Written by this process since then.
    written: u64,
}

/// A file of the cache.
struct Cached {
    path: PathBuf,
    bytes: u64,
    used: SystemTime,
}

impl ObjectCache {
    /// Opens the cache in a folder, which is created if necessary, and removes what is beyond
    /// `most_bytes`.
    ///
    /// # Errors
    /// [`Error::Io`] if the folder cannot be written.
    pub fn open(folder: &Path, most_bytes: u64) -> Result<Self, Error> {
        let failed = |error: io::Error| Error::Io {
            file: folder.display().to_string(),
            cause: error.into(),
        };
        // Rooms may be private.
        let mut builder = fs::DirBuilder::new();
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
        builder.recursive(true).create(folder).map_err(failed)?;

        let cache = Self {
            folder: folder.to_owned(),
            most_bytes,
            held: Mutex::default(),
        };
        cache.make_room(0).map_err(failed)?;
        Ok(cache)
    }

    /// The object with this SHA-256, in hexadecimal; `None` if it is not in the cache.
    pub(super) fn get(&self, hash: &str) -> Option<Vec<u8>> {
        // The hash comes from a manifest, so it must not be used as a path unchecked.
        let path = is_hash(hash).then(|| self.folder.join(hash))?;
        let bytes = fs::read(&path).ok()?;
        if sha256(&bytes) != hash {
            // It is fetched again.
            drop(fs::remove_file(&path));
            return None;
        }

        // The modification time records the last use, for eviction.
        let now = SystemTime::now();
        drop(
            File::options()
                .append(true)
                .open(&path)
                .and_then(|file| file.set_modified(now)),
        );
        Some(bytes)
    }

    /// Keeps an object of this SHA-256. Least recently used objects are evicted if necessary. An
    /// object larger than the cache is not kept.
    pub(super) fn put(&self, hash: &str, bytes: &[u8]) -> Result<(), Cause> {
        if !is_hash(hash) || bytes.len() as u64 > self.most_bytes {
            return Ok(());
        }
        self.make_room(bytes.len() as u64)?;

        // Under another name until it is complete. Names of the two kinds differ in their length.
        let since = SystemTime::UNIX_EPOCH
            .elapsed()
            .unwrap_or_default()
            .as_nanos();
        let part = self
            .folder
            .join(format!("{hash}-{}-{since}", std::process::id()));
        let written =
            fs::write(&part, bytes).and_then(|()| fs::rename(&part, self.folder.join(hash)));
        if written.is_err() {
            drop(fs::remove_file(&part));
        }
        Ok(written?)
    }

    /// Evicts files until `bytes` more fit. The files are listed again after this process has
    /// written a part of the limit, because others may write too.
    fn make_room(&self, bytes: u64) -> io::Result<()> {
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        held.written += bytes;
        let is_known = held.written <= self.most_bytes / RELISTED;
        if bytes > 0 && is_known && held.listed + held.written <= self.most_bytes {
            return Ok(());
        }

        let mut files = self.files()?;
        files.sort_by_key(|file| file.used);
        *held = Held {
            listed: files.iter().map(|file| file.bytes).sum(),
            written: bytes,
        };
        for file in files {
            if held.listed + bytes <= self.most_bytes {
                break;
            }
            match fs::remove_file(&file.path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => held.listed -= file.bytes,
            }
        }
        Ok(())
    }

    /// Its files, also incomplete ones.
    fn files(&self) -> io::Result<Vec<Cached>> {
        let mut files = Vec::new();
        for entry in fs::read_dir(&self.folder)? {
            let entry = entry?;
            let name = entry.file_name();
            let is_ours = name
                .to_str()
                .is_some_and(|name| is_hash(name.split('-').next().unwrap_or_default()));
            // Another process may have removed it.
            if let (true, Ok(found)) = (is_ours, entry.metadata()) {
                files.push(Cached {
                    path: entry.path(),
                    bytes: found.len(),
                    used: found.modified()?,
                });
            }
        }
        Ok(files)
    }
}

fn is_hash(name: &str) -> bool {
    name.len() == 64 && name.bytes().all(|byte| byte.is_ascii_hexdigit())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hashed(text: &str) -> (String, Vec<u8>) {
        (sha256(text.as_bytes()), text.as_bytes().to_vec())
    }

    fn put(cache: &ObjectCache, text: &str) -> String {
        let (hash, bytes) = hashed(text);
        cache.put(&hash, &bytes).unwrap();
        hash
    }

    /// Oracle: the contract: an object is returned as it was put, and never with other content.
    #[test]
    fn an_altered_file_is_not_returned() {
        let folder = tempfile::tempdir().unwrap();
        let cache = ObjectCache::open(folder.path(), 1_000).unwrap();
        let hash = put(&cache, "room");
        assert_eq!(cache.get(&hash).unwrap(), b"room");

        fs::write(folder.path().join(&hash), "rooms").unwrap();
        assert_eq!(cache.get(&hash), None);
        assert!(!folder.path().join(&hash).exists());

        let outside = format!("../{}/notes", folder.path().file_name().unwrap().display());
        fs::write(folder.path().join("notes"), "kept").unwrap();
        assert_eq!(cache.get(&outside), None);
        assert!(folder.path().join("notes").exists());
    }

    /// Oracle: the bound: those used last remain; files that are not the cache's own are left
    /// alone.
    #[test]
    fn the_objects_used_last_remain() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("notes"), [0; 50]).unwrap();
        let cache = ObjectCache::open(folder.path(), 20).unwrap();
        let [first, second] = ["1234567890", "abcdefghij"].map(|text| put(&cache, text));
        let past = SystemTime::now() - std::time::Duration::from_secs(60);
        for hash in [&first, &second] {
            let file = File::options().append(true).open(folder.path().join(hash));
            file.unwrap().set_modified(past).unwrap();
        }
        assert!(cache.get(&first).is_some());

        let third = put(&cache, "ABCDE");
        let held = [&first, &second, &third].map(|hash| cache.get(hash).is_some());
        assert_eq!(held, [true, false, true]);
        let large = put(&cache, "longer than the whole cache");
        assert!(cache.get(&large).is_none());

        let smaller = ObjectCache::open(folder.path(), 9).unwrap();
        assert_eq!(smaller.files().unwrap().len(), 1);
        assert!(folder.path().join("notes").exists());
    }
}

//! Image files extracted from a bag. They are deleted if the import fails.

use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::datasets::Error;

/// Images written to a folder. New files and folders are deleted on drop, unless
/// [`WrittenImages::keep`] was called: a room that is not published leaves nothing behind.
///
/// An existing file is never changed, because it may belong to another room. A file with the same
/// content, as from an earlier import, is reused.
#[derive(Debug)]
pub struct WrittenImages {
    folder: PathBuf,
    /// The folders that were created, the outermost first.
    made_folders: Vec<PathBuf>,
    made_files: Vec<PathBuf>,
}

impl WrittenImages {
    /// Creates the folder and its parents if they do not exist.
    pub(super) fn in_folder(folder: PathBuf) -> Result<Self, Error> {
        let missing = folder.ancestors().take_while(|above| {
            !above.as_os_str().is_empty() && fs::symlink_metadata(above).is_err()
        });
        let mut made_folders: Vec<PathBuf> = missing.map(Path::to_owned).collect();
        made_folders.reverse();

        let written = Self {
            folder,
            made_folders,
            made_files: Vec::new(),
        };
        fs::create_dir_all(&written.folder).map_err(|cause| Error::Io {
            file: written.folder.clone(),
            cause,
        })?;
        Ok(written)
    }

    /// The folder of the images.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Keeps the images, because a room refers to them now.
    pub fn keep(mut self) {
        self.made_files.clear();
        self.made_folders.clear();
    }

    /// Writes a file into the folder. The error describes the problem.
    pub(super) fn write(&mut self, name: &str, bytes: &[u8]) -> Result<(), String> {
        let path = self.folder.join(name);
        let failed =
            |error: std::io::Error| format!("{} cannot be written: {error}", path.display());

        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(mut file) => {
                self.made_files.push(path.clone());
                file.write_all(bytes).map_err(failed)
            }
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                let is_file = fs::symlink_metadata(&path).is_ok_and(|found| found.is_file());
                if is_file && fs::read(&path).map_err(failed)? == bytes {
                    return Ok(());
                }
                Err(format!(
                    "{} already exists with different content: give another folder with --images-to",
                    path.display()
                ))
            }
            Err(error) => Err(failed(error)),
        }
    }
}

impl Drop for WrittenImages {
    fn drop(&mut self) {
        // Errors are ignored: a drop cannot report them.
        for file in &self.made_files {
            let _ = fs::remove_file(file);
        }
        for folder in self.made_folders.iter().rev() {
            let _ = fs::remove_dir(folder);
        }
    }
}

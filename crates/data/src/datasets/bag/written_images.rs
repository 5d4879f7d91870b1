//! The images of a bag as files, which are removed again if the import fails.

use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::datasets::Error;

/// Images that were written to a folder. What was not there before is removed when this is dropped,
/// unless [`WrittenImages::keep`] was called: a room that is not published leaves nothing behind.
///
/// A file that is there already is never changed: it may be an image of another room. If it has the
/// same content, as after the same import, it is used.
#[derive(Debug)]
pub struct WrittenImages {
    folder: PathBuf,
    /// The folders that were made, the outermost first.
    made_folders: Vec<PathBuf>,
    made_files: Vec<PathBuf>,
}

impl WrittenImages {
    /// Makes the folder, with those above it, if it does not exist.
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

    /// Leaves the images where they are, since a room refers to them now.
    pub fn keep(mut self) {
        self.made_files.clear();
        self.made_folders.clear();
    }

    /// Writes a file of the folder. The error says why it cannot be written.
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
                    "{} is there already, with another content: give another folder with --images-to",
                    path.display()
                ))
            }
            Err(error) => Err(failed(error)),
        }
    }
}

impl Drop for WrittenImages {
    fn drop(&mut self) {
        // What cannot be removed stays: there is nobody left to tell.
        for file in &self.made_files {
            let _ = fs::remove_file(file);
        }
        for folder in self.made_folders.iter().rev() {
            let _ = fs::remove_dir(folder);
        }
    }
}

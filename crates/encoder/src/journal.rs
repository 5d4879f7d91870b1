//! A journal of encoded rows: a file to which rows are appended as they are computed, so that an
//! interrupted run can resume.
//!
//! A record is the row's number (u32), its numbers (f32), and the first 8 bytes of the SHA-256 of
//! both, little-endian. Reading ends at the first record that is truncated or altered: that row and
//! all rows after it are encoded again.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::Error;

const MAGIC: &[u8; 16] = b"seese3 rows 1\n\0\0";
const CHECK_BYTES: usize = 8;
/// The magic bytes, and the SHA-256 of the key and the width.
const HEADER_BYTES: usize = 16 + 32;

/// Rows of features, each with the number of its frame.
pub type NumberedRows = Vec<(usize, Vec<f32>)>;

/// An open journal, locked against other processes.
pub struct Journal {
    path: PathBuf,
    file: File,
    width: usize,
}

impl Journal {
    /// Opens or creates the journal at `path`, and returns the rows that are in it already. `key`
    /// identifies the task: a file that was written for another key or width is emptied.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be read or written, or if another process holds its lock.
    pub fn open(path: &Path, key: &str, width: usize) -> Result<(Self, NumberedRows), Error> {
        let io = |cause| Error::Io {
            file: path.to_owned(),
            cause,
        };

        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(io)?;
        }

        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .map_err(io)?;

        // Two processes that append to one file would mix their records.
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(io(std::io::Error::other(
                    "another process is encoding this; wait for it, or stop it",
                )));
            }
            Err(TryLockError::Error(cause)) => return Err(io(cause)),
        }

        let mut journal = Self {
            path: path.to_owned(),
            file,
            width,
        };

        let header = [MAGIC.as_slice(), &Sha256::digest(format!("{key}\n{width}"))].concat();
        let mut found = vec![0; HEADER_BYTES];
        let is_ours = journal.file.read_exact(&mut found).is_ok() && found == header;

        // The file is new, belongs to another task, or is truncated within its header: start empty.
        if !is_ours {
            journal.file.set_len(0).map_err(io)?;
            journal.file.rewind().map_err(io)?;
            journal.file.write_all(&header).map_err(io)?;
            return Ok((journal, Vec::new()));
        }

        let rows = journal.rows().map_err(io)?;

        // Truncate the file after its last intact record, since a reader would
        // stop at the damaged one and miss the records that are appended now.
        let end = HEADER_BYTES + rows.len() * journal.record_bytes();
        journal.file.set_len(end as u64).map_err(io)?;
        journal.file.seek(SeekFrom::End(0)).map_err(io)?;

        Ok((journal, rows))
    }

    /// Appends rows, each with the number of its frame.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be written.
    pub fn append<'a>(
        &mut self,
        rows: impl Iterator<Item = (usize, &'a [f32])>,
    ) -> Result<(), Error> {
        let mut bytes = Vec::new();
        for (row, numbers) in rows {
            let begin = bytes.len();
            bytes.extend((row as u32).to_le_bytes());
            bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
            let check = Sha256::digest(&bytes[begin..]);
            bytes.extend(&check[..CHECK_BYTES]);
        }

        self.file.write_all(&bytes).map_err(|cause| Error::Io {
            file: self.path.clone(),
            cause,
        })
    }

    /// Removes the file. Call it once the rows are stored elsewhere.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be removed.
    pub fn finish(self) -> Result<(), Error> {
        std::fs::remove_file(&self.path).map_err(|cause| Error::Io {
            file: self.path.clone(),
            cause,
        })
    }

    fn record_bytes(&self) -> usize {
        4 + 4 * self.width + CHECK_BYTES
    }

    fn rows(&mut self) -> std::io::Result<NumberedRows> {
        let mut reader = std::io::BufReader::new(&self.file);
        let mut record = vec![0; self.record_bytes()];
        let mut rows = Vec::new();
        loop {
            // A file that ends within a record: its writer was interrupted.
            match reader.read_exact(&mut record) {
                Ok(()) => {}
                Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => return Ok(rows),
                Err(error) => return Err(error),
            }

            let (content, check) = record.split_at(record.len() - CHECK_BYTES);
            if &Sha256::digest(content)[..CHECK_BYTES] != check {
                return Ok(rows);
            }

            // The record's first word is the row's number, all others are its values.
            let words: Vec<[u8; 4]> = content.as_chunks::<4>().0.to_vec();
            let row = u32::from_le_bytes(words[0]) as usize;

            rows.push((
                row,
                words[1..]
                    .iter()
                    .map(|word| f32::from_le_bytes(*word))
                    .collect(),
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: what was appended, under every cut of the file: whole records survive, a cut one
    /// does not.
    #[test]
    fn whole_records_survive_any_cut() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a/rows");

        let rows = [
            (0usize, vec![1.0f32, 2.0]),
            (2, vec![3.0, f32::MIN]),
            (1, vec![0.0, -0.5]),
        ];

        let (mut journal, before) = Journal::open(&path, "key", 2).unwrap();
        assert!(before.is_empty());

        journal
            .append(rows.iter().map(|(row, numbers)| (*row, numbers.as_slice())))
            .unwrap();

        drop(journal);
        let bytes = std::fs::read(&path).unwrap();
        let record = (bytes.len() - HEADER_BYTES) / 3;
        for cut in 0..=bytes.len() {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let (_journal, found) = Journal::open(&path, "key", 2).unwrap();
            assert_eq!(
                found,
                rows[..cut.saturating_sub(HEADER_BYTES) / record],
                "cut at {cut}"
            );
        }

        let mut altered = bytes.clone();
        altered[HEADER_BYTES + record + 5] ^= 1;
        std::fs::write(&path, altered).unwrap();
        let (mut journal, found) = Journal::open(&path, "key", 2).unwrap();

        assert_eq!(found, rows[..1]);

        journal
            .append([(5usize, [9.0f32, 9.0].as_slice())].into_iter())
            .unwrap();

        drop(journal);

        assert_eq!(
            Journal::open(&path, "key", 2).unwrap().1,
            [rows[0].clone(), (5, vec![9.0, 9.0])]
        );
    }

    /// Oracle: the definition: rows of another task are not returned, and a task that is running
    /// cannot be started a second time.
    #[test]
    fn another_key_begins_anew_and_a_running_task_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows");
        let (mut journal, _) = Journal::open(&path, "one", 1).unwrap();
        journal
            .append([(0usize, [1.0f32].as_slice())].into_iter())
            .unwrap();

        assert!(Journal::open(&path, "one", 1).is_err(), "locked");

        drop(journal);
        assert!(Journal::open(&path, "two", 1).unwrap().1.is_empty());

        let (journal, rows) = Journal::open(&path, "two", 1).unwrap();
        assert!(rows.is_empty());

        journal.finish().unwrap();
        assert!(!path.exists());
    }
}

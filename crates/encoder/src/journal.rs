//! A journal of encoded frames: a file to which frames are appended as they are encoded, so that an
//! interrupted run can resume.
//!
//! A record is the frame's number (u32), the length of its `postcard` (u32), the `postcard` of the
//! [`EncodedFrame`], and the first 8 bytes of the SHA-256 of all that, little-endian. Reading ends
//! at the first record that is truncated or altered: that frame and all after it are encoded again.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::Error;
use seese3_core::keypoints::Keypoints;

const MAGIC: &[u8; 16] = b"seese3 rows 2\n\0\0";
const CHECK_BYTES: usize = 8;
/// The magic bytes, and the SHA-256 of the key.
const HEADER_BYTES: usize = 16 + 32;
/// The number of the frame and the length of its `postcard`.
const PREFIX_BYTES: usize = 8;

/// What an encoder computes from a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EncodedFrame {
    /// The features of all layers side by side.
    pub feature: Vec<f32>,
    /// The keypoints, if the encoder detects them.
    pub keypoints: Option<Keypoints>,
}

/// Encoded frames, each with its number.
pub type NumberedFrames = Vec<(usize, EncodedFrame)>;

/// An open journal, locked against other processes.
pub struct Journal {
    path: PathBuf,
    file: File,
}

impl Journal {
    /// Opens or creates the journal at `path`, and returns the frames that are in it already. `key`
    /// identifies the task: a file that was written for another key is emptied.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be read or written, or if another process holds its lock.
    pub fn open(path: &Path, key: &str) -> Result<(Self, NumberedFrames), Error> {
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
        };

        let header = [MAGIC.as_slice(), &Sha256::digest(key)].concat();
        let mut found = vec![0; HEADER_BYTES];
        let is_ours = journal.file.read_exact(&mut found).is_ok() && found == header;

        // The file is new, belongs to another task, or is truncated within its header: start empty.
        if !is_ours {
            journal.file.set_len(0).map_err(io)?;
            journal.file.rewind().map_err(io)?;
            journal.file.write_all(&header).map_err(io)?;
            return Ok((journal, Vec::new()));
        }

        let (frames, end) = journal.frames().map_err(io)?;

        // Truncate the file after its last intact record, since a reader would
        // stop at the damaged one and miss the records that are appended now.
        journal.file.set_len(end).map_err(io)?;
        journal.file.seek(SeekFrom::End(0)).map_err(io)?;

        Ok((journal, frames))
    }

    /// Appends frames, each with its number.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be written.
    pub fn append<'a>(
        &mut self,
        frames: impl Iterator<Item = (usize, &'a EncodedFrame)>,
    ) -> Result<(), Error> {
        let io = |cause| Error::Io {
            file: self.path.clone(),
            cause,
        };

        let mut bytes = Vec::new();
        for (number, frame) in frames {
            let content =
                postcard::to_allocvec(frame).map_err(|error| io(std::io::Error::other(error)))?;
            let begin = bytes.len();
            bytes.extend((number as u32).to_le_bytes());
            bytes.extend((content.len() as u32).to_le_bytes());
            bytes.extend(content);
            let check = Sha256::digest(&bytes[begin..]);
            bytes.extend(&check[..CHECK_BYTES]);
        }

        self.file.write_all(&bytes).map_err(io)
    }

    /// Removes the file. Call it once the frames are stored elsewhere.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be removed.
    pub fn finish(self) -> Result<(), Error> {
        std::fs::remove_file(&self.path).map_err(|cause| Error::Io {
            file: self.path.clone(),
            cause,
        })
    }

    /// The intact frames after the header, and the position in the file after the last of them.
    fn frames(&mut self) -> std::io::Result<(NumberedFrames, u64)> {
        let mut rest = Vec::new();
        self.file.read_to_end(&mut rest)?;

        let mut frames = Vec::new();
        let mut end = 0;
        while let Some((frame, length)) = first_record(&rest[end..]) {
            frames.push(frame);
            end += length;
        }

        Ok((frames, (HEADER_BYTES + end) as u64))
    }
}

/// The record at the beginning of `bytes`, and its length; `None` if it is truncated or altered.
fn first_record(bytes: &[u8]) -> Option<((usize, EncodedFrame), usize)> {
    let word = |at: usize| Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?) as usize);
    let number = word(0)?;
    let content_end = PREFIX_BYTES.checked_add(word(4)?)?;
    let end = content_end.checked_add(CHECK_BYTES)?;

    let check = bytes.get(content_end..end)?;
    if &Sha256::digest(&bytes[..content_end])[..CHECK_BYTES] != check {
        return None;
    }

    let frame = postcard::from_bytes(&bytes[PREFIX_BYTES..content_end]).ok()?;
    Some(((number, frame), end))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(numbers: &[f32]) -> EncodedFrame {
        EncodedFrame {
            feature: numbers.to_vec(),
            keypoints: None,
        }
    }

    /// Oracle: what was appended, with and without keypoints, and with none found.
    #[test]
    fn keypoints_come_back_as_they_were() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows");
        let descriptors = ndarray::arr2(&[[0.5_f32, -0.5, 0.25], [0.0, 0.1, -0.9]]);
        let points = [[0.25_f32, 0.75].into(), [f32::MIN_POSITIVE, 1.0].into()];
        let found = Keypoints::new(&points, &[0.1, 0.7], descriptors.view());
        let frames =
            [Some(found), None, Some(Keypoints::default())].map(|keypoints| EncodedFrame {
                feature: vec![1.0, 2.0],
                keypoints,
            });

        let (mut journal, _) = Journal::open(&path, "key").unwrap();
        journal.append(frames.iter().enumerate()).unwrap();
        drop(journal);
        let (_, back) = Journal::open(&path, "key").unwrap();
        assert_eq!(back, frames.into_iter().enumerate().collect::<Vec<_>>());
    }

    /// Oracle: what was appended, under every cut of the file: whole records survive, a cut one
    /// does not.
    #[test]
    fn whole_records_survive_any_cut() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a/rows");

        let frames = [
            (0usize, frame(&[1.0, 2.0])),
            (2, frame(&[3.0, f32::MIN])),
            (1, frame(&[0.0, -0.5])),
        ];

        let (mut journal, before) = Journal::open(&path, "key").unwrap();
        assert!(before.is_empty());

        journal
            .append(frames.iter().map(|(number, frame)| (*number, frame)))
            .unwrap();

        drop(journal);
        let bytes = std::fs::read(&path).unwrap();
        let record = (bytes.len() - HEADER_BYTES) / 3;
        for cut in 0..=bytes.len() {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let (_journal, found) = Journal::open(&path, "key").unwrap();
            assert_eq!(
                found,
                frames[..cut.saturating_sub(HEADER_BYTES) / record],
                "cut at {cut}"
            );
        }

        let mut altered = bytes.clone();
        altered[HEADER_BYTES + record + 5] ^= 1;
        std::fs::write(&path, altered).unwrap();
        let (mut journal, found) = Journal::open(&path, "key").unwrap();

        assert_eq!(found, frames[..1]);

        let last = frame(&[9.0, 9.0]);
        journal.append([(5usize, &last)].into_iter()).unwrap();

        drop(journal);

        assert_eq!(
            Journal::open(&path, "key").unwrap().1,
            [frames[0].clone(), (5, last)]
        );
    }

    /// Oracle: the definition: frames of another task are not returned, and a task that is running
    /// cannot be started a second time.
    #[test]
    fn another_key_begins_anew_and_a_running_task_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows");
        let (mut journal, _) = Journal::open(&path, "one").unwrap();
        journal
            .append([(0usize, &frame(&[1.0]))].into_iter())
            .unwrap();

        assert!(Journal::open(&path, "one").is_err(), "locked");

        drop(journal);
        assert!(Journal::open(&path, "two").unwrap().1.is_empty());

        let (journal, frames) = Journal::open(&path, "two").unwrap();
        assert!(frames.is_empty());

        journal.finish().unwrap();
        assert!(!path.exists());
    }
}

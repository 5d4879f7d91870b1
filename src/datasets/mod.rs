//! Recordings on disk, as rooms.
//!
//! Whatever a recording's convention, poses leave here as `world_from_camera`, metres, with
//! rotations on SO(3). Frames are in order of capture. One file a format; what they share is in
//! `collect`.

mod arkitscenes;
mod bundle;
mod collect;
mod numpy;
mod scannet;
mod sens;
mod seven_scenes;
mod text;
mod tum;
mod twelve_scenes;

pub use arkitscenes::read_arkitscenes;
pub use bundle::{read_bundle, read_numpy, write_numpy};
pub use numpy::{read_features, read_poses, read_timestamps};
pub use scannet::read_scannet;
pub use sens::read_sens;
pub use seven_scenes::{SevenScenes, read_seven_scenes};
pub use tum::{read_tum, read_tum_trajectory};
pub use twelve_scenes::read_twelve_scenes;

use std::path::{Path, PathBuf};

use crate::features::Features;
use crate::room::{Frames, Timeline};

/// A rotation whose |RRᵀ − I| has a larger entry is not taken for a rounded one.
pub const MAX_ROTATION_DEVIATION: f64 = 1e-2;

/// Why a recording cannot be read. Each names the file.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{}: {cause}", file.display())]
    Io {
        file: PathBuf,
        cause: std::io::Error,
    },
    #[error("{}: {problem}", file.display())]
    Malformed { file: PathBuf, problem: String },
    #[error("{}, line {line}: {problem}", file.display())]
    Line {
        file: PathBuf,
        line: usize,
        problem: String,
    },
    #[error("{}, frame {frame}: {problem}", file.display())]
    Frame {
        file: PathBuf,
        frame: usize,
        problem: String,
    },
    #[error("{}: {} frames are unusable, the first is {}: {}; leave out --strict to drop them", folder.display(), dropped.len(), dropped[0].name, dropped[0].reason)]
    Strict {
        folder: PathBuf,
        dropped: Vec<Dropped>,
    },
    #[error("{}: no usable frame was found{}", folder.display(), first_reason(dropped))]
    NoFrames {
        folder: PathBuf,
        dropped: Vec<Dropped>,
    },
}

/// A frame that was left out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dropped {
    /// The recording's name for it.
    pub name: String,
    /// Why.
    pub reason: DropReason,
}

/// Why a frame was left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum DropReason {
    #[error("missing_pose_file")]
    MissingPoseFile,
    #[error("truncated_pose_file")]
    TruncatedPoseFile,
    #[error("missing_image")]
    MissingImage,
    #[error("non_finite_pose")]
    NonFinitePose,
    #[error("not_a_rotation")]
    NotARotation,
    /// The recorder wrote an identity where it had lost its tracking.
    #[error("suspect_identity_pose")]
    SuspectIdentityPose,
    #[error("no_pose_within_tolerance")]
    NoPoseWithinTolerance,
}

/// A recording that was read.
#[derive(Debug, Clone, Default)]
pub struct Recording {
    /// The frames that can be used.
    pub frames: Frames,
    /// The frames that cannot.
    pub dropped: Vec<Dropped>,
    /// The largest |RRᵀ − I| entry of a rotation before it was projected.
    pub worst_rotation_deviation: f64,
    /// The folder that images' paths start from; empty if there are no images.
    pub images_root: String,
    /// Features that came with it.
    pub features: Vec<Features>,
    /// The room's name and the terms of use, where the recording says them.
    pub stated: Stated,
}

/// What only a bundle says of itself.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Stated {
    /// The room's name.
    pub name: String,
    /// The format that the room was first read from.
    pub format: String,
    /// The terms under which it may be used.
    pub licence: String,
}

impl Recording {
    /// With these times.
    ///
    /// # Errors
    /// [`Error::Malformed`] if they are not as many as the poses.
    pub fn with_timestamps(mut self, file: &Path) -> Result<Self, Error> {
        self.frames.timestamps_ns = read_timestamps(file)?;
        collect::check_lengths(file, &self)?;
        Ok(self)
    }

    /// Which rows stay when only every `step`-th frame of each sequence is kept.
    pub fn every(&self, step: usize) -> Vec<usize> {
        let frame_count = self.frames.poses.len();
        let timeline = Timeline {
            frame_count,
            sequences: self.frames.sequences.clone(),
            held_out: Vec::new(),
        };

        let mut start = 0;
        let mut rows = Vec::new();
        for row in 0..frame_count {
            if !timeline.sequences.is_empty()
                && timeline.sequences[row] != timeline.sequences[start]
            {
                start = row;
            }

            if (row - start).is_multiple_of(step) {
                rows.push(row);
            }
        }

        rows
    }
}

/// What is done with frames that cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unusable {
    /// Left out, and named.
    Drop,
    /// The recording is refused.
    Refuse,
}

/// How a recording is read: what becomes of unusable frames, and who hears of (frames read, frames
/// in all).
pub struct Reader<'a> {
    /// What is done with frames that cannot be used.
    pub unusable: Unusable,
    /// Hears of progress.
    pub progress: &'a mut dyn FnMut(usize, usize),
}

fn first_reason(dropped: &[Dropped]) -> String {
    dropped.first().map_or(String::new(), |first| {
        format!(" ({} dropped, the first: {})", dropped.len(), first.reason)
    })
}

fn read_bytes(file: &Path) -> Result<Vec<u8>, Error> {
    std::fs::read(file).map_err(|cause| Error::Io {
        file: file.to_owned(),
        cause,
    })
}

fn read_text(file: &Path) -> Result<String, Error> {
    let malformed = |_| Error::Malformed {
        file: file.to_owned(),
        problem: "is not text".to_owned(),
    };
    String::from_utf8(read_bytes(file)?).map_err(malformed)
}

/// Names in a folder, in order.
fn entries(folder: &Path) -> Result<Vec<String>, Error> {
    let io = |cause| Error::Io {
        file: folder.to_owned(),
        cause,
    };

    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        names.push(
            entry
                .map_err(io)?
                .file_name()
                .to_string_lossy()
                .into_owned(),
        );
    }

    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;

    /// Oracle: by hand. Every third frame, counted anew in each sequence.
    #[test]
    fn every_counts_within_a_sequence() {
        let frames = Frames {
            poses: vec![Pose::identity(); 7],
            sequences: vec![0, 0, 0, 0, 1, 1, 1],
            ..Frames::default()
        };
        let recording = Recording {
            frames,
            ..Recording::default()
        };

        assert_eq!(recording.every(3), [0, 3, 4]);
        assert_eq!(recording.every(1).len(), 7);
    }
}

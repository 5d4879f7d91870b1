//! Readers for recordings on disk.
//!
//! Readers convert from the convention that a format defines to `world_from_camera`, meters,
//! rotations on SO(3), with frames in order of capture. A recording that deviates from its format's
//! convention is not noticed here; `import` applies `--poses`, `--convention` and `--scale`
//! afterwards. Each format has a file or folder of its own; `collect` and `text` hold what most of
//! them share.

mod arkitscenes;
#[cfg(feature = "bags")]
mod bag;
mod bundle;
mod collect;
mod colmap;
mod euroc;
mod folder;
mod kitti;
mod natural;
mod numpy;
mod scannet;
mod sens;
mod seven_scenes;
mod text;
mod transforms;
mod tum;
mod twelve_scenes;

pub use arkitscenes::read_arkitscenes;
#[cfg(feature = "bags")]
pub use bag::{Bag, WrittenImages, read_bag};
pub use bundle::{BundleContents, KeypointArrays, read_bundle, read_numpy, write_numpy};
pub use colmap::{ImageTimes, read_colmap};
pub use euroc::read_euroc;
pub use folder::read_folder;
pub use kitti::{Kitti, read_kitti};
pub use numpy::{read_features, read_poses, read_timestamps};
pub use scannet::read_scannet;
pub use sens::read_sens;
pub use seven_scenes::{SevenScenes, read_seven_scenes};
pub use transforms::read_transforms;
pub use tum::{read_tum, read_tum_trajectory};
pub use twelve_scenes::read_twelve_scenes;

use std::path::{Path, PathBuf};

use seese3_core::Cause;
use seese3_core::features::Features;
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::room::{Frames, Timeline};

/// Why a recording cannot be read. Every message names the file or the folder.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("{}: {cause}", file.display())]
    Io {
        file: PathBuf,
        #[source]
        cause: std::io::Error,
    },
    #[error("{}: {problem}", file.display())]
    Malformed {
        file: PathBuf,
        #[source]
        problem: Cause,
    },
    #[error("{}, line {line}: {problem}", file.display())]
    Line {
        file: PathBuf,
        line: usize,
        #[source]
        problem: Cause,
    },
    #[error("{}, frame {frame}: {problem}", file.display())]
    Frame {
        file: PathBuf,
        frame: usize,
        #[source]
        problem: Cause,
    },
    #[error("{}: {} frames are unusable, the first is {}; leave out --strict to drop them", folder.display(), dropped.len(), dropped[0])]
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

/// A frame that was dropped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dropped {
    /// The name of the frame in the recording.
    pub name: String,
    /// Why it was dropped.
    pub reason: DropReason,
    /// Details, such as the path of the missing file; empty if the reason is enough.
    pub detail: String,
}

impl std::fmt::Display for Dropped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            name,
            reason,
            detail,
        } = self;

        write!(f, "{name}: {reason}")?;
        if detail.is_empty() {
            Ok(())
        } else {
            write!(f, " ({detail})")
        }
    }
}

/// Why a frame was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
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
    /// The pose is exactly the identity, which the recorder writes when tracking is lost.
    #[error("suspect_identity_pose")]
    SuspectIdentityPose,
    #[error("no_pose_within_tolerance")]
    NoPoseWithinTolerance,
    /// A pose or image message of a bag that cannot be decoded.
    #[error("malformed_message")]
    MalformedMessage,
}

/// The frames and metadata of a recording.
#[derive(Debug, Clone, Default)]
pub struct Recording {
    /// The frames that can be used.
    pub frames: Frames,
    /// The frames that cannot be used, with the reasons.
    pub dropped: Vec<Dropped>,
    /// The largest entry of |RRᵀ − I| over all rotations, before they were projected onto SO(3).
    pub worst_rotation_deviation: f64,
    /// The folder that the image paths are relative to; empty if there are no images.
    pub images_root: String,
    /// Features that the recording contains.
    pub features: Vec<Features>,
    /// Name, original format, license and camera, as far as the recording states them.
    pub stated: Stated,
}

/// Metadata stated by a recording. Only bundles state name, format and license; COLMAP, EuRoC and
/// `transforms.json` also state the camera.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Stated {
    /// The room's name.
    pub name: String,
    /// The format that the room was first read from.
    pub format: String,
    /// The recording's license.
    pub license: String,
    /// The camera of all images; `None` if unknown, or if images have different cameras.
    pub camera: Option<CameraIntrinsics>,
}

impl Recording {
    /// Replaces the timestamps by those in a NumPy file, see [`read_timestamps`].
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Malformed`] if the file cannot be read, or if it does not have one
    /// timestamp per pose.
    pub fn with_timestamps(mut self, file: &Path) -> Result<Self, Error> {
        self.frames.timestamps_ns = read_timestamps(file)?;
        collect::check_lengths(file, &self)?;
        Ok(self)
    }

    /// The rows of every `step`-th frame of each sequence.
    pub fn every(&self, step: usize) -> Vec<usize> {
        let frame_count = self.frames.poses.len();
        let timeline = Timeline {
            frame_count,
            sequences: self.frames.sequences.clone(),
            held_out: Vec::new(),
        };

        // Counting restarts with every sequence, so that each one keeps its first frame.
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

/// How frames that cannot be used are treated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unusable {
    /// Drop them, and list them in [`Recording::dropped`].
    Drop,
    /// Refuse the whole recording with [`Error::Strict`].
    Refuse,
}

/// Options for reading a recording.
pub struct Reader<'a> {
    /// How frames that cannot be used are treated.
    pub unusable: Unusable,
    /// Called with the number of frames read so far and the total number of frames.
    pub progress: &'a mut dyn FnMut(usize, usize),
}

fn first_reason(dropped: &[Dropped]) -> String {
    dropped.first().map_or(String::new(), |first| {
        format!(" ({} dropped, the first: {first})", dropped.len())
    })
}

/// Maximum size of a file that is read as a whole, bytes.
const MAX_FILE_BYTES: u64 = 8 << 30;

fn read_bytes(file: &Path) -> Result<Vec<u8>, Error> {
    seese3_files::read(file, MAX_FILE_BYTES).map_err(|cause| Error::Io {
        file: file.to_owned(),
        cause,
    })
}

fn read_text(file: &Path) -> Result<String, Error> {
    let malformed = |_| Error::Malformed {
        file: file.to_owned(),
        problem: "is not UTF-8 text".into(),
    };
    // Some editors write a byte order mark before the text.
    let bytes = read_bytes(file)?;
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    String::from_utf8(text.to_vec()).map_err(malformed)
}

/// The names of all entries of a folder, sorted.
fn entries(folder: &Path) -> Result<Vec<String>, Error> {
    let io = |cause| Error::Io {
        file: folder.to_owned(),
        cause,
    };

    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        let name = name.into_string().map_err(|name| Error::Malformed {
            file: folder.join(&name),
            problem: "has a name that is not UTF-8; rename the file".into(),
        })?;
        names.push(name);
    }

    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::geometry::Pose;

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

//! Shared by all formats: checks poses, and collects kept and dropped frames.

use std::path::Path;

use nalgebra::Matrix4;

use super::{DropReason, Dropped, Error, Reader, Recording, Unusable};
use seese3_core::geometry::{GivenPoseError, Pose, pose_from_matrix};

/// Checks that every column of the frames is empty or as long as the poses, so that it can be
/// indexed by row afterwards.
pub(super) fn check_lengths(file: &Path, recording: &Recording) -> Result<(), Error> {
    match recording.frames.unequal() {
        None => Ok(()),
        Some((what, actual)) => {
            let problem = format!(
                "there are {} poses but {actual} {what}",
                recording.frames.poses.len()
            );
            Err(Error::Malformed {
                file: file.to_owned(),
                problem: problem.into(),
            })
        }
    }
}

/// A frame's metadata, without its pose. Every field becomes a column, so within one recording it
/// must be set for all kept frames or for none.
#[derive(Debug, Clone, Default)]
pub(super) struct About {
    pub name: String,
    pub image: Option<String>,
    pub number: Option<i64>,
    pub timestamp_ns: Option<i64>,
    pub sequence: Option<u32>,
    pub held_out: Option<bool>,
}

/// Collects the frames of a recording.
#[derive(Default)]
pub(super) struct Collected(Recording);

impl Collected {
    /// Keeps a frame whose pose is already a valid rigid transform.
    pub fn keep(&mut self, about: About, pose: Pose) {
        let About {
            name,
            image,
            number,
            timestamp_ns,
            sequence,
            held_out,
        } = about;

        // Extending a column by `None` adds nothing, so a column that the format does not have
        // stays empty.
        let frames = &mut self.0.frames;
        frames.poses.push(pose);
        frames.names.push(name);
        frames.images.extend(image);

        frames.numbers.extend(number);
        frames.timestamps_ns.extend(timestamp_ns);
        frames.sequences.extend(sequence);
        frames.held_out.extend(held_out);
    }

    /// Keeps or drops a frame according to its matrix, `world_from_camera`. A matrix in another
    /// convention is an error that refuses the whole recording.
    pub fn take(&mut self, about: About, matrix: &Matrix4<f64>, file: &Path) -> Result<(), Error> {
        // A non-finite or singular pose drops only its own frame. A wrong last row or a rotation
        // far from SO(3) suggests another convention, for instance a transposed matrix, which would
        // affect every frame.
        match pose_from_matrix(matrix) {
            Ok((pose, deviation)) => {
                self.0.worst_rotation_deviation = self.0.worst_rotation_deviation.max(deviation);
                self.keep(about, pose);
            }
            Err(GivenPoseError::NotFinite) => self.drop(about.name, DropReason::NonFinitePose),
            Err(GivenPoseError::Singular) => self.drop(about.name, DropReason::NotARotation),
            Err(error) => {
                return Err(Error::Malformed {
                    file: file.to_owned(),
                    problem: format!("{}: {error}", about.name).into(),
                });
            }
        }

        Ok(())
    }

    /// Records a dropped frame.
    pub fn drop(&mut self, name: String, reason: DropReason) {
        self.drop_for(name, reason, String::new());
    }

    /// Records a dropped frame with a detailed description of the problem.
    pub fn drop_for(&mut self, name: String, reason: DropReason, detail: String) {
        self.0.dropped.push(Dropped {
            name,
            reason,
            detail,
        });
    }

    /// Records a frame that is dropped because the file `looked_for` is missing.
    pub fn drop_without(&mut self, looked_for: String, name: String, reason: DropReason) {
        self.drop_for(name, reason, format!("looked for {looked_for}"));
    }

    /// The complete recording, with image paths relative to `root`.
    pub fn finish(self, root: &Path, reader: &Reader<'_>) -> Result<Recording, Error> {
        let Self(mut recording) = self;
        let folder = root.to_owned();
        if reader.unusable == Unusable::Refuse && !recording.dropped.is_empty() {
            return Err(Error::Strict {
                folder,
                dropped: recording.dropped,
            });
        }

        if recording.frames.poses.is_empty() {
            return Err(Error::NoFrames {
                folder,
                dropped: recording.dropped,
            });
        }

        // The root is stored with the room and used later, so it must not depend on the current
        // working directory.
        if !recording.frames.images.is_empty() {
            let io = |cause| Error::Io {
                file: root.to_owned(),
                cause,
            };
            let root = root.canonicalize().map_err(io)?;

            let not_text = || Error::Malformed {
                file: folder,
                problem: "the path is not UTF-8".into(),
            };
            recording.images_root = root.to_str().ok_or_else(not_text)?.to_owned();
        }

        Ok(recording)
    }
}

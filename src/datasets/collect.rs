//! What every format does with a frame: keep it, or drop it by name.

use std::path::Path;

use nalgebra::{Matrix4, UnitQuaternion};

use super::{DropReason, Dropped, Error, MAX_ROTATION_DEVIATION, Reader, Recording, Unusable};
use crate::geometry::{Pose, nearest_rotation};

pub(super) const LAST_ROW_PROBLEM: &str = "the last row is not 0 0 0 1; is the matrix transposed?";

pub(super) fn deviation_problem(deviation: f64) -> String {
    format!(
        "the rotation is {deviation:.1e} off SO(3), over the limit of {MAX_ROTATION_DEVIATION:.0e}; \
         is this a rotation matrix, row by row?"
    )
}

/// What a 4×4 matrix says.
pub(super) enum MatrixPose {
    /// A pose, and how far its rotation was from SO(3).
    Pose(Pose, f64),
    NotFinite,
    NotARotation,
    /// The last row is not (0, 0, 0, 1): transposed, or no pose at all.
    NotHomogeneous,
}

/// Reads `world_from_camera` from a homogeneous matrix.
pub(super) fn pose_of(matrix: &Matrix4<f64>) -> MatrixPose {
    if !matrix.iter().all(|x| x.is_finite()) {
        return MatrixPose::NotFinite;
    }
    if matrix.row(3) != nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0) {
        return MatrixPose::NotHomogeneous;
    }

    let Some(nearest) = nearest_rotation(&matrix.fixed_view::<3, 3>(0, 0).into_owned()) else {
        return MatrixPose::NotARotation;
    };
    let rotation = UnitQuaternion::from_rotation_matrix(&nearest.rotation);

    let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    MatrixPose::Pose(
        Pose::from_parts(translation.into(), rotation),
        nearest.deviation,
    )
}

/// Refuses columns that are not as long as the poses, before anything is done by rows.
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
                problem,
            })
        }
    }
}

/// What a format says of a frame besides its pose; `None` where it says nothing of any frame.
#[derive(Debug, Clone, Default)]
pub(super) struct About {
    pub name: String,
    pub image: Option<String>,
    pub number: Option<i64>,
    pub timestamp_ns: Option<i64>,
    pub sequence: Option<u32>,
    pub held_out: Option<bool>,
}

/// Frames in the making.
#[derive(Default)]
pub(super) struct Collected(Recording);

impl Collected {
    /// Keeps a frame with a pose that needs no mending.
    pub fn keep(&mut self, about: About, pose: Pose) {
        let About {
            name,
            image,
            number,
            timestamp_ns,
            sequence,
            held_out,
        } = about;

        let frames = &mut self.0.frames;
        frames.poses.push(pose);
        frames.names.push(name);
        frames.images.extend(image);

        frames.numbers.extend(number);
        frames.timestamps_ns.extend(timestamp_ns);
        frames.sequences.extend(sequence);
        frames.held_out.extend(held_out);
    }

    /// Keeps or drops a frame by its matrix, `world_from_camera`; one that is no pose at all
    /// refuses the recording.
    pub fn take(&mut self, about: About, matrix: &Matrix4<f64>, file: &Path) -> Result<(), Error> {
        let malformed = |problem: String| Error::Malformed {
            file: file.to_owned(),
            problem,
        };

        match pose_of(matrix) {
            MatrixPose::Pose(_, deviation) if deviation > MAX_ROTATION_DEVIATION => {
                return Err(malformed(format!(
                    "{}: {}",
                    about.name,
                    deviation_problem(deviation)
                )));
            }
            MatrixPose::NotHomogeneous => {
                return Err(malformed(format!("{}: {LAST_ROW_PROBLEM}", about.name)));
            }
            MatrixPose::Pose(pose, deviation) => {
                self.0.worst_rotation_deviation = self.0.worst_rotation_deviation.max(deviation);
                self.keep(about, pose);
            }
            MatrixPose::NotFinite => self.drop(about.name, DropReason::NonFinitePose),
            MatrixPose::NotARotation => self.drop(about.name, DropReason::NotARotation),
        }

        Ok(())
    }

    /// Leaves a frame out.
    pub fn drop(&mut self, name: String, reason: DropReason) {
        self.0.dropped.push(Dropped { name, reason });
    }

    /// The recording, its images below `root`.
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

        if !recording.frames.images.is_empty() {
            let io = |cause| Error::Io {
                file: root.to_owned(),
                cause,
            };
            let root = root.canonicalize().map_err(io)?;

            let not_text = || Error::Malformed {
                file: folder,
                problem: "the path is not UTF-8".to_owned(),
            };
            recording.images_root = root.to_str().ok_or_else(not_text)?.to_owned();
        }

        Ok(recording)
    }
}

//! Shared by the formats: checking a pose, and collecting the frames that are kept or dropped.

use std::path::Path;

use nalgebra::{Matrix4, Quaternion, UnitQuaternion};

use super::{DropReason, Dropped, Error, MAX_ROTATION_DEVIATION, Reader, Recording, Unusable};
use seese3_core::geometry::{Pose, nearest_rotation};

pub(super) const LAST_ROW_PROBLEM: &str = "the last row is not 0 0 0 1; is the matrix transposed?";

pub(super) fn deviation_problem(deviation: f64) -> String {
    format!(
        "the rotation is {deviation:.1e} off SO(3), over the limit of {MAX_ROTATION_DEVIATION:.0e}; \
         is this a rotation matrix, row by row?"
    )
}

/// The result of reading a 4×4 matrix as a pose.
pub(super) enum MatrixPose {
    /// The pose with its rotation projected onto SO(3), and the largest entry of |RRᵀ − I| before
    /// the projection.
    Pose(Pose, f64),
    NotFinite,
    NotARotation,
    /// The last row is not (0, 0, 0, 1): the matrix is transposed, or is not a pose at all.
    NotHomogeneous,
}

/// Reads a rigid transform, such as `world_from_camera`, from a homogeneous matrix.
pub(super) fn pose_of(matrix: &Matrix4<f64>) -> MatrixPose {
    if !matrix.iter().all(|x| x.is_finite()) {
        return MatrixPose::NotFinite;
    }
    if matrix.row(3) != nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0) {
        return MatrixPose::NotHomogeneous;
    }

    // Published rotations carry rounding errors. The nearest rotation replaces them, and the
    // deviation lets the caller tell rounding from a matrix that is no rotation.
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

/// A camera pose from a homogeneous matrix, and the largest entry of |RRᵀ − I| of its rotation R,
/// which is projected onto SO(3).
///
/// # Errors
/// What is wrong with the matrix, in words.
pub fn pose_of_matrix(matrix: &Matrix4<f64>) -> Result<(Pose, f64), String> {
    match pose_of(matrix) {
        MatrixPose::Pose(_, deviation) if deviation > MAX_ROTATION_DEVIATION => {
            Err(deviation_problem(deviation))
        }
        MatrixPose::Pose(pose, deviation) => Ok((pose, deviation)),
        MatrixPose::NotFinite => Err("is not finite".to_owned()),
        MatrixPose::NotARotation => Err("has no rotation: its matrix is singular".to_owned()),
        MatrixPose::NotHomogeneous => Err(LAST_ROW_PROBLEM.to_owned()),
    }
}

/// How far the length of a quaternion may be from 1.
const NORM_TOLERANCE: f64 = 1e-2;

/// A pose from a position, metres, and a quaternion whose length is 1 up to rounding.
///
/// # Errors
/// What is wrong with the numbers, in words.
pub fn pose_of_quaternion(position: [f64; 3], quaternion: Quaternion<f64>) -> Result<Pose, String> {
    let is_unit = (quaternion.norm() - 1.0).abs() <= NORM_TOLERANCE;
    if !is_unit || !position.iter().all(|number| number.is_finite()) {
        return Err(format!(
            "the quaternion has norm {}, or the position is not finite",
            quaternion.norm()
        ));
    }

    let rotation = UnitQuaternion::from_quaternion(quaternion);
    Ok(Pose::from_parts(position.into(), rotation))
}

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
                problem,
            })
        }
    }
}

/// What a format states about a frame besides its pose. Every field becomes a column, so within one
/// recording it is set for all kept frames or for none.
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
        let malformed = |problem: String| Error::Malformed {
            file: file.to_owned(),
            problem,
        };

        // A pose that is not finite or is singular costs only its own frame. A wrong last row or a
        // rotation far from SO(3) suggests another convention, for instance a transposed matrix,
        // which would affect every frame.
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

    /// Records that a frame is left out.
    pub fn drop(&mut self, name: String, reason: DropReason) {
        self.drop_for(name, reason, String::new());
    }

    /// The same, with what exactly is wrong.
    pub fn drop_for(&mut self, name: String, reason: DropReason, detail: String) {
        self.0.dropped.push(Dropped {
            name,
            reason,
            detail,
        });
    }

    /// Records that a frame is left out because a file of it is missing, which was looked for in vain.
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
                problem: "the path is not UTF-8".to_owned(),
            };
            recording.images_root = root.to_str().ok_or_else(not_text)?.to_owned();
        }

        Ok(recording)
    }
}

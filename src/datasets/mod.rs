//! Recordings on disk, as rooms.
//!
//! Whatever a recording's convention, poses leave here as `world_from_camera`, metres, with rotations on SO(3).

mod numpy;
mod sevenscenes;

pub use numpy::{read_features, read_poses, read_timestamps};
pub use sevenscenes::read_seven_scenes;

use std::path::{Path, PathBuf};

use nalgebra::{Matrix4, UnitQuaternion};

use crate::geometry::{Pose, nearest_rotation};
use crate::room::Frames;

/// A rotation whose |RRᵀ − I| has a larger entry is not taken for a rounded one.
pub const MAX_ROTATION_DEVIATION: f64 = 1e-2;

/// Why a recording cannot be read. Each names the file.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{}: {cause}", file.display())]
    Io { file: PathBuf, cause: std::io::Error },
    #[error("{}: {problem}", file.display())]
    Malformed { file: PathBuf, problem: String },
    #[error("{}, frame {frame}: {problem}", file.display())]
    Frame { file: PathBuf, frame: usize, problem: String },
    #[error("{}: {} frames are unusable, the first is {}: {}; leave out --strict to drop them", folder.display(), dropped.len(), dropped[0].name, dropped[0].reason)]
    Strict { folder: PathBuf, dropped: Vec<Dropped> },
    #[error("{}: no usable frame was found{}", folder.display(), first_reason(dropped))]
    NoFrames { folder: PathBuf, dropped: Vec<Dropped> },
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DropReason {
    #[error("missing_pose_file")]
    MissingPoseFile,
    #[error("truncated_pose_file")]
    TruncatedPoseFile,
    #[error("non_finite_pose")]
    NonFinitePose,
    #[error("not_a_rotation")]
    NotARotation,
}

/// A recording that was read.
#[derive(Debug, Clone)]
pub struct Recording {
    /// The frames that can be used.
    pub frames: Frames,
    /// The frames that cannot.
    pub dropped: Vec<Dropped>,
    /// The largest |RRᵀ − I| entry of a rotation before it was projected.
    pub worst_rotation_deviation: f64,
}

fn first_reason(dropped: &[Dropped]) -> String {
    dropped.first().map_or(String::new(), |first| format!(" ({} dropped, the first: {})", dropped.len(), first.reason))
}

fn read_bytes(file: &Path) -> Result<Vec<u8>, Error> {
    std::fs::read(file).map_err(|cause| Error::Io { file: file.to_owned(), cause })
}

/// What a 4×4 matrix says.
enum MatrixPose {
    /// A pose, and how far its rotation was from SO(3).
    Pose(Pose, f64),
    NotFinite,
    NotARotation,
    /// The last row is not (0, 0, 0, 1): transposed, or no pose at all.
    NotHomogeneous,
}

/// Reads `world_from_camera` from a homogeneous matrix.
fn pose_of(matrix: &Matrix4<f64>) -> MatrixPose {
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
    MatrixPose::Pose(Pose::from_parts(translation.into(), rotation), nearest.deviation)
}

const LAST_ROW_PROBLEM: &str = "the last row is not 0 0 0 1; is the matrix transposed?";

fn deviation_problem(deviation: f64) -> String {
    format!(
        "the rotation is {deviation:.1e} off SO(3), over the limit of {MAX_ROTATION_DEVIATION:.0e}; \
         is this a rotation matrix, row by row?"
    )
}

//! 7-Scenes: `SCENE/seq-XX/frame-XXXXXX.{color.*,pose.txt}`, poses camera-to-world, metres.
//!
//! The published pose is that of the depth sensor; it is taken for the camera's, as most users of the set do.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use nalgebra::Matrix4;

use super::{
    DropReason, Dropped, Error, LAST_ROW_PROBLEM, MAX_ROTATION_DEVIATION, MatrixPose, Recording, deviation_problem,
    pose_of, read_bytes,
};
use crate::room::Frames;

const POSE_SUFFIX: &str = ".pose.txt";

/// Reads one sequence: `folder` itself when it holds frames, else the one named, else the only one there is.
///
/// # Errors
/// [`Error`], naming the file or folder; with `strict` also when a frame would be dropped.
pub fn read_seven_scenes(folder: &Path, sequence: Option<&str>, strict: bool) -> Result<Recording, Error> {
    let sequence = choose_sequence(folder, sequence)?;
    let sequence_name = sequence.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let mut recording = Recording { frames: Frames::default(), dropped: Vec::new(), worst_rotation_deviation: 0.0 };
    for stem in frame_stems(&sequence)? {
        let name = format!("{sequence_name}/{stem}");
        match read_pose(&sequence.join(format!("{stem}{POSE_SUFFIX}")))? {
            Ok(MatrixPose::Pose(pose, deviation)) => {
                if deviation > MAX_ROTATION_DEVIATION {
                    let file = sequence.join(format!("{stem}{POSE_SUFFIX}"));
                    return Err(Error::Malformed { file, problem: deviation_problem(deviation) });
                }
                recording.worst_rotation_deviation = recording.worst_rotation_deviation.max(deviation);
                recording.frames.poses.push(pose);
                recording.frames.names.push(name);
            }
            Ok(MatrixPose::NotHomogeneous) => {
                let file = sequence.join(format!("{stem}{POSE_SUFFIX}"));
                return Err(Error::Malformed { file, problem: LAST_ROW_PROBLEM.to_owned() });
            }
            Ok(MatrixPose::NotFinite) => recording.dropped.push(Dropped { name, reason: DropReason::NonFinitePose }),
            Ok(MatrixPose::NotARotation) => recording.dropped.push(Dropped { name, reason: DropReason::NotARotation }),
            Err(reason) => recording.dropped.push(Dropped { name, reason }),
        }
    }
    if recording.frames.poses.is_empty() {
        return Err(Error::NoFrames { folder: sequence, dropped: recording.dropped });
    }
    if strict && !recording.dropped.is_empty() {
        return Err(Error::Strict { folder: sequence, dropped: recording.dropped });
    }
    Ok(recording)
}

fn choose_sequence(folder: &Path, sequence: Option<&str>) -> Result<PathBuf, Error> {
    if let Some(name) = sequence {
        return Ok(folder.join(name));
    }
    let names = entries(folder)?;
    if names.iter().any(|name| name.starts_with("frame-")) {
        return Ok(folder.to_owned());
    }
    let sequences: Vec<&String> = names.iter().filter(|name| name.starts_with("seq-")).collect();
    let malformed = |problem: String| Error::Malformed { file: folder.to_owned(), problem };
    match sequences.as_slice() {
        [only] => Ok(folder.join(only)),
        [] => Err(malformed("holds neither frame-*.pose.txt nor a folder seq-XX".to_owned())),
        several => {
            let listed: Vec<&str> = several.iter().map(|name| name.as_str()).collect();
            Err(malformed(format!("holds several sequences ({}); name one with --sequence", listed.join(", "))))
        }
    }
}

/// Names of the frames that have a pose or an image, in order of their numbers.
fn frame_stems(sequence: &Path) -> Result<BTreeSet<String>, Error> {
    let stem = |name: &String| Some(name.split('.').next()?.to_owned()).filter(|stem| stem.starts_with("frame-"));
    Ok(entries(sequence)?.iter().filter_map(stem).collect())
}

fn entries(folder: &Path) -> Result<Vec<String>, Error> {
    let io = |cause| Error::Io { file: folder.to_owned(), cause };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        names.push(entry.map_err(io)?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    Ok(names)
}

/// The pose in a file of sixteen numbers, or why there is none.
fn read_pose(file: &Path) -> Result<Result<MatrixPose, DropReason>, Error> {
    if !file.exists() {
        return Ok(Err(DropReason::MissingPoseFile));
    }
    let bytes = read_bytes(file)?;
    let text = String::from_utf8_lossy(&bytes);
    let mut numbers = Vec::with_capacity(16);
    for word in text.split_whitespace() {
        let number = word
            .parse::<f64>()
            .map_err(|_| Error::Malformed { file: file.to_owned(), problem: format!("'{word}' is no number") })?;
        numbers.push(number);
    }
    match numbers.len() {
        16 => Ok(Ok(pose_of(&Matrix4::from_row_slice(&numbers)))),
        0..16 => Ok(Err(DropReason::TruncatedPoseFile)),
        more => Err(Error::Malformed { file: file.to_owned(), problem: format!("has {more} numbers, expected 16") }),
    }
}

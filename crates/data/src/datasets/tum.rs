//! TUM RGB-D: `rgb.txt` ("timestamp file") and `groundtruth.txt`
//! ("timestamp tx ty tz qx qy qz qw"), camera-to-world.
//!
//! An image takes the pose nearest in time if it is at most 10 ms away, as evo associates them.
//! Times are decimal text and are read exactly to the nanosecond. Lines are parsed at least as
//! strictly as by evo; in addition, all numbers must be finite.

use std::path::Path;

use nalgebra::Quaternion;

use super::collect::{About, Collected};
use super::text::{data_lines, finite_row, nanoseconds, spaced, wrong};
use super::{DropReason, Error, Reader, Recording, read_text};
use seese3_core::geometry::{Pose, pose_from_quaternion};
use seese3_core::trajectory::Trajectory;

/// The longest time between an image and its pose, nanoseconds.
const MAX_DIFFERENCE_NS: u64 = 10_000_000;

/// Reads the folder of one sequence.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`. The message names the file and the line, or the
/// folder.
pub fn read_tum(folder: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let poses = read_trajectory(&folder.join("groundtruth.txt"))?;
    let images = read_images(&folder.join("rgb.txt"))?;
    let mut collected = Collected::default();
    for (done, (timestamp_ns, image)) in images.iter().enumerate() {
        (reader.progress)(done, images.len());

        let Some(pose) = nearest(&poses, *timestamp_ns) else {
            collected.drop(image.clone(), DropReason::NoPoseWithinTolerance);
            continue;
        };

        if !folder.join(image).is_file() {
            let looked_for = folder.join(image).display().to_string();
            collected.drop_without(looked_for, image.clone(), DropReason::MissingImage);
            continue;
        }

        // The image path also serves as the frame's name.
        let name = image.clone();
        let image = Some(image.clone());

        collected.keep(
            About {
                name,
                image,
                timestamp_ns: Some(*timestamp_ns),
                ..About::default()
            },
            pose,
        );
    }

    collected.finish(folder, reader)
}

/// Reads a trajectory file with one line "timestamp tx ty tz qx qy qz qw" per pose, and sorts the
/// poses by time.
///
/// # Errors
/// [`Error`] if the file cannot be read or a line is malformed. The message names the file and the
/// line.
pub fn read_tum_trajectory(file: &Path) -> Result<Trajectory, Error> {
    let (times_ns, poses) = read_trajectory(file)?.into_iter().unzip();
    Ok(Trajectory { times_ns, poses })
}

/// The pose nearest in time, if it is within the tolerance; of two equally near, the earlier.
fn nearest(poses: &[(i64, Pose)], timestamp_ns: i64) -> Option<Pose> {
    let after = poses.partition_point(|(time, _)| *time < timestamp_ns);

    // The poses are sorted, so only the last one before the time and the first one at or after it
    // can be nearest.
    let around = poses[after.saturating_sub(1)..].iter().take(2);
    let (time, pose) = around.min_by_key(|(time, _)| time.abs_diff(timestamp_ns))?;
    (time.abs_diff(timestamp_ns) <= MAX_DIFFERENCE_NS).then_some(*pose)
}

/// Times, nanoseconds, and poses, `world_from_camera`; sorted by time.
fn read_trajectory(file: &Path) -> Result<Vec<(i64, Pose)>, Error> {
    let text = read_text(file)?;
    let mut poses = Vec::new();
    for (line, row) in data_lines(&text) {
        let [_, x, y, z, qx, qy, qz, qw] = finite_row(file, line, row)?;
        let time = time(file, line, row)?;

        // The file writes the scalar part last; nalgebra takes it first.
        let pose = pose_from_quaternion([x, y, z], Quaternion::new(qw, qx, qy, qz))
            .map_err(|error| wrong(file, line, error.into()))?;
        poses.push((time, pose));
    }

    poses.sort_by_key(|(time, _)| *time);
    Ok(poses)
}

/// Times, nanoseconds, and image paths relative to the folder; sorted by time.
fn read_images(file: &Path) -> Result<Vec<(i64, String)>, Error> {
    let text = read_text(file)?;
    let mut images = Vec::new();
    for (line, row) in data_lines(&text) {
        let words = spaced(file, line, row)?;
        let &[_, image] = words.as_slice() else {
            return Err(wrong(
                file,
                line,
                format!("has {} columns, expected timestamp and file", words.len()).into(),
            ));
        };

        images.push((time(file, line, row)?, image.to_owned()));
    }

    images.sort_by_key(|(time, _)| *time);
    Ok(images)
}

/// Nanoseconds from seconds in scientific notation, as NumPy writes them; rounded to a double.
fn scientific(seconds: &str) -> Option<i64> {
    let seconds: f64 = seconds
        .contains(['e', 'E'])
        .then(|| seconds.parse().ok())??;
    let nanoseconds = (seconds * 1e9).round();

    (0.0..9.2e18)
        .contains(&nanoseconds)
        .then_some(nanoseconds as i64)
}

fn time(file: &Path, line: usize, row: &str) -> Result<i64, Error> {
    let word = row.split(' ').next().unwrap_or_default();
    nanoseconds(word)
        .or_else(|| scientific(word))
        .ok_or_else(|| {
            wrong(
                file,
                line,
                format!("'{word}' is not a time in decimal seconds").into(),
            )
        })
}

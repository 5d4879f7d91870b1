//! ARKitScenes: images `VIDEO/lowres_wide/VIDEO_TIME.png`, poses `VIDEO/lowres_wide.traj`.
//!
//! A line of the trajectory holds a time in seconds, a rotation vector (axis times angle, radians)
//! and a translation (meters). This is the **world-to-camera** transform, which is inverted here.
//! About one image in six has a pose. As in the official loader, poses are looked up by their time
//! rounded to milliseconds: an image takes the pose of its own millisecond, or else the nearest one
//! less than 5 ms away.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Translation3, UnitQuaternion, Vector3};

use super::collect::{About, Collected};
use super::text::{finite_row, nanoseconds, wrong};
use super::{DropReason, Error, Reader, Recording, entries, read_text};
use seese3_core::geometry::Pose;

const IMAGES: &str = "lowres_wide";
/// Exclusive limit of the time between an image and its pose, milliseconds.
const TOLERANCE_MS: u64 = 5;

/// Reads the folder of one video.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`. The message names the file or folder.
pub fn read_arkitscenes(folder: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let poses = read_trajectory(&folder.join(format!("{IMAGES}.traj")))?;
    let mut images = Vec::new();
    for name in entries(&folder.join(IMAGES))? {
        let Some(stem) = name.strip_suffix(".png") else {
            continue;
        };
        let time = stem
            .rsplit_once('_')
            .and_then(|(_, time)| nanoseconds(time));

        let problem = format!("'{name}' is not of the form VIDEO_SECONDS.png");
        let time = time.ok_or_else(|| Error::Malformed {
            file: folder.join(IMAGES),
            problem: problem.into(),
        })?;
        images.push((time, stem.to_owned()));
    }

    // Names are sorted as text; frames must be in order of time.
    images.sort();
    let mut collected = Collected::default();
    for (done, (timestamp_ns, stem)) in images.iter().enumerate() {
        (reader.progress)(done, images.len());
        let key = milliseconds(*timestamp_ns);

        // The limit is exclusive: a pose exactly 5 ms away is not used.
        let near = poses.range(key - TOLERANCE_MS as i64 + 1..key + TOLERANCE_MS as i64);
        let Some((_, pose)) = near.min_by_key(|(other, _)| other.abs_diff(key)) else {
            collected.drop(stem.clone(), DropReason::NoPoseWithinTolerance);
            continue;
        };

        let image = Some(format!("{IMAGES}/{stem}.png"));
        let about = About {
            name: stem.clone(),
            image,
            timestamp_ns: Some(*timestamp_ns),
            ..About::default()
        };

        collected.keep(about, *pose);
    }

    collected.finish(folder, reader)
}

/// Reads the poses, `world_from_camera`, keyed by time in milliseconds.
fn read_trajectory(file: &Path) -> Result<BTreeMap<i64, Pose>, Error> {
    let text = read_text(file)?;
    let mut poses = BTreeMap::new();
    for (line, row) in (1..)
        .zip(text.lines())
        .filter(|(_, row)| !row.trim().is_empty())
    {
        let [_, rx, ry, rz, x, y, z] = finite_row(file, line, row.trim_end())?;

        // The time is parsed from the text, because a double would round it.
        let word = row.split(' ').next().unwrap_or_default();
        let time = nanoseconds(word).ok_or_else(|| {
            wrong(
                file,
                line,
                format!("'{word}' is not a time in seconds").into(),
            )
        })?;

        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(rx, ry, rz));
        let camera_from_world = Pose::from_parts(Translation3::new(x, y, z), rotation);
        poses.insert(milliseconds(time), camera_from_world.inverse());
    }

    Ok(poses)
}

/// The time rounded to the nearest millisecond, as `%.3f` rounds seconds.
fn milliseconds(time_ns: i64) -> i64 {
    (time_ns + 500_000).div_euclid(1_000_000)
}

//! ScanNet scenes as written by its exporter: `color/N.jpg` and `pose/N.txt`, or all files in one
//! folder; camera-to-world, meters.
//!
//! Frames are ordered by number, not by name: 2 comes before 10. Lost tracking is written as −inf,
//! and by one exporter as an identity matrix.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Matrix4;

use super::collect::{About, Collected};
use super::text::read_matrix;
use super::{DropReason, Error, Reader, Recording, entries};

/// Reads the folder of an exported scene.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`. The message names the file or folder.
pub fn read_scannet(folder: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    // Without the subfolder, the files are in the scene's folder itself.
    let below = |name: &'static str| {
        if folder.join(name).is_dir() {
            format!("{name}/")
        } else {
            String::new()
        }
    };

    let images_at = below("color");
    let poses_at = below("pose");
    let images = numbered(&folder.join(&images_at), &["jpg", "png"])?;
    let poses = numbered(&folder.join(&poses_at), &["txt"])?;

    // All numbers of images and poses are needed, so that a frame with only one of them is reported
    // as dropped.
    let mut numbers: Vec<i64> = images.keys().chain(poses.keys()).copied().collect();
    numbers.sort_unstable();

    numbers.dedup();

    // The first pose of a recording may really be the identity, see `is_suspect`.
    let first_pose = poses.keys().next().copied();
    let mut collected = Collected::default();
    for (done, &number) in numbers.iter().enumerate() {
        (reader.progress)(done, numbers.len());
        let name = number.to_string();

        let (image, pose) = match (images.get(&number), poses.get(&number)) {
            (Some(image), Some(pose)) => (image, pose),
            (None, _) => {
                let looked_for = format!("{images_at}{number}.jpg or .png");
                collected.drop_without(looked_for, name, DropReason::MissingImage);
                continue;
            }
            (_, None) => {
                let looked_for = format!("{poses_at}{number}.txt");
                collected.drop_without(looked_for, name, DropReason::MissingPoseFile);
                continue;
            }
        };

        let file = folder.join(format!("{poses_at}{pose}"));
        let image = Some(format!("{images_at}{image}"));

        let about = About {
            name,
            image,
            number: Some(number),
            ..About::default()
        };

        match read_matrix(&file)? {
            Err(reason) => collected.drop(about.name, reason),
            Ok(matrix) if is_suspect(&matrix, first_pose == Some(number)) => {
                collected.drop(about.name, DropReason::SuspectIdentityPose);
            }
            Ok(matrix) => collected.take(about, &matrix, &file)?,
        }
    }

    collected.finish(folder, reader)
}

/// Whether a pose is the identity matrix, which marks lost tracking. The first pose is never
/// suspect, since a recording may start at its origin.
pub(super) fn is_suspect(matrix: &Matrix4<f64>, is_first: bool) -> bool {
    !is_first && *matrix == Matrix4::identity()
}

/// Files `N.EXTENSION` of a folder, by number. Extensions are compared case-insensitively.
fn numbered(folder: &Path, extensions: &[&str]) -> Result<BTreeMap<i64, String>, Error> {
    let number = |name: String| {
        let (stem, extension) = name.rsplit_once('.')?;
        let is_wanted = extensions
            .iter()
            .any(|wanted| wanted.eq_ignore_ascii_case(extension));
        let number = is_wanted.then(|| stem.parse::<i64>().ok())??;

        (number >= 0).then_some((number, name))
    };

    Ok(entries(folder)?.into_iter().filter_map(number).collect())
}

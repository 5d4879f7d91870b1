//! ScanNet as its exporter leaves it: `color/N.jpg`, `pose/N.txt` (or all in one folder),
//! camera-to-world, metres.
//!
//! Frames go by number, not by name: 2 before 10. Lost tracking is written as −inf, by one writer
//! as an identity.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Matrix4;

use super::collect::{About, Collected};
use super::text::read_matrix;
use super::{DropReason, Error, Reader, Recording, entries};

/// Reads an exported scene.
///
/// # Errors
/// [`Error`], naming the file or folder.
pub fn read_scannet(folder: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
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
    let mut numbers: Vec<i64> = images.keys().chain(poses.keys()).copied().collect();
    numbers.sort_unstable();

    numbers.dedup();
    let first_pose = poses.keys().next().copied();
    let mut collected = Collected::default();
    for (done, &number) in numbers.iter().enumerate() {
        (reader.progress)(done, numbers.len());
        let name = number.to_string();

        let (image, pose) = match (images.get(&number), poses.get(&number)) {
            (Some(image), Some(pose)) => (image, pose),
            (None, _) => {
                collected.drop(name, DropReason::MissingImage);
                continue;
            }
            (_, None) => {
                collected.drop(name, DropReason::MissingPoseFile);
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

/// Whether a pose is the identity that stands for lost tracking; the first frame may well be the
/// origin.
pub(super) fn is_suspect(matrix: &Matrix4<f64>, is_first: bool) -> bool {
    !is_first && *matrix == Matrix4::identity()
}

/// Files `N.EXTENSION` of a folder, by number.
fn numbered(folder: &Path, extensions: &[&str]) -> Result<BTreeMap<i64, String>, Error> {
    let number = |name: String| {
        let (stem, extension) = name.rsplit_once('.')?;
        let number = extensions
            .contains(&extension)
            .then(|| stem.parse::<i64>().ok())??;

        (number >= 0).then_some((number, name))
    };

    Ok(entries(folder)?.into_iter().filter_map(number).collect())
}

//! User-made folders: `images/`, `poses.npy`, and the other arrays that `import numpy` reads.
//!
//! Images are sorted by the numbers in their names and assigned to the poses in that order.

use std::path::Path;

use super::natural::sort_naturally;
use super::{Error, Recording, entries, read_numpy};

/// The folder of the images.
pub(super) const IMAGES: &str = "images";

/// Reads a folder with `poses.npy` and `images/`.
///
/// # Errors
/// [`Error`] if a file cannot be read or has another shape, or if there are not as many images as
/// poses. The message names the file or the folder.
pub fn read_folder(folder: &Path) -> Result<Recording, Error> {
    if !folder.join("poses.npy").is_file() {
        return Err(Error::Malformed {
            file: folder.to_owned(),
            problem: without_poses(folder).into(),
        });
    }

    let mut recording = read_numpy(folder)?;
    let images = image_files(&folder.join(IMAGES))?;
    let pose_count = recording.frames.poses.len();
    if images.len() != pose_count {
        let convert = match other_images(&folder.join(IMAGES)) {
            0 => String::new(),
            count => format!(
                "; {count} other images there have to be converted to JPEG first, for instance with `magick \
                 mogrify -format jpg *.heic`"
            ),
        };
        return Err(Error::Malformed {
            file: folder.join(IMAGES),
            problem: format!(
                "has {} images (.jpg, .jpeg, .png), but poses.npy has {pose_count} poses; each image needs \
                 a pose, in the order of the numbers in the images' names{convert}",
                images.len()
            )
            .into(),
        });
    }

    recording.frames.names.clone_from(&images);
    recording.frames.images = images
        .into_iter()
        .map(|image| format!("{IMAGES}/{image}"))
        .collect();
    recording.images_root = resolved(folder)?;
    Ok(recording)
}

/// What to do with a folder, or a video, without poses.
fn without_poses(path: &Path) -> String {
    let make = "`python -m seese3.mapping` makes a room of a video or of photographs without poses";
    if path.is_file() {
        return format!("is a file, and not a folder with images/ and poses.npy; {make}");
    }
    let is_project = path.join("sparse").exists() || path.join("transforms.json").exists();
    let other = match is_project {
        true => {
            "; it looks like a model: read it with `seese3 import colmap` or `seese3 import transforms`"
        }
        false => "",
    };
    format!("has no poses.npy, world_from_camera (n, 4, 4){other}; {make}")
}

/// The number of images in a folder that this program does not decode.
fn other_images(folder: &Path) -> usize {
    const OTHER: [&str; 6] = ["heic", "heif", "avif", "webp", "tif", "tiff"];
    let is_other = |name: &String| {
        let extension = Path::new(name).extension().map(|e| e.to_ascii_lowercase());
        extension.is_some_and(|extension| OTHER.iter().any(|other| extension == *other))
    };
    entries(folder).map_or(0, |names| {
        names.iter().filter(|name| is_other(name)).count()
    })
}

/// The names of the images in a folder, sorted by the numbers in the names.
pub(super) fn image_files(folder: &Path) -> Result<Vec<String>, Error> {
    let is_image = |name: &String| {
        // Some systems write a hidden metadata file for each image: ._0001.jpg.
        if name.starts_with('.') {
            return false;
        }
        let extension = Path::new(name).extension().map(|e| e.to_ascii_lowercase());
        extension.is_some_and(|extension| {
            extension == "jpg" || extension == "jpeg" || extension == "png"
        })
    };

    let mut images: Vec<String> = entries(folder)?.into_iter().filter(is_image).collect();
    sort_naturally(&mut images, |name| name);
    Ok(images)
}

/// A folder's absolute path. It is stored, so it must not depend on the working directory.
pub(super) fn resolved(folder: &Path) -> Result<String, Error> {
    let whole = folder.canonicalize().map_err(|cause| Error::Io {
        file: folder.to_owned(),
        cause,
    })?;
    let text = whole.to_str().ok_or_else(|| Error::Malformed {
        file: folder.to_owned(),
        problem: "the path is not UTF-8".into(),
    })?;

    Ok(text.to_owned())
}

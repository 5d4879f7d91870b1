//! JPEG thumbnails of a room's images.

use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::preparation::resized;
use super::{Error, Filter, read_image};

/// The quality of the JPEG, 1 to 100. A thumbnail 160 pixels wide has about 5 kB.
const QUALITY: u8 = 80;

/// A JPEG of an image of a room, `width` pixels wide and of the same proportions; a narrower image
/// keeps its size. `root` and `image` are as in [`read_image`].
///
/// # Errors
/// As [`read_image`].
pub fn thumbnail(root: &Path, image: &str, width: usize) -> Result<Vec<u8>, Error> {
    let picture = read_image(root, image)?;
    let width = width.min(picture.width);
    let height = (picture.height * width).div_ceil(picture.width.max(1));
    let picture = resized(&picture, width, height, Filter::Bilinear)?;

    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, QUALITY)
        .write_image(
            &picture.bytes,
            width as u32,
            height as u32,
            ExtendedColorType::Rgb8,
        )
        .map_err(|error| Error::BadImage {
            image: root.join(image).display().to_string(),
            problem: format!("cannot be encoded as a thumbnail: {error}").into(),
        })?;

    Ok(bytes)
}

//! JPEG thumbnails of a room's images.

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::preparation::resized;
use super::{Bounds, Error, Filter, decode};

/// The quality of the JPEG, 1 to 100. A thumbnail 160 pixels wide has about 5 kB.
const QUALITY: u8 = 80;

/// A JPEG of an encoded image, `width` pixels wide and of the same proportions; a narrower image
/// keeps its size. `name` identifies the image in error messages.
///
/// # Errors
/// As [`decode`], within [`Bounds::LOCAL`].
pub fn thumbnail(name: &str, image: &[u8], width: usize) -> Result<Vec<u8>, Error> {
    let picture = decode(name, image, Bounds::LOCAL)?;
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
            image: name.to_owned(),
            problem: format!("cannot be encoded as a thumbnail: {error}").into(),
        })?;

    Ok(bytes)
}

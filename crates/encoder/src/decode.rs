//! Decodes JPEG and PNG files to 8-bit RGB, within limits on their size.
//!
//! Images are rotated upright by their EXIF orientation, as in every viewer: a phone stores the
//! sensor's image, however it was held.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use image::codecs::png::PngEncoder;
use image::metadata::Orientation;
use image::{
    DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits,
};

use super::Error;
use seese3_core::image::RgbImage;

/// Limits on the size of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// The largest number of bytes of the encoded image.
    pub bytes: u64,
    /// The largest number of pixels of the decoded image.
    pub pixels: u64,
}

/// The longest side of an image, pixels. Resizing a longer one would need an intermediate image
/// that is much larger.
const LONGEST_SIDE: usize = 16_384;

/// The end-of-image marker of a JPEG. Other bytes may follow it in the file.
const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];
/// The code of the marker that begins the compressed pixels of a JPEG.
const START_OF_SCAN: u8 = 0xda;
/// Allocation limit for reading the header of a PNG, bytes. A color profile in it is compressed,
/// and may be a decompression bomb.
const HEADER_ALLOC: u64 = 16 << 20;
/// Maximum number of bytes read to find an image's size. A header with a thumbnail and a color
/// profile is much smaller.
const HEADER_BYTES: u64 = 1 << 20;

impl Bounds {
    /// Limits for the user's own files.
    pub const LOCAL: Self = Self {
        bytes: seese3_files::IMAGE_FILE_BYTES,
        pixels: 100_000_000,
    };
}

/// Decodes a JPEG or PNG to 8-bit RGB. Alpha is dropped, gray is repeated in all three channels,
/// and 16 bits are reduced to 8. `name` identifies the image in error messages.
///
/// # Errors
/// [`Error::BadImage`] if the format is not JPEG or PNG, the file is incomplete or damaged, or the
/// image exceeds `bounds`.
pub fn decode(name: &str, bytes: &[u8], bounds: Bounds) -> Result<RgbImage, Error> {
    let decoded = match image::guess_format(bytes).ok() {
        Some(ImageFormat::Jpeg) => {
            check_bytes(bytes, bounds).and_then(|()| decode_jpeg(bytes, bounds))
        }
        Some(ImageFormat::Png) => decode_png(bytes, bounds)
            .map(|(decoded, orientation)| upright(decoded.into_rgb8(), orientation)),
        _ => check_bytes(bytes, bounds).and(Err("is neither JPEG nor PNG".to_owned())),
    };
    decoded.map_err(|problem| bad_image(name, &problem))
}

/// What decoding an image will need, from its header alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DecodingCost {
    /// Number of pixels.
    pub pixels: u64,
    /// Peak memory of decoding to 8-bit RGB, bytes.
    pub bytes: u64,
}

/// The cost of decoding an image. `None` if it has no JPEG or PNG header: [`decode`] refuses it.
pub fn decoding_cost(bytes: &[u8]) -> Option<DecodingCost> {
    /// Bytes of a pixel in 8-bit RGB.
    const RGB: u64 = 3;
    /// Bytes of a pixel's coefficients in a progressive JPEG: three channels of 16 bits.
    const COEFFICIENTS: u64 = 6;

    match image::guess_format(bytes).ok()? {
        ImageFormat::Jpeg => {
            let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), jpeg_options());
            decoder.decode_headers().ok()?;
            let (width, height) = decoder.dimensions()?;
            let pixels = width as u64 * height as u64;
            Some(DecodingCost {
                pixels,
                bytes: pixels * (RGB + COEFFICIENTS),
            })
        }
        ImageFormat::Png => {
            let decoder = png_reader(bytes, HEADER_ALLOC).into_decoder().ok()?;
            let (width, height) = decoder.dimensions();
            let pixels = u64::from(width) * u64::from(height);
            Some(DecodingCost {
                pixels,
                bytes: decoder.total_bytes().saturating_add(pixels * RGB),
            })
        }
        _ => None,
    }
}

/// 16-bit gray values, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrayImage16 {
    /// Pixels of a row.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// The values.
    pub values: Vec<u16>,
}

/// Decodes a PNG of 16-bit gray values. `name` identifies the image in error messages.
///
/// # Errors
/// [`Error::BadImage`] if it is no such PNG, is incomplete or damaged, or exceeds `bounds`.
pub fn decode_gray16(name: &str, bytes: &[u8], bounds: Bounds) -> Result<GrayImage16, Error> {
    let decoded = match image::guess_format(bytes).ok() {
        Some(ImageFormat::Png) => decode_png(bytes, bounds),
        _ => Err("is not a PNG".to_owned()),
    };
    match decoded {
        Ok((DynamicImage::ImageLuma16(image), _)) => Ok(GrayImage16 {
            width: image.width() as usize,
            height: image.height() as usize,
            values: image.into_raw(),
        }),
        Ok((other, _)) => {
            let problem = format!(
                "has pixels of the type {:?}, not 16-bit gray",
                other.color()
            );
            Err(bad_image(name, &problem))
        }
        Err(problem) => Err(bad_image(name, &problem)),
    }
}

/// Messages of the decoders may contain line breaks; our errors are one line.
fn bad_image(name: &str, problem: &str) -> Error {
    let words: Vec<&str> = problem.split_whitespace().collect();
    Error::BadImage {
        image: name.to_owned(),
        problem: words.join(" ").into(),
    }
}

fn check_bytes(bytes: &[u8], bounds: Bounds) -> Result<(), String> {
    let count = bytes.len() as u64;
    let most = bounds.bytes;
    (count <= most)
        .then_some(())
        .ok_or_else(|| format!("is {count} bytes, over the limit of {most}"))
}

/// The pixels and the EXIF orientation of a PNG.
fn decode_png(bytes: &[u8], bounds: Bounds) -> Result<(DynamicImage, Orientation), String> {
    check_bytes(bytes, bounds)?;
    let problem = |error: image::ImageError| error.to_string();
    // The header is read alone first, so that an image over the limits is refused before memory is
    // allocated for its pixels.
    let (width, height) = png_reader(bytes, HEADER_ALLOC)
        .into_dimensions()
        .map_err(problem)?;
    check_size(width as usize, height as usize, bounds)?;

    // A pixel has at most four channels of 16 bits, 8 bytes; the decoder may use as much again.
    let most = (u64::from(width) * u64::from(height))
        .saturating_mul(16)
        .saturating_add(HEADER_ALLOC);
    let mut decoder = png_reader(bytes, most).into_decoder().map_err(problem)?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let decoded = DynamicImage::from_decoder(decoder).map_err(problem)?;
    Ok((decoded, orientation))
}

/// A reader of a PNG that allocates at most `most` bytes.
fn png_reader(bytes: &[u8], most: u64) -> ImageReader<Cursor<&[u8]>> {
    let mut reader = ImageReader::new(Cursor::new(bytes));
    reader.set_format(ImageFormat::Png);
    let mut limits = Limits::default();
    limits.max_alloc = Some(most);

    reader.limits(limits);
    reader
}

/// Applies an EXIF orientation to an image.
fn upright(image: image::RgbImage, orientation: Orientation) -> RgbImage {
    let mut image = DynamicImage::ImageRgb8(image);
    image.apply_orientation(orientation);
    let image = image.into_rgb8();

    RgbImage {
        width: image.width() as usize,
        height: image.height() as usize,
        bytes: image.into_raw(),
    }
}

fn check_size(width: usize, height: usize, bounds: Bounds) -> Result<(), String> {
    if width.max(height) > LONGEST_SIDE {
        return Err(format!(
            "has {width}×{height} pixels, over the limit of {LONGEST_SIDE} a side"
        ));
    }

    if width as u64 * height as u64 > bounds.pixels {
        return Err(format!(
            "has {width}×{height} pixels, over the limit of {}",
            bounds.pixels
        ));
    }

    Ok(())
}

/// Decodes a JPEG strictly: a truncated image is an error and is not filled with gray.
fn decode_jpeg(bytes: &[u8], bounds: Bounds) -> Result<RgbImage, String> {
    let rest = after_header(bytes).unwrap_or_default();
    if !rest.windows(2).rev().any(|marker| marker == END_OF_IMAGE) {
        return Err("has no end-of-image marker: the file is truncated".to_owned());
    }

    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), jpeg_options());
    decoder
        .decode_headers()
        .map_err(|error| error.to_string())?;

    let (width, height) = decoder.dimensions().ok_or("does not state its size")?;
    check_size(width, height, bounds)?;
    let bytes = decoder.decode().map_err(|error| error.to_string())?;
    let image = image::RgbImage::from_raw(width as u32, height as u32, bytes)
        .ok_or("has colors that cannot be converted to RGB")?;

    let exif = decoder
        .exif()
        .and_then(|exif| Orientation::from_exif_chunk(exif));
    Ok(upright(image, exif.unwrap_or(Orientation::NoTransforms)))
}

/// The decoder's own limits on size are raised to the largest that the format allows, so that
/// `check_size` alone decides.
fn jpeg_options() -> DecoderOptions {
    DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX))
        .jpeg_set_out_colorspace(ColorSpace::RGB)
}

/// The bytes after the header of a JPEG; `None` if the header is incomplete. An end-of-image marker
/// within the header belongs to a thumbnail.
fn after_header(bytes: &[u8]) -> Option<&[u8]> {
    // A header is a list of segments: 0xff, a code, a two-byte length that includes itself, and the
    // content. Only the start-of-image marker, the first two bytes, has no length.
    let mut rest = bytes.get(2..)?;
    loop {
        let &[0xff, code, ..] = rest else {
            return None;
        };
        // A marker may be preceded by any number of bytes 0xff.
        if code == 0xff {
            rest = &rest[1..];
            continue;
        }

        let length = rest.get(2..4)?;
        let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
        rest = rest.get(2 + length..)?;
        if code == START_OF_SCAN {
            return Some(rest);
        }
    }
}

/// Reads and decodes a room's image: a file below `root`, or the part `FILE@OFFSET+LENGTH` of one.
///
/// # Errors
/// As [`read_image_bytes`]; [`Error::BadImage`] if the image cannot be decoded within
/// [`Bounds::LOCAL`].
pub fn read_image(root: &Path, image: &str) -> Result<RgbImage, Error> {
    let bytes = read_image_bytes(root, image)?;
    decode(
        &root.join(image).display().to_string(),
        &bytes,
        Bounds::LOCAL,
    )
}

/// Reads a room's image without decoding it. `root` and `image` are as in [`read_image`].
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::BadImage`] if the part lies outside the file
/// or the image has more bytes than [`Bounds::LOCAL`].
pub fn read_image_bytes(root: &Path, image: &str) -> Result<Vec<u8>, Error> {
    let ImagePart { path, file, length } = open_part(root, image)?;

    // `decode` checks this too, but only after the bytes were read into memory.
    if length > Bounds::LOCAL.bytes {
        return Err(Error::BadImage {
            image: path.display().to_string(),
            problem: format!(
                "is {length} bytes, over the limit of {}",
                Bounds::LOCAL.bytes
            )
            .into(),
        });
    }

    let mut bytes = Vec::with_capacity(length as usize);
    file.take(length)
        .read_to_end(&mut bytes)
        .map_err(|cause| Error::Io {
            file: path.clone(),
            cause,
        })?;

    Ok(bytes)
}

/// The width and height of a room's image, upright, in pixels, from its header alone.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::BadImage`] if it has no JPEG or PNG header.
pub fn image_size(root: &Path, image: &str) -> Result<(u32, u32), Error> {
    let ImagePart { path, file, length } = open_part(root, image)?;
    let io = |cause| Error::Io {
        file: path.clone(),
        cause,
    };
    let bad = |error: image::ImageError| Error::BadImage {
        image: path.display().to_string(),
        problem: error.into(),
    };

    let mut header = Vec::new();
    file.take(length.min(HEADER_BYTES))
        .read_to_end(&mut header)
        .map_err(io)?;

    let mut reader = ImageReader::new(Cursor::new(header))
        .with_guessed_format()
        .map_err(io)?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(HEADER_ALLOC);
    reader.limits(limits);

    let mut decoder = reader.into_decoder().map_err(bad)?;
    let (width, height) = decoder.dimensions();
    let is_rotated = matches!(
        decoder.orientation(),
        Ok(Orientation::Rotate90
            | Orientation::Rotate270
            | Orientation::Rotate90FlipH
            | Orientation::Rotate270FlipH)
    );
    Ok(if is_rotated {
        (height, width)
    } else {
        (width, height)
    })
}

/// An open file, positioned at the first byte of an image.
struct ImagePart {
    path: PathBuf,
    file: File,
    /// The length of the image, bytes.
    length: u64,
}

fn open_part(root: &Path, image: &str) -> Result<ImagePart, Error> {
    // A name that does not end in `@OFFSET+LENGTH` is the name of a whole file, so that '@' may
    // occur in file names.
    let part = image.rsplit_once('@').and_then(|(file, part)| {
        let (offset, length) = part.split_once('+')?;
        Some((
            file,
            offset.parse::<u64>().ok()?,
            length.parse::<u64>().ok()?,
        ))
    });

    let name = part.map_or(image, |(file, _, _)| file);
    let path = root.join(name);
    let io = |cause| Error::Io {
        file: path.clone(),
        cause,
    };
    let mut file = seese3_files::open_below(root, Path::new(name)).map_err(io)?;
    let mut length = file.metadata().map_err(io)?.len();

    if let Some((_, offset, part_length)) = part {
        if offset.saturating_add(part_length) > length {
            return Err(Error::BadImage {
                image: root.join(image).display().to_string(),
                problem: format!("reaches past the end of the file, which has {length} bytes")
                    .into(),
            });
        }

        file.seek(SeekFrom::Start(offset)).map_err(io)?;
        length = part_length;
    }

    Ok(ImagePart { path, file, length })
}

/// Encodes an image as PNG.
///
/// # Errors
/// [`Error::BadImage`] if the number of its bytes does not fit its width and height.
pub fn encode_png(picture: &RgbImage) -> Result<Vec<u8>, Error> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new(&mut bytes);
    let width = picture.width as u32;
    let height = picture.height as u32;

    encoder
        .write_image(&picture.bytes, width, height, ExtendedColorType::Rgb8)
        .map_err(|error| Error::BadImage {
            image: format!("picture of {width}×{height} pixels"),
            problem: error.into(),
        })?;

    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn png(width: u32, height: u32) -> Vec<u8> {
        let mut bytes = Vec::new();
        let image =
            image::GrayImage::from_fn(width, height, |x, y| image::Luma([(x * 16 + y) as u8]));
        image
            .write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png)
            .unwrap();

        bytes
    }

    /// Oracle: PNG is lossless, so pixels come back as they were written, grey in all three
    /// channels.
    #[test]
    fn a_png_comes_back_and_a_part_of_a_file_is_found() {
        let bytes = png(4, 3);
        let found = decode("a.png", &bytes, Bounds::LOCAL).unwrap();
        assert_eq!(
            (found.width, found.height, found.pixel(3, 2)),
            (4, 3, [50, 50, 50])
        );

        let folder = tempfile::tempdir().unwrap();
        let packed = [b"head".as_slice(), &bytes, b"tail"].concat();
        std::fs::write(folder.path().join("p.bin"), packed).unwrap();
        let image = format!("p.bin@4+{}", bytes.len());

        assert_eq!(read_image(folder.path(), &image).unwrap(), found);
        assert!(read_image(folder.path(), "p.bin@4+99999").is_err());
    }

    /// Oracle: the definition. A photograph of a tiny recording decodes whole and fails under every
    /// cut, with and without a thumbnail (a whole JPEG within the header). A lenient decoder would
    /// accept some cuts.
    #[test]
    fn a_jpeg_that_ends_early_is_refused() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/golden/datasets/scannet/scene0000_00/color");
        let plain = std::fs::read(folder.join("9.jpg")).unwrap();

        let length = (plain.len() as u16 + 2).to_be_bytes();
        let thumbnail = [&[0xff, 0xe1], &length[..], &plain].concat();
        let with_thumbnail = [&plain[..2], &thumbnail, &plain[2..]].concat();

        for whole in [plain, with_thumbnail] {
            let image = decode("9.jpg", &whole, Bounds::LOCAL).unwrap();
            assert_eq!((image.width, image.height), (8, 6));

            for cut in 0..whole.len() {
                assert!(
                    decode("9.jpg", &whole[..cut], Bounds::LOCAL).is_err(),
                    "cut at {cut} of {}",
                    whole.len()
                );
            }
        }
    }

    /// Oracle: EXIF's definition. With orientation 6, the right side of the stored image is the
    /// bottom of the upright one: the image must be rotated clockwise by a quarter turn.
    #[test]
    fn an_image_is_turned_upright() {
        // EXIF in its shortest form: little-endian, one entry: orientation (0x112), one short, 6.
        let exif = [
            &b"II*\0\x08\0\0\0\x01\0"[..],
            &[0x12, 0x01, 3, 0, 1, 0, 0, 0, 6, 0, 0, 0],
            &[0; 4],
        ]
        .concat();

        // The left half is dark, the right one bright.
        let lying = image::RgbImage::from_fn(32, 16, |x, _| {
            image::Rgb([if x < 16 { 20 } else { 230 }; 3])
        });
        let mut jpeg = Vec::new();
        let mut encoder = image::codecs::jpeg::JpegEncoder::new(&mut jpeg);
        encoder.set_exif_metadata(exif.clone()).unwrap();
        lying.write_with_encoder(encoder).unwrap();
        let mut png = Vec::new();
        let mut encoder = PngEncoder::new(&mut png);
        encoder.set_exif_metadata(exif).unwrap();
        lying.write_with_encoder(encoder).unwrap();

        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in [("a.jpg", jpeg), ("a.png", png)] {
            let upright = decode(name, &bytes, Bounds::LOCAL).unwrap();
            assert_eq!((upright.width, upright.height), (16, 32), "{name}");
            assert!(upright.pixel(8, 4)[0] < 60 && upright.pixel(8, 28)[0] > 190);

            std::fs::write(folder.path().join(name), bytes).unwrap();
            assert_eq!(image_size(folder.path(), name).unwrap(), (16, 32));
        }
    }

    /// Oracle: the definition of `Bounds` and of the two formats: an image that is truncated, over
    /// a limit, of another format or empty is refused.
    #[test]
    fn bad_images_are_named() {
        let bytes = png(64, 64);

        let small = Bounds {
            bytes: 10_000,
            pixels: 100,
        };

        for (bytes, bounds) in [
            (&bytes[..bytes.len() / 2], Bounds::LOCAL),
            (&bytes[..], small),
            (
                &bytes[..],
                Bounds {
                    bytes: 10,
                    pixels: 10_000,
                },
            ),
            (&png(16_385, 1), Bounds::LOCAL),
            (b"GIF89a".as_slice(), Bounds::LOCAL),
            (&[], Bounds::LOCAL),
        ] {
            let error = decode("frame 7", bytes, bounds).unwrap_err().to_string();
            assert!(error.starts_with("frame 7: "), "{error}");
        }
    }
}

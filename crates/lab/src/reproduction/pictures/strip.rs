//! Image strips: frames of a recording side by side.

use seese3_core::image::RgbImage;
use seese3_core::room::FrameId;
use seese3_core::training::RoomData;

use super::super::{Error, Images};

/// Width of an image in a strip, pixels.
const WIDTH: usize = 200;

/// Renders frames side by side, as a PNG file.
pub fn strip(access: Images<'_>, data: &RoomData<'_>, frames: &[u32]) -> Result<Vec<u8>, Error> {
    let read = |&frame: &u32| (access.read)(data.room, FrameId(frame)).map_err(Error::Input);
    let images: Vec<RgbImage> = frames
        .iter()
        .map(|frame| Ok(smaller(&read(frame)?)))
        .collect::<Result<_, Error>>()?;

    // The strip has the height of the first image: shorter images are padded with white, taller
    // ones are cropped.
    let height = images[0].height;
    let gap = 4;
    let width = images.len() * (WIDTH + gap) - gap;
    let mut bytes = vec![255; width * height * 3];

    for (position, image) in images.iter().enumerate() {
        for row in 0..height.min(image.height) {
            let at = (row * width + position * (WIDTH + gap)) * 3;
            bytes[at..at + WIDTH * 3]
                .copy_from_slice(&image.bytes[row * WIDTH * 3..(row + 1) * WIDTH * 3]);
        }
    }

    let strip = RgbImage {
        width,
        height,
        bytes,
    };
    (access.png)(&strip).map_err(Error::Input)
}

/// Scales an image to [`WIDTH`]; each pixel is the mean of the source pixels it covers.
fn smaller(image: &RgbImage) -> RgbImage {
    let height = (image.height * WIDTH / image.width).max(1);
    let mut bytes = Vec::with_capacity(WIDTH * height * 3);
    for row in 0..height {
        for column in 0..WIDTH {
            // The range of source pixels covered by a target pixel, at least one.
            let span = |at: usize, of: usize, from: usize| {
                at * from / of..((at + 1) * from / of).max(at * from / of + 1)
            };
            let rows = span(row, height, image.height);

            let columns = span(column, WIDTH, image.width);
            for channel in 0..3 {
                let mut sum = 0usize;
                let mut n = 0usize;
                for y in rows.clone() {
                    for x in columns.clone() {
                        sum += usize::from(image.pixel(x, y)[channel]);
                        n += 1;
                    }
                }

                bytes.push((sum / n.max(1)) as u8);
            }
        }
    }

    RgbImage {
        width: WIDTH,
        height,
        bytes,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: a pixel is the mean of the source pixels it covers.
    #[test]
    fn a_smaller_image_is_the_mean() {
        let bytes = (0..400 * 2)
            .flat_map(|at| [if at % 2 == 0 { 10 } else { 30 }; 3])
            .collect();
        let found = smaller(&RgbImage {
            width: 400,
            height: 2,
            bytes,
        });

        assert_eq!((found.width, found.height), (200, 1));
        assert!(found.bytes.iter().all(|&value| value == 20));
    }
}

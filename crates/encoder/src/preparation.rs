//! Image preparation for a network: resize, crop, normalize.
//!
//! Resizing is an antialiased convolution in 8 bit, as in Pillow; the crop is central. Then each
//! channel is normalized in f32 to (v / divisor − mean) / deviation, with v from 0 to 255.

use fast_image_resize::images::{Image, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use sha2::{Digest, Sha256};
use strum::{Display, EnumString};

use super::Error;
use seese3_core::Cause;
use seese3_core::image::RgbImage;

/// How an image is resized.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resize {
    /// The image keeps its size.
    None,
    /// The whole image is resized to this size; its aspect ratio may change.
    Whole {
        /// Pixels.
        width: usize,
        /// Pixels.
        height: usize,
    },
    /// The shorter edge gets this many pixels, the longer one in proportion, rounded down.
    Shortest(usize),
}

/// The interpolation filter of a resize.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, EnumString)]
#[strum(
    serialize_all = "lowercase",
    parse_err_fn = unknown_filter,
    parse_err_ty = Error
)]
pub enum Filter {
    /// A triangle kernel.
    Bilinear,
    /// A cubic kernel with a = −0.5 (Catmull-Rom).
    Bicubic,
    /// A windowed sinc kernel of three lobes.
    Lanczos3,
}

/// How images are prepared for a network.
#[derive(Debug, Clone, PartialEq)]
pub struct Preparation {
    /// The resize, which is the first step.
    pub resize: Resize,
    /// The filter of the resize.
    pub filter: Filter,
    /// The width and height of the central crop after the resize, if there is one.
    pub crop: Option<(usize, usize)>,
    /// Divisor of the 8-bit values, applied first.
    pub divisor: f32,
    /// Mean that is subtracted next, per channel: red, green, blue.
    pub mean: [f32; 3],
    /// Standard deviation that the values are divided by last, per channel.
    pub deviation: [f32; 3],
}

impl Default for Preparation {
    /// No resize and no crop; values stay as they are, 0 to 255.
    fn default() -> Self {
        Self {
            resize: Resize::None,
            filter: Filter::Bilinear,
            crop: None,
            divisor: 1.0,
            mean: [0.0; 3],
            deviation: [1.0; 3],
        }
    }
}

/// The longest edge that an image may be resized or cropped to, pixels.
const LARGEST: usize = 8_192;

impl Preparation {
    /// The size (width, height) of every prepared image, if it does not depend on the image.
    pub fn size(&self) -> Option<(usize, usize)> {
        match (self.crop, self.resize) {
            (Some(size), _) => Some(size),
            (None, Resize::Whole { width, height }) => Some((width, height)),
            (None, Resize::None | Resize::Shortest(_)) => None,
        }
    }

    /// Resizes and crops an image, in 8 bit.
    ///
    /// # Errors
    /// [`Error::BadImage`] if the image is empty, smaller than the crop, or would be resized to an
    /// image that is longer than 8,192 pixels.
    pub fn pixels(&self, image: RgbImage) -> Result<RgbImage, Error> {
        let (width, height) = match self.resize {
            Resize::None => (image.width, image.height),
            Resize::Whole { width, height } => (width, height),
            Resize::Shortest(edge) if image.width <= image.height => {
                (edge, edge.saturating_mul(image.height) / image.width.max(1))
            }
            Resize::Shortest(edge) => {
                (edge.saturating_mul(image.width) / image.height.max(1), edge)
            }
        };

        // The longer edge of a very thin image can become enormous when the shorter
        // one is scaled up, so the size is checked before memory is allocated.
        if width.max(height) > LARGEST && self.resize != Resize::None {
            return Err(Error::BadImage {
                image: format!("image of {}×{} pixels", image.width, image.height),
                problem: format!(
                    "would be resized to {width}×{height}, over the limit of {LARGEST} a side"
                )
                .into(),
            });
        }

        // An image that has the right size already keeps its exact pixels.
        let resized = if (width, height) == (image.width, image.height) {
            image
        } else {
            resized(&image, width, height, self.filter)?
        };

        match self.crop {
            Some((width, height)) if (width, height) != (resized.width, resized.height) => {
                cropped(&resized, width, height)
            }
            _ => Ok(resized),
        }
    }

    /// The preparation as text, followed by a hash of that text; [`Preparation::parse`] reads it
    /// back. `window` is the number of images in a clip.
    pub fn describe(&self, window: usize) -> String {
        let text = self.text(window);
        format!("{text} sha256={}", digest(&text))
    }

    fn text(&self, window: usize) -> String {
        let resize = match self.resize {
            Resize::None => "none".to_owned(),
            Resize::Whole { width, height } => format!("{width}x{height}"),
            Resize::Shortest(edge) => format!("shortest:{edge}"),
        };

        let crop = self.crop.map_or("none".to_owned(), |(width, height)| {
            format!("{width}x{height}")
        });

        let three = |[r, g, b]: [f32; 3]| format!("{r},{g},{b}");
        format!(
            "resize={resize} filter={} crop={crop} divisor={} mean={} std={} window={window}",
            self.filter,
            self.divisor,
            three(self.mean),
            three(self.deviation)
        )
    }

    /// Reads the text that [`Preparation::describe`] wrote: the preparation, and the number of
    /// images in a clip.
    ///
    /// # Errors
    /// [`Error::Option`] if the text is of another form or was altered.
    pub fn parse(text: &str) -> Result<(Self, usize), Error> {
        let wrong = |problem: &str| Error::Option {
            what: "preprocess",
            given: text.to_owned(),
            problem: problem.into(),
        };

        let mut preparation = Self::default();
        let mut window = None;
        for word in text.split(' ') {
            let (key, value) = word
                .split_once('=')
                .ok_or_else(|| wrong("is not a description of image preparation"))?;
            match key {
                "resize" => preparation.resize = value.parse()?,
                "filter" => preparation.filter = value.parse()?,
                "crop" if value == "none" => preparation.crop = None,
                "crop" => preparation.crop = Some(size("crop", value)?),
                "divisor" => {
                    preparation.divisor = value
                        .parse()
                        .map_err(|_| wrong("has a divisor that is not a number"))?
                }
                "mean" => preparation.mean = three("mean", value)?,
                "std" => preparation.deviation = three("std", value)?,
                "window" => window = value.parse().ok(),
                "sha256" => {}
                _ => return Err(wrong("has an unknown key")),
            }
        }

        let window = window.ok_or_else(|| wrong("has no number of images in a clip (window)"))?;

        // Writing the result again checks the hash. It also refuses a text with a missing key,
        // since all keys are written.
        if preparation.describe(window) != text {
            return Err(wrong("does not match its own hash; it was altered"));
        }

        Ok((preparation, window))
    }

    /// Checks that the numbers can normalize an image.
    ///
    /// # Errors
    /// [`Error::Option`] if a number is not finite, or if the divisor or a deviation is 0.
    pub fn check(&self) -> Result<(), Error> {
        let usable = |value: f32| value.is_finite() && value != 0.0;

        let wrong = |what: &'static str, problem: &str| {
            Err(Error::Option {
                what,
                given: self.text(1),
                problem: problem.into(),
            })
        };

        if !usable(self.divisor) {
            return wrong("divisor", "must be finite and not 0");
        }

        if !self.deviation.iter().all(|&value| usable(value))
            || !self.mean.iter().all(|value| value.is_finite())
        {
            return wrong("mean, std", "must be finite, std not 0");
        }

        Ok(())
    }
}

fn digest(text: &str) -> String {
    Sha256::digest(text)
        .iter()
        .take(8)
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

fn unknown_filter(given: &str) -> Error {
    Error::Option {
        what: "filter",
        given: given.to_owned(),
        problem: "is not bilinear, bicubic or lanczos3".into(),
    }
}

impl std::str::FromStr for Resize {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        if text == "none" {
            return Ok(Self::None);
        }

        if let Some(edge) = text.strip_prefix("shortest:") {
            return match edge.parse() {
                Ok(edge) if (1..=LARGEST).contains(&edge) => Ok(Self::Shortest(edge)),
                _ => Err(Error::Option {
                    what: "resize",
                    given: text.to_owned(),
                    problem: format!("the edge must be 1 to {LARGEST} pixels").into(),
                }),
            };
        }

        let (width, height) = size("resize", text)?;
        Ok(Self::Whole { width, height })
    }
}

/// Reads `WIDTHxHEIGHT`, pixels.
pub(super) fn size(what: &'static str, text: &str) -> Result<(usize, usize), Error> {
    let number = |text: &str| {
        text.parse::<usize>()
            .ok()
            .filter(|edge| (1..=LARGEST).contains(edge))
    };
    let both = text
        .split_once('x')
        .and_then(|(width, height)| Some((number(width)?, number(height)?)));

    both.ok_or_else(|| Error::Option {
        what,
        given: text.to_owned(),
        problem: format!("is not WIDTHxHEIGHT, each 1 to {LARGEST} pixels").into(),
    })
}

/// Reads three numbers separated by commas, or one number for all three.
pub(super) fn three(what: &'static str, text: &str) -> Result<[f32; 3], Error> {
    let numbers: Option<Vec<f32>> = text.split(',').map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[all]) => Ok([all; 3]),
        Some(&[r, g, b]) => Ok([r, g, b]),
        _ => Err(Error::Option {
            what,
            given: text.to_owned(),
            problem: "is not three numbers R,G,B".into(),
        }),
    }
}

pub(super) fn resized(
    image: &RgbImage,
    width: usize,
    height: usize,
    filter: Filter,
) -> Result<RgbImage, Error> {
    let bad = |problem: Cause| Error::BadImage {
        image: format!("image of {}×{} pixels", image.width, image.height),
        problem: format!("cannot be resized to {width}×{height}: {problem}").into(),
    };

    if width * height == 0 || image.width * image.height == 0 {
        return Err(bad("one of the two sizes is 0".into()));
    }

    let from = ImageRef::new(
        image.width as u32,
        image.height as u32,
        &image.bytes,
        PixelType::U8x3,
    )
    .map_err(|error| bad(error.into()))?;

    let mut to = Image::new(width as u32, height as u32, PixelType::U8x3);

    // Catmull-Rom is the cubic kernel with a = −0.5, which Pillow calls bicubic.
    let filter = match filter {
        Filter::Bilinear => FilterType::Bilinear,
        Filter::Bicubic => FilterType::CatmullRom,
        Filter::Lanczos3 => FilterType::Lanczos3,
    };
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
    Resizer::new()
        .resize(&from, &mut to, &options)
        .map_err(|error| bad(error.into()))?;

    Ok(RgbImage {
        width,
        height,
        bytes: to.into_vec(),
    })
}

fn cropped(image: &RgbImage, width: usize, height: usize) -> Result<RgbImage, Error> {
    if image.width < width || image.height < height {
        return Err(Error::BadImage {
            image: format!("image of {}×{} pixels", image.width, image.height),
            problem: format!("is smaller than the crop of {width}×{height}").into(),
        });
    }

    // An odd margin is larger by one pixel on the right and at the bottom.
    let left = (image.width - width) / 2;
    let top = (image.height - height) / 2;
    let line = |row: usize| {
        let from = ((top + row) * image.width + left) * 3;
        &image.bytes[from..from + width * 3]
    };

    Ok(RgbImage {
        width,
        height,
        bytes: (0..height).flat_map(line).copied().collect(),
    })
}

/// Appends the normalized values of an image to `numbers`, plane by plane: red, green, blue.
pub fn normalized(preparation: &Preparation, image: &RgbImage, numbers: &mut Vec<f32>) {
    let Preparation {
        divisor,
        mean,
        deviation,
        ..
    } = preparation;

    for channel in 0..3 {
        let mean = mean[channel];
        let deviation = deviation[channel];

        // An 8-bit channel has only 256 values, so each value is normalized once.
        let table: [f32; 256] =
            std::array::from_fn(|value| (value as f32 / divisor - mean) / deviation);

        numbers.extend(
            image.bytes[channel..]
                .iter()
                .step_by(3)
                .map(|&value| table[usize::from(value)]),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> RgbImage {
        let bytes = (0..width * height)
            .flat_map(|i| [(i % width) as u8, (i / width) as u8, 7])
            .collect();
        RgbImage {
            width,
            height,
            bytes,
        }
    }

    /// Oracle: by hand. 641×480 with its shorter edge at 240 is 320×240 (cut, not rounded); a
    /// center crop of 100×50 begins at ((320 − 100) / 2, (240 − 50) / 2).
    #[test]
    fn sizes_are_cut_and_crops_are_central() {
        let preparation = Preparation {
            resize: Resize::Shortest(240),
            crop: Some((100, 50)),
            ..Preparation::default()
        };
        let found = preparation.pixels(ramp(641, 480)).unwrap();

        assert_eq!((found.width, found.height), (100, 50));

        let uncropped = Preparation {
            crop: None,
            ..preparation
        }
        .pixels(ramp(641, 480))
        .unwrap();

        assert_eq!((uncropped.width, uncropped.height), (320, 240));
        assert_eq!(found.pixel(0, 0), uncropped.pixel(110, 95));

        let tall = Preparation {
            resize: Resize::Shortest(10),
            ..Preparation::default()
        }
        .pixels(ramp(20, 45))
        .unwrap();

        assert_eq!((tall.width, tall.height), (10, 22));
    }

    /// Oracle: the definition. An image of the right size is unchanged; one too small for its crop
    /// is refused.
    #[test]
    fn nothing_is_done_that_need_not_be() {
        let preparation = Preparation {
            resize: "30x20".parse().unwrap(),
            ..Preparation::default()
        };

        assert_eq!(preparation.pixels(ramp(30, 20)).unwrap(), ramp(30, 20));

        let crop = Preparation {
            crop: Some((31, 20)),
            ..Preparation::default()
        };

        assert!(crop.pixels(ramp(30, 20)).is_err());

        let strip = RgbImage {
            width: 1,
            height: 100_000,
            bytes: vec![0; 300_000],
        };

        let shortest = Preparation {
            resize: Resize::Shortest(256),
            crop: Some((224, 224)),
            ..Preparation::default()
        };

        assert!(
            shortest
                .pixels(strip)
                .unwrap_err()
                .to_string()
                .contains("over the limit"),
            "a bomb"
        );

        let empty = RgbImage {
            width: 0,
            height: 0,
            bytes: Vec::new(),
        };

        assert!(preparation.pixels(empty).is_err());
    }

    /// Oracle: the formula by hand, and planes in the order red, green, blue.
    #[test]
    fn channels_are_normalized_each_by_its_own_numbers() {
        let preparation = Preparation {
            divisor: 2.0,
            mean: [1.0, 2.0, 3.0],
            deviation: [1.0, 2.0, 4.0],
            ..Preparation::default()
        };

        let image = RgbImage {
            width: 2,
            height: 1,
            bytes: vec![2, 4, 6, 10, 20, 30],
        };

        let mut numbers = Vec::new();
        normalized(&preparation, &image, &mut numbers);
        assert_eq!(numbers, [0.0, 4.0, 0.0, 4.0, 0.0, 3.0]);
    }

    /// Oracle: what was written is read back, and a changed word no longer matches the hash.
    #[test]
    fn a_description_says_everything_and_cannot_be_altered_unseen() {
        let preparation = Preparation {
            resize: Resize::Shortest(256),
            filter: Filter::Bicubic,
            crop: Some((224, 224)),
            divisor: 255.0,
            mean: [0.485, 0.456, 0.406],
            deviation: [0.229, 0.224, 0.225],
        };

        let text = preparation.describe(16);
        assert_eq!(Preparation::parse(&text).unwrap(), (preparation, 16));
        assert!(Preparation::parse(&text.replace("bicubic", "bilinear")).is_err());

        for wrong in [
            "unspecified",
            "resize=0x5",
            "filter=box",
            "mean=1,2",
            "resize=shortest:99999",
        ] {
            assert!(Preparation::parse(wrong).is_err(), "{wrong}");
        }
    }
}

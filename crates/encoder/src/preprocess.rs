//! Image preparations of the common encoder families, by name.

use strum::{Display, EnumString};

use super::{Error, Filter, Preparation, Resize};

/// A family of encoders with the same image preparation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, EnumString)]
#[strum(serialize_all = "kebab-case")]
pub enum Preprocess {
    /// torchvision and most of timm: ImageNet's mean and deviation, a central crop of 7/8.
    Imagenet,
    /// CLIP, OpenCLIP and their descendants: CLIP's mean and deviation, the central square,
    /// bicubic.
    Clip,
    /// SigLIP, Inception and many Google models: values from -1 to 1, the whole image.
    Half,
    /// Values from 0 to 1, the whole image.
    Unit,
}

/// The image side for a model of unknown input size, pixels.
const USUAL_SIDE: usize = 224;

impl Preprocess {
    /// The preparation for a model with input images of this size (width, height).
    ///
    /// # Errors
    /// [`Error::Option`] if the size is not square, but the family crops a central square.
    pub fn preparation(self, size: Option<(usize, usize)>) -> Result<Preparation, Error> {
        let (width, height) = size.unwrap_or((USUAL_SIDE, USUAL_SIDE));
        let whole = Resize::Whole { width, height };
        let plain = Preparation {
            resize: whole,
            divisor: 255.0,
            ..Preparation::default()
        };

        let is_middle = matches!(self, Self::Imagenet | Self::Clip);
        if is_middle && width != height {
            return Err(Error::Option {
                what: "--preprocess",
                given: self.to_string(),
                problem: format!(
                    "crops the central square of an image, but the model takes {width}x{height}; give \
                     --divisor, --mean, --std and --resize {width}x{height} instead"
                ).into(),
            });
        }

        Ok(match self {
            Self::Unit => plain,
            Self::Half => Preparation {
                mean: [0.5; 3],
                deviation: [0.5; 3],
                ..plain
            },
            Self::Imagenet => Preparation {
                resize: Resize::Shortest((width * 8).div_ceil(7)),
                crop: Some((width, height)),
                mean: [0.485, 0.456, 0.406],
                deviation: [0.229, 0.224, 0.225],
                ..plain
            },
            Self::Clip => Preparation {
                resize: Resize::Shortest(width),
                filter: Filter::Bicubic,
                crop: Some((width, height)),
                mean: [0.481_454_66, 0.457_827_5, 0.408_210_73],
                deviation: [0.268_629_55, 0.261_302_6, 0.275_777_1],
                ..plain
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: torchvision's transforms of ImageNet (resize 256, crop 224) and CLIP's own.
    #[test]
    fn the_usual_sizes_come_out() {
        let of = |family: Preprocess, size| family.preparation(size).unwrap();
        let imagenet = of(Preprocess::Imagenet, Some((224, 224)));
        assert_eq!(imagenet.resize, Resize::Shortest(256));
        assert_eq!(imagenet.crop, Some((224, 224)));
        assert_eq!(of(Preprocess::Imagenet, None), imagenet);

        let clip = of(Preprocess::Clip, Some((336, 336)));
        assert_eq!(clip.resize, Resize::Shortest(336));
        assert_eq!(
            (clip.filter, clip.crop),
            (Filter::Bicubic, Some((336, 336)))
        );

        let half = of(Preprocess::Half, Some((320, 240)));
        let whole = Resize::Whole {
            width: 320,
            height: 240,
        };
        assert_eq!((half.resize, half.crop), (whole, None));
        assert!(Preprocess::Clip.preparation(Some((320, 240))).is_err());
    }
}

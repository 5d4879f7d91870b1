//! Depths of the keypoints of an image, from the depth image of a frame.

use super::super::Error;
use super::super::embedding::ImageKeypoints;
use super::super::image_view::MAX_ASPECT_DIFFERENCE;
use super::configuration::within;
use seese3_client::proto::v1 as pb;
use seese3_encoder::{Bounds, GrayImage16, decode_gray16};
use seese3_robot::visual_odometry::KnownDepth;

/// Default depth of the value 1, meters, and its valid values.
const UNIT_M: f64 = 1e-3;
const UNITS_M: std::ops::RangeInclusive<f64> = 1e-6..=1.0;
/// Default standard deviation of a depth of 1 m, meters, and its valid values.
const DEVIATION_M: f64 = 0.005;
const DEVIATIONS_M: std::ops::RangeInclusive<f64> = 1e-4..=1.0;
/// Maximum relative standard deviation of a depth that is used.
const MAX_DEVIATION: f64 = 0.3;

/// A decoded depth image.
pub struct DepthImage {
    values: GrayImage16,
    unit_m: f64,
    /// Standard deviation of a depth of 1 m, meters.
    deviation_m: f64,
}

impl DepthImage {
    /// Reads the depth image of a frame.
    ///
    /// # Errors
    /// [`Error::Invalid`] on the field, for a file that is no PNG of 16-bit gray values or exceeds
    /// `bounds`, and for a number out of range.
    pub fn of(given: &pb::DepthImage, bounds: Bounds) -> Result<Self, Error> {
        let unit_m = given.unit_m.unwrap_or(UNIT_M);
        let deviation_m = given.deviation_m.unwrap_or(DEVIATION_M);
        let values = decode_gray16("depth", &given.png, bounds).map_err(|error| match error {
            seese3_encoder::Error::BadImage { problem, .. } => Error::invalid("png", problem),
            other => Error::invalid("png", other),
        })?;
        Ok(Self {
            values,
            unit_m: within("unit_m", unit_m, UNITS_M)?,
            deviation_m: within("deviation_m", deviation_m, DEVIATIONS_M)?,
        })
    }

    /// The depths of the keypoints of the image; those of unknown or of uncertain depth are left
    /// out.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `png` if the image has another aspect ratio.
    pub fn of_keypoints(&self, image: &ImageKeypoints) -> Result<Vec<KnownDepth>, Error> {
        let GrayImage16 {
            width,
            height,
            values,
        } = &self.values;
        let [image_width, image_height] = image.size;
        let ratio = (width * image_height) as f64 / (height * image_width) as f64;
        if (ratio - 1.0).abs() > MAX_ASPECT_DIFFERENCE {
            let problem = format!(
                "has {width}×{height} pixels, another aspect ratio than the image with \
                 {image_width}×{image_height}"
            );
            return Err(Error::invalid("png", problem));
        }

        let points = image.keypoints.points().iter().enumerate();
        let depths = points.filter_map(|(keypoint, point)| {
            let column = (point.x * *width as f32) as usize;
            let row = (point.y * *height as f32) as usize;
            let value = *values.get(row.min(height - 1) * width + column.min(width - 1))?;
            let depth_m = f64::from(value) * self.unit_m;
            let deviation = self.deviation_m * depth_m;
            (value > 0 && deviation <= MAX_DEVIATION).then_some(KnownDepth {
                keypoint,
                depth_m,
                deviation,
            })
        });
        Ok(depths.collect())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use image::codecs::png::PngEncoder;
    use image::{ExtendedColorType, ImageEncoder};
    use nalgebra::Vector2;
    use ndarray::Array2;
    use seese3_core::keypoints::Keypoints;
    use seese3_core::ndarray;

    use super::*;

    fn png(width: u32, height: u32, values: &[u16]) -> Vec<u8> {
        let bytes: Vec<u8> = values
            .iter()
            .flat_map(|value| value.to_ne_bytes())
            .collect();
        let mut file = Vec::new();
        PngEncoder::new(&mut file)
            .write_image(&bytes, width, height, ExtendedColorType::L16)
            .unwrap();
        file
    }

    fn image(points: &[[f32; 2]], size: [usize; 2]) -> ImageKeypoints {
        let points: Vec<Vector2<f32>> = points.iter().map(|&[x, y]| Vector2::new(x, y)).collect();
        let descriptors = Array2::ones((points.len(), 4));
        let scores = vec![0.5; points.len()];
        ImageKeypoints {
            keypoints: Keypoints::new(&points, &scores, descriptors.view()),
            size,
        }
    }

    fn given(png: Vec<u8>) -> pb::DepthImage {
        pb::DepthImage {
            png,
            unit_m: Some(0.01),
            deviation_m: Some(0.02),
        }
    }

    const BOUNDS: Bounds = Bounds::LOCAL;

    /// By hand: 4 × 2 pixels; the keypoint at (0.3, 0.6) lies in column 1 of row 1, whose value is
    /// 150.
    #[test]
    fn a_keypoint_has_the_depth_of_its_pixel() {
        let file = png(4, 2, &[0, 10, 20, 30, 40, 150, 60, 65535]);
        let depth = DepthImage::of(&given(file), BOUNDS).unwrap();
        // Of unknown depth, known, and too uncertain: 655.35 m.
        let image = image(&[[0.1, 0.2], [0.3, 0.6], [0.9, 0.9]], [640, 320]);
        let depths = depth.of_keypoints(&image).unwrap();
        let [known] = depths[..] else {
            panic!("{depths:?}")
        };
        assert_eq!(known.keypoint, 1);
        assert!((known.depth_m - 1.5).abs() < 1e-12, "{known:?}");
        assert!((known.deviation - 0.03).abs() < 1e-12, "{known:?}");
    }

    #[test]
    fn what_is_no_depth_image_of_the_image_is_refused() {
        let problem = |given: &pb::DepthImage| match DepthImage::of(given, BOUNDS) {
            Ok(_) => String::new(),
            Err(error) => error.to_string(),
        };
        assert!(problem(&given(b"no image".to_vec())).contains("png: is not a PNG"));
        let wrong_unit = pb::DepthImage {
            unit_m: Some(0.0),
            ..given(png(1, 1, &[1]))
        };
        assert!(problem(&wrong_unit).contains("unit_m"));

        let mut eight_bit = Vec::new();
        PngEncoder::new(&mut eight_bit)
            .write_image(&[1, 2], 2, 1, ExtendedColorType::L8)
            .unwrap();
        assert!(problem(&given(eight_bit)).contains("not 16-bit gray"));

        let square = DepthImage::of(&given(png(2, 2, &[1; 4])), BOUNDS).unwrap();
        let of_wide = square.of_keypoints(&image(&[], [640, 320]));
        assert!(of_wide.unwrap_err().to_string().contains("aspect ratio"));
    }
}

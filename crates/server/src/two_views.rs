//! Estimates the motion between two images from their matched keypoints.

use super::Error;
use super::image_encoder::ImageEncoder;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::keypoints::Keypoints;
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::two_view::{self, MotionEstimate};

/// Maximum relative deviation of an image's aspect ratio from the camera's.
const SHAPE_TOLERANCE: f64 = 0.02;

/// Minimum width and height of an image, pixels. Encoders of keypoints describe a point by its
/// surroundings, some dozens of pixels wide; enlarging a smaller image would only invent them.
const LEAST_SIDE: usize = 32;

/// Estimates the motion between two images of one camera. `encoder` detects keypoints.
///
/// # Errors
/// [`Error::Invalid`] on the field of an image that cannot be decoded, is smaller than
/// [`LEAST_SIDE`], or has another aspect ratio than the camera's images.
pub fn estimate(
    encoder: &ImageEncoder,
    images: [&[u8]; 2],
    camera: &CameraIntrinsics,
    cancel: &Cancellation,
) -> Result<MotionEstimate, Error> {
    let keypoints = |field: &str, image: &[u8]| -> Result<Keypoints, Error> {
        cancel.check()?;
        let image = encoder.decoded(field, image)?;
        let [width, height] = [image.width, image.height];
        if width.min(height) < LEAST_SIDE {
            let problem = format!(
                "is {width}×{height} pixels, too small for keypoints; send at least {LEAST_SIDE} each way"
            );
            return Err(Error::invalid(field, problem));
        }
        let shape = height as f64 / width as f64;
        if (shape / camera.height() - 1.0).abs() > SHAPE_TOLERANCE {
            return Err(Error::invalid(
                field,
                format!(
                    "is {width}×{height}, but the camera's images are {:.3} times as high as wide; \
                     send whole images of this camera",
                    camera.height()
                ),
            ));
        }
        if image.is_blank() {
            return Ok(Keypoints::default());
        }

        let frame = encoder.frame_of(field, image)?;
        Ok(frame.keypoints.unwrap_or_default())
    };
    let first = keypoints("first.image", images[0])?;
    let second = keypoints("second.image", images[1])?;

    cancel.check()?;
    let view = |keypoints| ViewKeypoints { keypoints, camera };
    Ok(two_view::estimate(view(&first), view(&second)))
}

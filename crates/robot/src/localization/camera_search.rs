//! Estimates the focal length of an unknown camera from its views.

use nalgebra::Vector2;

use super::KeypointRoom;
use crate::matched_views::ViewKeypoints;
use seese3_core::geometry::{CameraError, CameraIntrinsics, Distortion, PixelCamera};
use seese3_core::keypoints::Keypoints;

/// Focal lengths that are tried, image widths. Between two of them the fit converges.
const CANDIDATES: [f64; 6] = [0.55, 0.68, 0.84, 1.04, 1.28, 1.58];

/// A camera with square pixels, no distortion, and the principal point in the center. `focal` and
/// `height` are in image widths.
///
/// # Errors
/// As [`CameraIntrinsics::new`].
pub fn simple_camera(focal: f64, height: f64) -> Result<CameraIntrinsics, CameraError> {
    CameraIntrinsics::new(PixelCamera {
        width: 1.0,
        height,
        focal: Vector2::new(focal, focal),
        center: None,
        distortion: Distortion::None,
    })
}

/// The focal length of a view whose camera is unknown, image widths, and the number of keypoints that
/// agree with it. `height` is that of the image, image widths.
///
/// The view is matched at each of six focal lengths. The one with the most inliers is refined by its
/// matches. `None` if too few keypoints agree with any.
pub fn focal_of_view(
    room: &KeypointRoom,
    keypoints: &Keypoints,
    height: f64,
) -> Option<(f64, usize)> {
    let fits = CANDIDATES.into_iter().filter_map(|focal| {
        let camera = simple_camera(focal, height).ok()?;
        room.fitted_focal(ViewKeypoints {
            keypoints,
            camera: &camera,
        })
    });
    fits.max_by_key(|(_, inliers)| *inliers)
}

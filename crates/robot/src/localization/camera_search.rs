//! Estimates the focal length of an unknown camera from its first views.

use nalgebra::Vector2;

use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::median;

use super::KeypointRoom;
use crate::matched_views::ViewKeypoints;

/// Focal lengths that are tried, image widths. Between two of them the fit converges.
pub const FOCAL_CANDIDATES: [f64; 6] = [0.55, 0.68, 0.84, 1.04, 1.28, 1.58];

/// The camera of views whose focal length is unknown: square pixels, no distortion, and the
/// principal point in the center. `height` is that of the images, image widths.
///
/// Each view is matched with every candidate; the one with the most inliers, refined by its
/// matches, is the view's focal length. The result is the median over the views with enough
/// inliers; `None` if there is no such view.
pub fn camera_of_views(
    room: &KeypointRoom,
    views: &[Keypoints],
    height: f64,
) -> Option<CameraIntrinsics> {
    let camera_of = |focal: f64| {
        let camera = PixelCamera {
            width: 1.0,
            height,
            focal: Vector2::new(focal, focal),
            center: None,
            distortion: Distortion::None,
        };
        CameraIntrinsics::new(camera).ok()
    };
    let candidates: Vec<CameraIntrinsics> =
        FOCAL_CANDIDATES.into_iter().filter_map(camera_of).collect();

    let focal = |keypoints: &Keypoints| {
        let fits = candidates
            .iter()
            .filter_map(|camera| room.focal_fit(ViewKeypoints { keypoints, camera }));
        let (focal, _) = fits.max_by_key(|(_, inliers)| *inliers)?;
        Some(focal)
    };
    let focals: Vec<f64> = views.iter().filter_map(focal).collect();
    if focals.is_empty() {
        return None;
    }

    camera_of(median(&focals))
}

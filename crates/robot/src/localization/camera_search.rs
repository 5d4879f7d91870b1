//! Estimates the focal length of an unknown camera from its views.

use nalgebra::Vector2;

use super::{KeypointRoom, LocatedView};
use crate::matched_views::ViewKeypoints;
use seese3_core::geometry::{CameraError, CameraIntrinsics, Distortion, PixelCamera};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::median;

/// Focal lengths that are tried, image widths. Between two of them the fit converges.
const CANDIDATES: [f64; 6] = [0.55, 0.68, 0.84, 1.04, 1.28, 1.58];

/// Number of first views that are tried for an unknown focal length, and the period of later tries
/// in views. A try takes some 100 ms for each room.
const FIRST_TRIES: u32 = 5;
/// Number of views with a focal length after which the camera is known.
const MIN_FOCALS: usize = 3;
/// Maximum number of focal lengths whose median is used.
const MAX_FOCALS: usize = 30;

/// Number of successive views whose matches contradict the estimated focal length before it is
/// estimated again.
const MAX_CONTRADICTIONS: u32 = 3;

/// Relative standard deviation of an estimated focal length: the median over the views of a room
/// differed from the true one by up to 0.5 %, too long or too short.
const FOCAL_DEVIATION: f64 = 0.005;

/// The search for the unknown focal length of a stream's camera: the median over its views.
#[derive(Debug, Clone, Default)]
pub struct FocalSearch {
    /// Focal lengths of views, image widths.
    focals: Vec<f64>,
    /// Number of views that were tried.
    views: u32,
    /// Number of the last views that contradict the estimated focal length.
    contradictions: u32,
}

impl FocalSearch {
    /// The camera, once enough views have a focal length. Until then, the view is tried at several
    /// ones. `height` is that of the image, image widths.
    pub fn camera<'a>(
        &mut self,
        keypoints: &Keypoints,
        height: f64,
        rooms: impl Iterator<Item = &'a KeypointRoom>,
    ) -> Option<CameraIntrinsics> {
        if self.focals.len() < MIN_FOCALS && !keypoints.is_empty() {
            self.views = self.views.saturating_add(1);
            if self.views > FIRST_TRIES && !self.views.is_multiple_of(FIRST_TRIES) {
                return None;
            }
            let fits = rooms.filter_map(|room| focal_of_view(room, keypoints, height));
            let (focal, _) = fits.max_by_key(|(_, inliers)| *inliers)?;
            self.focals.push(focal);
        }

        let is_known = self.focals.len() >= MIN_FOCALS;
        is_known.then(|| simple_camera(median(&self.focals), height).ok())?
    }

    /// Adds the focal length that fits a located view best, and returns the view with the
    /// uncertainty of the estimated one. `camera` is the one that it was located with.
    #[must_use]
    pub fn with_focal_of(
        &mut self,
        camera: &CameraIntrinsics,
        mut located: LocatedView,
    ) -> LocatedView {
        self.contradictions = 0;
        if let Some(fit) = located.matched.focal
            && self.focals.len() < MAX_FOCALS
        {
            self.focals.push(camera.focal().x * fit.factor);
        }

        // A wrong focal length moves the camera along its axis, by the same share of the depth.
        let along_axis_m = FOCAL_DEVIATION * located.matched.information.unit_m;
        located.pose.covariance[(2, 2)] += along_axis_m * along_axis_m;
        located
    }

    /// Notes a view whose matches contradict the estimated focal length. After several in
    /// succession the search begins again.
    pub fn contradict(&mut self) {
        self.contradictions += 1;
        if self.contradictions >= MAX_CONTRADICTIONS {
            *self = Self::default();
        }
    }
}

/// A camera with square pixels, no distortion, and the principal point in the center. `focal` and
/// `height` are in image widths.
///
/// # Errors
/// As [`CameraIntrinsics::new`].
fn simple_camera(focal: f64, height: f64) -> Result<CameraIntrinsics, CameraError> {
    CameraIntrinsics::new(PixelCamera {
        width: 1.0,
        height,
        focal: Vector2::new(focal, focal),
        center: None,
        distortion: Distortion::None,
    })
}

/// The focal length of a view whose camera is unknown, image widths, and the number of keypoints
/// that agree with it. `height` is that of the image, image widths.
///
/// The view is matched at each of six focal lengths. The one with the most inliers is refined by
/// its matches. `None` if too few keypoints agree with any.
fn focal_of_view(room: &KeypointRoom, keypoints: &Keypoints, height: f64) -> Option<(f64, usize)> {
    let fits = CANDIDATES.into_iter().filter_map(|focal| {
        let camera = simple_camera(focal, height).ok()?;
        room.fitted_focal(ViewKeypoints {
            keypoints,
            camera: &camera,
        })
    });
    fits.max_by_key(|(_, inliers)| *inliers)
}

//! Focal length and radial distortion, fitted to the epipolar errors of a room's images.

use nalgebra::Vector2;

use super::SceneEstimate;
use crate::point_matches::{CornerImage, PairGeometry, match_points};
use seese3_core::epipolar::{self, EpipolarPairs};
use seese3_core::geometry::{CameraError, CameraIntrinsics, Distortion, PixelCamera, Pose};
use seese3_core::image::RgbImage;

/// Maximum number of frames that are matched, evenly spaced.
const FRAMES: usize = 100;
/// Largest distance of matches from their epipolar lines, pixels of an image 320 wide: of the first
/// matches, with the stated camera, and of the final ones, with the camera fitted to the first.
const GATES_PX: [f64; 2] = [24.0, 12.0];
/// Largest standard deviation of the logarithm of a focal length that the motion determines.
const DETERMINED: f64 = 0.05;
/// Minimum relative difference between the fitted and the stated focal length that contradicts the
/// stated camera. Inexact poses bias the fit by less.
const CONTRADICTS: f64 = 0.03;
/// The same difference in standard deviations.
const CONTRADICTS_DEVIATIONS: f64 = 4.0;
/// Minimum relative decrease of the median epipolar error that contradicts the stated camera.
const FITS_BETTER_BY: f64 = 0.1;

/// Why no camera can be fitted.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum CameraFitError {
    #[error("the camera moves too little; the images must differ by translations")]
    NoTranslation,
    #[error("the focal length cannot be estimated: {0}")]
    NoCamera(#[from] CameraError),
    #[error(transparent)]
    Matches(#[from] epipolar::Error),
}

/// A camera fitted to matches between images with known poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedCamera {
    /// The fitted focal length and first radial coefficient; the rest as stated, or an ideal
    /// pinhole.
    pub camera: CameraIntrinsics,
    /// Width and height of the images, pixels.
    pub image_size: (u32, u32),
    /// Standard deviation of the focal length, as a share of it.
    pub focal_deviation: f64,
    /// Median epipolar error with the fitted camera, pixels of an image 320 wide.
    pub median_px: f64,
    /// Median epipolar error with the stated camera, pixels of an image 320 wide; `None` if no
    /// camera is stated.
    pub stated_median_px: Option<f64>,
    /// Number of matches.
    pub matches: usize,
}

/// Images and poses to which a camera is fitted.
pub(super) struct CameraEvidence<'a> {
    /// `world_from_camera` of every usable frame.
    pub poses: &'a [Pose],
    /// Decodes the image of a usable frame.
    pub read: &'a dyn Fn(usize) -> Option<RgbImage>,
    /// Width and height of the images, pixels. Other images are skipped.
    pub image_size: (u32, u32),
    /// Focal length and depth as fitted to the images' motion.
    pub seen: SceneEstimate,
    /// The camera that the room states.
    pub stated: Option<CameraIntrinsics>,
}

impl FittedCamera {
    /// Mean focal length, pixels of the images.
    pub fn focal_px(&self) -> f64 {
        self.camera.focal().mean() * f64::from(self.image_size.0)
    }

    /// First radial coefficient.
    pub fn k1(&self) -> f64 {
        let coefficients = self.camera.distortion();
        coefficients.coefficients().first().copied().unwrap_or(0.0)
    }

    /// Whether the camera's motion determines the focal length.
    pub fn is_determined(&self) -> bool {
        self.focal_deviation <= DETERMINED
    }

    /// Whether the fit contradicts the stated camera: the focal length differs clearly and
    /// significantly, and the epipolar errors become smaller.
    pub fn contradicts(&self, stated: &CameraIntrinsics) -> bool {
        let difference = (self.camera.focal().mean() / stated.focal().mean())
            .ln()
            .abs();
        let is_better = self
            .stated_median_px
            .is_some_and(|stated_px| self.median_px < (1.0 - FITS_BETTER_BY) * stated_px);
        self.is_determined()
            && difference > CONTRADICTS
            && difference > CONTRADICTS_DEVIATIONS * self.focal_deviation
            && is_better
    }
}

impl CameraEvidence<'_> {
    /// Fits the camera.
    ///
    /// # Errors
    /// [`CameraFitError`] without translations, without an estimate of the focal length, or with
    /// too few matches.
    pub fn fit(&self) -> Result<FittedCamera, CameraFitError> {
        let depth_m = self.seen.depth.ok_or(CameraFitError::NoTranslation)?;
        let start = match self.stated {
            Some(stated) => stated,
            None => self.estimated_camera()?,
        };

        let every = self.poses.len().div_ceil(FRAMES).max(1);
        let rows: Vec<usize> = (0..self.poses.len()).step_by(every).collect();
        let poses: Vec<Pose> = rows.iter().map(|&row| self.poses[row]).collect();
        let images: Vec<Option<CornerImage>> = rows.iter().map(|&row| self.corners(row)).collect();
        let matched = |camera: &CameraIntrinsics, gate_px: f64| {
            EpipolarPairs::of(&poses, depth_m, |first, second| {
                let geometry = PairGeometry {
                    camera,
                    second_from_first: poses[second].inv_mul(&poses[first]),
                    gate_px,
                };
                match (&images[first], &images[second]) {
                    (Some(first), Some(second)) => match_points(first, second, &geometry),
                    _ => Vec::new(),
                }
            })
        };

        // Matches near the epipolar lines of a wrong camera favor it, so points are matched again
        // with the fitted camera.
        let [wide_px, narrow_px] = GATES_PX;
        let rough = matched(&start, wide_px).fit(&start)?;
        let fit = matched(&rough.camera, narrow_px).fit(&start)?;
        Ok(FittedCamera {
            camera: fit.camera,
            image_size: self.image_size,
            focal_deviation: fit.log_focal_deviation,
            median_px: fit.median_px,
            stated_median_px: self.stated.map(|_| fit.stated_median_px),
            matches: fit.matches,
        })
    }

    fn corners(&self, row: usize) -> Option<CornerImage> {
        let image = (self.read)(row)?;
        let size = (image.width as u32, image.height as u32);
        (size == self.image_size)
            .then(|| CornerImage::of(&image))
            .flatten()
    }

    /// An ideal pinhole with the focal length that was fitted to the images' motion.
    fn estimated_camera(&self) -> Result<CameraIntrinsics, CameraError> {
        let (width, height) = self.image_size;
        let width = f64::from(width);
        CameraIntrinsics::new(PixelCamera {
            width,
            height: f64::from(height),
            focal: Vector2::repeat(self.seen.focal * width),
            center: None,
            distortion: Distortion::None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u32, u32) = (640, 480);

    fn camera(focal_px: f64) -> CameraIntrinsics {
        CameraIntrinsics::new(PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: Vector2::repeat(focal_px),
            center: None,
            distortion: Distortion::None,
        })
        .unwrap()
    }

    /// Oracle: by hand: more than 3 %, four deviations and a tenth of the error are needed.
    #[test]
    fn only_a_clear_and_significant_difference_contradicts() {
        let contradicts = |focal_px: f64, focal_deviation: f64, median_px: f64| {
            let fitted = FittedCamera {
                camera: camera(focal_px),
                image_size: SIZE,
                focal_deviation,
                median_px,
                stated_median_px: Some(2.0),
                matches: 1_000,
            };
            fitted.contradicts(&camera(500.0))
        };
        assert!(contradicts(520.0, 0.005, 1.7));
        assert!(contradicts(480.0, 0.005, 1.7));
        assert!(!contradicts(512.0, 0.005, 1.7));
        assert!(!contradicts(520.0, 0.01, 1.7));
        assert!(!contradicts(520.0, 0.005, 1.9));
        assert!(!contradicts(700.0, 0.06, 1.0));
    }

    /// Oracle: the definition: there is no evidence without translation, without any focal length,
    /// and without images.
    #[test]
    fn missing_evidence_is_reported() {
        let poses: Vec<Pose> = (0..20)
            .map(|row| Pose::translation(0.1 * f64::from(row), 0.0, 0.0))
            .collect();
        let error = |focal: f64, depth: Option<f64>| {
            let evidence = CameraEvidence {
                poses: &poses,
                read: &|_| None,
                image_size: SIZE,
                seen: SceneEstimate { focal, depth },
                stated: None,
            };
            evidence.fit().unwrap_err()
        };
        assert_eq!(error(0.8, None), CameraFitError::NoTranslation);
        assert!(matches!(
            error(0.0, Some(2.0)),
            CameraFitError::NoCamera(CameraError::Focal { .. })
        ));
        let no_match = epipolar::Error::TooFewMatches { matches: 0 };
        assert_eq!(error(0.8, Some(2.0)), CameraFitError::Matches(no_match));
    }
}

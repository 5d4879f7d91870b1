//! Parameters of matched views. `seese3 evaluate localization` measures what they do.

#[cfg(doc)]
use seese3_core::epipolar::PIXEL_IMAGE_WIDTH;

/// Parameters of mapping: the triangulation of a frame's keypoints from neighboring frames.
///
/// One *unit* is the median depth of a map's keypoints. Pixels are those of an image that is
/// [`PIXEL_IMAGE_WIDTH`] pixels wide.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MappingParameters {
    /// Maximum number of keypoints that are stored for a frame.
    pub max_keypoints: usize,
    /// Number of keypoints with the highest scores that are matched.
    pub candidates: usize,
    /// Maximum number of neighboring frames.
    pub neighbors: usize,
    /// Minimum and maximum distance to a neighboring frame, units.
    pub baseline_range: [f64; 2],
    /// Distance to a neighboring frame that is preferred, units.
    pub ideal_baseline: f64,
    /// Maximum angle between the optical axes of neighboring frames, radians.
    pub max_angle_rad: f64,
    /// Angle between optical axes that counts as much as a factor e in the baseline, radians.
    pub angle_scale_rad: f64,
    /// Maximum distance of a match from its epipolar line, pixels.
    pub epipolar_gate_px: f64,
    /// Minimum cosine of the descriptors of a match.
    pub min_cosine: f32,
    /// Maximum relative standard deviation of an inverse depth, at a deviation of 1 pixel.
    pub max_deviation: f64,
}

impl Default for MappingParameters {
    fn default() -> Self {
        Self {
            max_keypoints: 300,
            candidates: 500,
            neighbors: 10,
            baseline_range: [0.03, 0.5],
            ideal_baseline: 0.15,
            max_angle_rad: 40_f64.to_radians(),
            angle_scale_rad: 25_f64.to_radians(),
            epipolar_gate_px: 3.0,
            min_cosine: 0.7,
            max_deviation: 0.2,
        }
    }
}

/// Parameters of the pose estimate of a view from its matches. Pixels are those of an image that is
/// [`PIXEL_IMAGE_WIDTH`] pixels wide.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchingParameters {
    /// Number of retrieved frames that are matched first.
    pub first_frames: usize,
    /// Number of retrieved frames that are matched if the first give fewer inliers than
    /// `confident_inliers`.
    pub more_frames: usize,
    /// Number of keypoints of the view that are matched.
    pub candidates: usize,
    /// Minimum cosine of compressed descriptors.
    pub min_cosine: f32,
    /// Largest reprojection error of an inlier, in median epipolar errors of the map.
    pub threshold_ratio: f64,
    /// Minimum and maximum of that error, pixels.
    pub threshold_range_px: [f64; 2],
    /// Minimum and maximum number of RANSAC iterations.
    pub iterations: [usize; 2],
    /// Probability that RANSAC stops without an all-inlier sample.
    pub miss_probability: f64,
    /// Standard deviation of a keypoint's position, pixels.
    pub deviation_px: f64,
    /// Number of unique inliers from which no further frames are matched.
    pub confident_inliers: usize,
    /// Minimum number of unique inliers of an accepted pose.
    pub min_inliers: usize,
    /// Minimum number of unique inliers of an accepted pose times their spread, which is the
    /// product of the standard deviations of their positions along both axes, fractions of the
    /// image's width and height. A hundred inliers over the whole image have 8.
    pub min_support: f64,
    /// Largest standard deviation of an accepted position, units (median depths of the map).
    pub max_position_deviation: f64,
    /// Largest standard deviation of an accepted rotation, radians.
    pub max_rotation_deviation_rad: f64,
    /// Smallest difference between the logarithms of the fitted and the stated focal length that
    /// contradicts the stated one. Fitted focal lengths vary by up to 3 % far from the mapped
    /// frames.
    pub min_log_focal: f64,
    /// The same, in standard deviations for independent errors of the matches.
    pub min_focal_deviations: f64,
}

impl MatchingParameters {
    /// Largest reprojection error of an inlier in a map with this median epipolar error, pixels.
    pub(super) fn threshold_px(&self, epipolar_px: f64) -> f64 {
        let [least, most] = self.threshold_range_px;
        (self.threshold_ratio * epipolar_px).clamp(least, most)
    }
}

impl Default for MatchingParameters {
    fn default() -> Self {
        Self {
            first_frames: 3,
            more_frames: 10,
            candidates: 600,
            min_cosine: 0.5,
            threshold_ratio: 3.0,
            threshold_range_px: [2.0, 4.0],
            iterations: [100, 1_000],
            miss_probability: 1e-4,
            deviation_px: 0.7,
            confident_inliers: 150,
            min_inliers: 90,
            min_support: 4.3,
            max_position_deviation: 0.075,
            max_rotation_deviation_rad: 4.5_f64.to_radians(),
            min_log_focal: 0.05,
            min_focal_deviations: 8.0,
        }
    }
}

//! Parameters of visual odometry.

#[cfg(doc)]
use seese3_core::epipolar::PIXEL_IMAGE_WIDTH;

/// Parameters of visual odometry. `seese3 evaluate odometry` measures what they do. Pixels are
/// those of an image that is [`PIXEL_IMAGE_WIDTH`] pixels wide.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryParameters {
    /// Number of keypoints with the highest scores that are matched.
    pub candidates: usize,
    /// Number of keyframes near the predicted pose whose landmarks are matched. It is doubled,
    /// without a limit on the distance, if they give too few inliers.
    pub near_keyframes: usize,
    /// Largest distance of a match from its predicted position, pixels.
    pub search_radius_px: f64,
    /// Minimum cosine of the descriptors of a match.
    pub min_cosine: f32,
    /// Largest reprojection error of an inlier, pixels.
    pub threshold_px: f64,
    /// Standard deviation of a keypoint's position along one axis, pixels.
    pub deviation_px: f64,
    /// Minimum and maximum number of RANSAC iterations.
    pub iterations: [usize; 2],
    /// Minimum number of inliers of a tracked frame.
    pub min_inliers: usize,
    /// Median parallax since the last keyframe that makes a keyframe, pixels.
    pub keyframe_parallax_px: f64,
    /// Rotation since the last keyframe that makes a keyframe, radians.
    pub keyframe_angle_rad: f64,
    /// Number of inliers, as a share of the keypoints, below which a frame becomes a keyframe.
    pub keyframe_share: f64,
    /// Number of the newest keyframes that an adjustment moves.
    pub window: usize,
    /// Maximum number of keyframes of the local map.
    pub max_keyframes: usize,
    /// Levenberg–Marquardt steps of an adjustment.
    pub adjustment_steps: usize,
    /// Relative standard deviation of the inverse depth of a new landmark: in an adjustment of
    /// keyframes, and in the pose of a frame.
    pub depth_deviations: [f64; 2],
    /// Relative standard deviation below which a landmark's inverse depth counts as known.
    pub known_depth_deviation: f64,
    /// Minimum number of matched landmarks of known depth for a pose that is estimated from them
    /// alone.
    pub min_known_landmarks: usize,
    /// Smallest parallax of a landmark of unknown depth that an adjustment uses, pixels.
    pub min_parallax_px: f64,
    /// Number of frames in succession without a pose after which the local map begins anew.
    pub max_lost_frames: u32,
    /// Relative standard deviation of the scale: without any known depth, of one frame's known
    /// depths, and its growth over one keyframe without them.
    pub scale_deviations: ScaleDeviations,
    /// Minimum number of landmarks with known depths that determine the scale.
    pub min_known_depths: usize,
}

/// Relative standard deviations of the scale of a local map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScaleDeviations {
    /// By the usual depth of rooms alone.
    pub usual: f64,
    /// Of the scale that the known depths of one frame give.
    pub of_frame: f64,
    /// Growth over one keyframe.
    pub of_keyframe: f64,
}

impl Default for OdometryParameters {
    fn default() -> Self {
        Self {
            candidates: 600,
            near_keyframes: 5,
            search_radius_px: 32.0,
            min_cosine: 0.7,
            threshold_px: 3.0,
            deviation_px: 0.7,
            iterations: [50, 500],
            min_inliers: 30,
            keyframe_parallax_px: 12.0,
            keyframe_angle_rad: 8_f64.to_radians(),
            keyframe_share: 0.35,
            window: 6,
            max_keyframes: 30,
            adjustment_steps: 6,
            depth_deviations: [1.0, 0.35],
            known_depth_deviation: 0.3,
            min_known_landmarks: 60,
            min_parallax_px: 4.0,
            max_lost_frames: 10,
            scale_deviations: ScaleDeviations {
                usual: 0.3,
                of_frame: 0.03,
                of_keyframe: 0.02,
            },
            min_known_depths: 20,
        }
    }
}

//! Relative pose of two views in a room without a map, from their matched keypoints.
//!
//! - A match pairs the direction b in the first image with the point u of the second. Under the
//!   motion (R, t), a point at inverse depth ρ has the direction Rᵀ(b − ρt) in the second camera.
//! - Each ρ is unknown. Its logarithm has a prior with a mean that depends on the image position:
//!   in rooms, the edges of an image are nearer than its center. Only this prior determines the
//!   length of the translation in meters.
//! - The motion is found by Levenberg–Marquardt steps with every ρ eliminated. Student-t weights
//!   downweight wrong matches.
//!
//! If the images constrain the translation poorly, it is shrunk towards zero and the covariance
//! grows. `docs/two-views.md` describes how the parameters were chosen.

mod seen;
mod solver;

use nalgebra::{Matrix6, Vector2, Vector3};

use crate::matched_views::{ViewKeypoints, matched_keypoints, pixel_focal, plane_points};
use seen::Matches;
pub(crate) use seen::usual_log_inverse_depth;
use seese3_core::geometry::{Pose, Twist, log, twist_covariance};

/// Number of keypoints of each view that are matched.
const CANDIDATES: usize = 600;

/// Minimum cosine of the descriptors of a match.
const MIN_COSINE: f32 = 0.7;

/// Standard deviation of a keypoint's position along one axis, pixels of an image that is 320
/// pixels wide.
const DEVIATION_PX: f64 = 0.7;

/// Minimum sum of the match weights. Below it the matches are too few or contradict each other.
const MIN_SUPPORT: f64 = 40.0;

/// Standard deviation of each component if no motion was estimated, meters and radians.
const UNREAD_DEVIATION: f64 = 0.3;

/// Estimated motion between two views.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionEstimate {
    /// Pose of the second camera in the frame of the first, meters.
    pub motion: Pose,
    /// Covariance of ξ in true = motion · exp(ξ), ordered (v, ω), meters and radians.
    pub covariance: Matrix6<f64>,
    /// Whether a motion was estimated. If not, `motion` is the identity with a wide covariance.
    pub is_estimated: bool,
    /// Number of matches.
    pub match_count: usize,
    /// Effective number of inlier matches: the sum of their weights, 0 to 1 each.
    pub support: f64,
}

impl MotionEstimate {
    /// The covariance of the six numbers of [`MotionEstimate::twist`], (v, ω).
    pub fn twist_covariance(&self) -> Matrix6<f64> {
        twist_covariance(&self.twist(), &self.covariance)
    }

    /// The motion as a twist in the body frame of the first camera.
    pub fn twist(&self) -> Twist {
        log(&self.motion)
    }

    fn none(match_count: usize, support: f64) -> Self {
        Self {
            motion: Pose::identity(),
            covariance: Matrix6::identity() * UNREAD_DEVIATION.powi(2),
            is_estimated: false,
            match_count,
            support,
        }
    }
}

/// One point matched between both images.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Match {
    /// Direction in the first camera, scaled to depth 1.
    direction: Vector3<f64>,
    /// Point in the second image, in normalized coordinates (plane at distance 1).
    point: Vector2<f64>,
    /// Standard deviation of `point`, in normalized coordinates.
    deviation: f64,
}

/// Estimates the motion from the first view to the second.
pub fn estimate(first: ViewKeypoints<'_>, second: ViewKeypoints<'_>) -> MotionEstimate {
    let plane = |view: ViewKeypoints<'_>| plane_points(view.keypoints, view.camera, CANDIDATES);
    let planes = [plane(first), plane(second)];
    let deviation = DEVIATION_PX / pixel_focal(second.camera);
    let pairs = matched_keypoints(first.keypoints, second.keypoints, CANDIDATES, MIN_COSINE);
    let matches: Vec<Match> = pairs
        .into_iter()
        .map(|(from, to)| Match {
            direction: planes[0][from].push(1.0),
            point: planes[1][to],
            deviation,
        })
        .collect();
    by_matches(&matches)
}

/// Fits the motion to matches.
fn by_matches(matches: &[Match]) -> MotionEstimate {
    if (matches.len() as f64) < MIN_SUPPORT {
        return MotionEstimate::none(matches.len(), 0.0);
    }

    let blocks = Matches::new(matches);
    let found = solver::solve(matches, &blocks);
    let support = found.support();
    if support < MIN_SUPPORT {
        return MotionEstimate::none(matches.len(), support);
    }

    let Some((motion, covariance)) = found.shrunk_with_covariance() else {
        return MotionEstimate::none(matches.len(), support);
    };

    MotionEstimate {
        motion,
        covariance,
        is_estimated: true,
        match_count: matches.len(),
        support,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::geometry::exp;

    /// 400 matches under a known motion, at depths of 1.2 to 3.2 m. `noise` is added on the image
    /// plane; every seventh match is an outlier if `is_wrong`.
    fn matches(motion: &Twist, noise: f64, is_wrong: bool) -> Vec<Match> {
        let motion = exp(motion);
        (0..400)
            .map(|number| {
                let i = f64::from(number);
                let part = |step: f64| (i * step).fract();
                let direction = Vector3::new(
                    0.9 * part(0.618_034) - 0.45,
                    0.7 * part(0.414_214) - 0.35,
                    1.0,
                );
                let depth = 1.2 + 2.0 * part(0.732_051);
                let seen = motion.inverse_transform_point(&(direction * depth).into());

                let shaken = Vector2::new((12.9898 * i).sin(), (78.233 * i).sin());
                let point = if is_wrong && number % 7 == 3 {
                    Vector2::new(0.4 * (3.1 * i).sin(), 0.3 * (5.7 * i).cos())
                } else {
                    seen.coords.xy() / seen.z + noise * shaken
                };

                Match {
                    direction,
                    point,
                    deviation: 0.0015 + 0.002 * part(0.236_068),
                }
            })
            .collect()
    }

    fn known_motion() -> Twist {
        let rotation = nalgebra::Rotation3::new(Vector3::new(0.03, -0.12, 0.02));
        log(&Pose::from_parts(
            Vector3::new(0.10, -0.03, 0.15).into(),
            nalgebra::UnitQuaternion::from_rotation_matrix(&rotation),
        ))
    }

    /// Oracle: the same algorithm in NumPy, written independently, on the same matches.
    #[test]
    fn noisy_matches_give_what_numpy_gives() {
        let reading = by_matches(&matches(&known_motion(), 0.002, true));
        let translation = Vector3::new(0.077_276_241, -0.022_813_003, 0.133_013_771);
        let rotation = Vector3::new(0.032_410_68, -0.113_034_518, 0.019_965_845);

        assert!(reading.is_estimated);
        assert!(
            (reading.support - 260.665_662_2).abs() < 1e-3,
            "{}",
            reading.support
        );
        assert!((reading.motion.translation.vector - translation).norm() < 1e-6);
        assert!((reading.motion.rotation.scaled_axis() - rotation).norm() < 1e-6);

        let variances = [
            2.324_493_6e-3,
            5.534_647e-4,
            2.899_026_1e-3,
            1.154_29e-4,
            2.016_58e-4,
            1.138_505e-4,
        ];
        for (row, expected) in variances.into_iter().enumerate() {
            let found = reading.covariance[(row, row)];
            assert!((found / expected - 1.0).abs() < 1e-4, "{row}: {found}");
        }
        assert!((reading.covariance[(0, 2)] - 1.879_037e-3).abs() < 1e-7);
    }

    /// Oracle: the motion that generated the matches. The images determine the rotation and the
    /// direction of the translation. Only the depth prior determines the length.
    #[test]
    fn rotation_and_direction_come_from_the_images() {
        let truth = exp(&known_motion());
        let reading = by_matches(&matches(&known_motion(), 0.0, true));
        let apart = reading.motion.rotation.angle_to(&truth.rotation);
        let direction = reading
            .motion
            .translation
            .vector
            .angle(&truth.translation.vector);
        let length = reading.motion.translation.vector.norm() / truth.translation.vector.norm();

        assert!(apart.to_degrees() < 0.5, "{}°", apart.to_degrees());
        assert!(direction.to_degrees() < 8.0, "{}°", direction.to_degrees());
        assert!((0.5..1.5).contains(&length), "{length}");
    }

    /// Oracle: the definition of a rotation: all directions rotate equally at any depth, and the
    /// translation is zero.
    #[test]
    fn a_turn_on_the_spot_is_no_translation() {
        let turn = Twist {
            linear: [0.0; 3].into(),
            angular: [0.02, 0.15, -0.04].into(),
        };
        let reading = by_matches(&matches(&turn, 0.0, false));
        let apart = reading.motion.rotation.angle_to(&exp(&turn).rotation);

        assert!(apart.to_degrees() < 0.05, "{}°", apart.to_degrees());
        assert!(reading.motion.translation.vector.norm() < 0.005);
    }

    /// Oracle: the definition: matches of infinite deviation say nothing. 393 matches do not fill the last block.
    #[test]
    fn places_without_a_match_have_no_influence() {
        let all = matches(&known_motion(), 0.002, true);
        let mut silent = all.clone();
        for match_ in &mut silent[393..] {
            match_.deviation = f64::INFINITY;
        }
        let [few, silent] = [&all[..393], &silent[..]].map(by_matches);
        assert!(few.is_estimated);
        let apart = few.motion.inv_mul(&silent.motion);
        assert!(apart.translation.vector.norm() < 1e-12 && apart.rotation.angle() < 1e-9);
        assert!((few.covariance - silent.covariance).norm() < 1e-12);
        // A match that fits anything has the weight 1.
        assert!((silent.support - few.support - 7.0).abs() < 1e-9);
    }

    /// Oracle: the definition. Points of the second image without any relation to the first have no
    /// motion in common.
    #[test]
    fn unrelated_points_give_no_estimate() {
        let still = matches(&Twist::default(), 0.0, false);
        let estimate = by_matches(&still);
        assert!(estimate.is_estimated && estimate.twist().norm() < 0.02);

        let unrelated: Vec<Match> = still
            .iter()
            .enumerate()
            .map(|(number, match_)| Match {
                point: still[(number * 173 + 31) % still.len()].point,
                ..*match_
            })
            .collect();
        let estimate = by_matches(&unrelated);
        assert!(!estimate.is_estimated, "support {}", estimate.support);
        assert_eq!(estimate.motion, Pose::identity());
        assert_eq!(estimate.covariance[(0, 0)], 0.09);
        assert!(!by_matches(&still[..10]).is_estimated);
    }
}

//! Relative pose of two views in a room without a map, estimated from matched image cells.
//!
//! The paper predicts a motion from two pooled features, which lose most of the image positions.
//! Here the cells of two unpooled feature maps are matched (`matching`), and the most probable
//! motion is fitted to the matches (`solver`):
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

mod matching;
mod solver;

use nalgebra::{Matrix6, Vector2, Vector3};
use ndarray::ArrayView3;

use seese3_core::geometry::{CameraIntrinsics, Pose, Twist, log};

/// Why two feature maps are rejected.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(
        "the feature maps are {first:?} and {second:?} (channels, rows, columns); both must be of one \
         encoder, with at least {LEAST_CELLS} rows and columns"
    )]
    Shape {
        first: [usize; 3],
        second: [usize; 3],
    },
}

/// Minimum number of rows and of columns of a feature map.
const LEAST_CELLS: usize = 8;

/// Minimum number of sharp matches, as a fraction of the map's cells. Images without texture match
/// only by the border artifacts of the map, which do not move with the camera.
const LEAST_SHARP: f64 = 1.0 / 12.0;

/// Minimum sum of the match weights, as a fraction of the map's cells. Below it the matches are too
/// few or contradict each other.
const LEAST_SUPPORT: f64 = 160.0 / 1_200.0;

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
    /// Number of matched cells.
    pub match_count: usize,
    /// Effective number of inlier matches: the sum of their weights, 0 to 1 each.
    pub support: f64,
}

impl MotionEstimate {
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
    /// Whether the deviation is at most twice the usual one.
    is_sharp: bool,
}

/// Estimates the motion between two views of one camera from their feature maps, shape (channels,
/// rows, columns). The cells must cover the whole image.
///
/// # Errors
/// [`Error::Shape`] if the maps differ in shape or are too small.
pub fn read(
    first: ArrayView3<'_, f32>,
    second: ArrayView3<'_, f32>,
    camera: &CameraIntrinsics,
) -> Result<MotionEstimate, Error> {
    let shape = |map: &ArrayView3<'_, f32>| [map.shape()[0], map.shape()[1], map.shape()[2]];
    let [first_shape, second_shape] = [shape(&first), shape(&second)];
    if first_shape != second_shape || first_shape[1..].iter().any(|&cells| cells < LEAST_CELLS) {
        return Err(Error::Shape {
            first: first_shape,
            second: second_shape,
        });
    }

    let cell_count = first_shape[1] * first_shape[2];
    Ok(estimate(
        &matching::matches(first, second, camera),
        cell_count,
    ))
}

/// Fits the motion to the matches of a map with `cell_count` cells.
fn estimate(matches: &[Match], cell_count: usize) -> MotionEstimate {
    let sharp = matches.iter().filter(|matched| matched.is_sharp).count();
    if (sharp as f64) < LEAST_SHARP * cell_count as f64 {
        return MotionEstimate::none(matches.len(), 0.0);
    }

    let found = solver::solve(matches);
    let support = found.support();
    if support < LEAST_SUPPORT * cell_count as f64 {
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
    use ndarray::Array3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use seese3_core::geometry::{Distortion, PixelCamera, exp};

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
                    is_sharp: true,
                }
            })
            .collect()
    }

    /// A 4:3 camera with a focal length of one image width.
    fn camera() -> CameraIntrinsics {
        CameraIntrinsics::new(PixelCamera {
            width: 320.0,
            height: 240.0,
            focal: Vector2::new(320.0, 320.0),
            center: None,
            distortion: Distortion::None,
        })
        .unwrap()
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
        let reading = estimate(&matches(&known_motion(), 0.002, true), 1_200);
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
        let reading = estimate(&matches(&known_motion(), 0.0, true), 1_200);
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

    /// A map of distinct random cells.
    fn random_map(seed: u64) -> Array3<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        Array3::from_shape_simple_fn((16, 24, 32), || random.random_range(-1.0..1.0))
    }

    /// Oracle: the definition of a rotation: all directions rotate equally at any depth, and the
    /// translation is zero.
    #[test]
    fn a_turn_on_the_spot_is_no_translation() {
        let turn = Twist {
            linear: [0.0; 3].into(),
            angular: [0.02, 0.15, -0.04].into(),
        };
        let reading = estimate(&matches(&turn, 0.0, false), 1_200);
        let apart = reading.motion.rotation.angle_to(&exp(&turn).rotation);

        assert!(apart.to_degrees() < 0.05, "{}°", apart.to_degrees());
        assert!(reading.motion.translation.vector.norm() < 0.005);
    }

    /// Oracle: by hand. The map is shifted to the right by 2 of 32 cells. With a focal length of
    /// one image width, that is 1/16 in normalized coordinates.
    #[test]
    fn the_cells_of_a_shifted_map_are_found_again() {
        let first = random_map(4);
        let second = Array3::from_shape_fn(first.dim(), |(channel, row, column)| {
            first[(channel, row, (column + 30) % 32)]
        });
        let camera = camera();
        let found = matching::matches(first.view(), second.view(), &camera);
        assert!(found.len() > 500, "{} matches", found.len());

        // Random cells have no correlation with their neighbors: the peak may be off by half a
        // cell.
        for matched in &found {
            let shift = matched.point - matched.direction.xy();
            let is_near = (shift - Vector2::new(1.0 / 16.0, 0.0)).norm() < 0.5 / 32.0;
            let came_around = matched.point.x < matched.direction.x;
            assert!(is_near || came_around, "{shift}");
        }
    }

    /// Oracle: by hand. With 16:9 images and 24 rows of 32 cells, cells are wider than high. A
    /// shift by 3 rows is 3/24 of the height, which is 9/16 of the width.
    #[test]
    fn cells_need_not_be_square() {
        let wide = CameraIntrinsics::new(PixelCamera {
            width: 1_600.0,
            height: 900.0,
            focal: Vector2::new(1_600.0, 1_600.0),
            center: None,
            distortion: Distortion::None,
        })
        .unwrap();
        let first = random_map(5);
        let second = Array3::from_shape_fn(first.dim(), |(channel, row, column)| {
            first[(channel, (row + 21) % 24, column)]
        });
        let found = matching::matches(first.view(), second.view(), &wide);
        let cell = 9.0 / 16.0 / 24.0;

        assert!(found.len() > 500, "{} matches", found.len());
        for matched in &found {
            let shift = matched.point.y - matched.direction.y;
            let came_around = shift < 0.0;
            assert!(
                (shift - 3.0 * cell).abs() < 0.5 * cell || came_around,
                "{shift}"
            );
        }
    }

    /// Oracle: the definitions. Identical images give zero motion; unrelated images give no
    /// estimate.
    #[test]
    fn equal_images_stand_still_and_unrelated_ones_tell_nothing() {
        let camera = camera();
        let [one, other] = [random_map(1), random_map(2)];
        let still = read(one.view(), one.view(), &camera).unwrap();
        assert!(still.is_estimated);
        assert!(still.twist().norm() < 0.02, "{:?}", still.twist());

        let unrelated = read(one.view(), other.view(), &camera).unwrap();
        assert!(!unrelated.is_estimated, "support {}", unrelated.support);
        assert_eq!(unrelated.motion, Pose::identity());
        assert_eq!(unrelated.covariance[(0, 0)], 0.09);
    }

    /// Oracle: the definitions. Blank images give no estimate. Nor do images without texture, which
    /// match only by the encoder's border artifacts. Maps of different shapes are rejected.
    #[test]
    fn blank_and_foreign_maps_are_answered_or_refused() {
        let camera = camera();
        let blank = Array3::<f32>::zeros((16, 24, 32));
        assert!(
            !read(blank.view(), blank.view(), &camera)
                .unwrap()
                .is_estimated
        );

        let bordered = |seed: u64| {
            let noise = random_map(seed) * 0.05;
            Array3::from_shape_fn(blank.dim(), |(channel, row, column)| {
                let place = [row as f32 / 24.0, column as f32 / 32.0][channel % 2];
                1.0 + place * (1.0 + channel as f32 / 16.0) + noise[(channel, row, column)]
            })
        };
        let covered = read(bordered(1).view(), bordered(2).view(), &camera).unwrap();
        assert!(!covered.is_estimated, "{covered:?}");

        let other = Array3::<f32>::zeros((16, 12, 32));
        assert!(matches!(
            read(blank.view(), other.view(), &camera),
            Err(Error::Shape { .. })
        ));
    }
}

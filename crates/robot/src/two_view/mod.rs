//! The motion between two views of a room that nobody has mapped, read from where things are in
//! both images.
//!
//! The paper reads a motion from two averaged features, which know little of where things are. Here
//! the cells of two unpooled feature maps are matched (`matching`), and the motion is what explains
//! the matches best (`solver`):
//!
//! - A match says that the direction b in the first image is the point u of the second. Under the
//!   motion (R, t), a point at inverse depth ρ is seen in the direction Rᵀ(b − ρt).
//! - Each ρ is unknown. Its logarithm has a prior whose mean depends on the place in the image: what
//!   is at the edges of an image of a room is nearer than what is in its middle. This prior alone
//!   gives the translation its length in metres.
//! - The most probable motion is found by Levenberg–Marquardt steps, each ρ eliminated, with
//!   Student-t weights against wrong matches.
//!
//! Where the images say little, the translation is drawn towards none, and the covariance grows. How
//! the parameters were chosen is in `docs/two-views.md`.

mod matching;
mod solver;

use nalgebra::{Matrix6, Vector2, Vector3};
use ndarray::ArrayView3;

use seese3_core::geometry::{Pinhole, Pose, Twist, log};

/// Why two views are refused.
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

/// The smallest number of rows and of columns of a feature map.
const LEAST_CELLS: usize = 8;

/// Sharp matches, as a share of the map's cells, below which nothing is read: images without texture
/// match only by the border of the map, which moves with no camera.
const LEAST_SHARP: f64 = 1.0 / 12.0;

/// Sum of the matches' weights, as a share of the map's cells, below which nothing is read: the
/// matches are few or contradict each other.
const LEAST_SUPPORT: f64 = 160.0 / 1_200.0;

/// Standard deviation of each component of a motion that was not read, metres and radians.
const UNREAD_DEVIATION: f64 = 0.3;

/// The motion between two views.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionEstimate {
    /// The second camera in the frame of the first, metres.
    pub motion: Pose,
    /// Covariance of ξ in true = motion · exp(ξ), ordered (v, ω), metres and radians.
    pub covariance: Matrix6<f64>,
    /// Whether the images show the motion. If not, it is no motion, with a wide covariance.
    pub is_estimated: bool,
    /// How many cells were matched.
    pub match_count: usize,
    /// How many of these agree with the motion: the sum of their weights, 0 to 1 each.
    pub support: f64,
}

impl MotionEstimate {
    /// The motion as a twist, in the body frame of the first camera.
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

/// Where one thing is in both images.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Match {
    /// Its direction in the first image, scaled to depth 1.
    direction: Vector3<f64>,
    /// Its point on the second image's plane at distance 1.
    point: Vector2<f64>,
    /// Standard deviation of that point.
    deviation: f64,
    /// Whether the match is about as exact as usual.
    is_sharp: bool,
}

/// Reads the motion between two views of one camera from their feature maps, (channels, rows,
/// columns), whose cells cover the whole image.
///
/// # Errors
/// [`Error::Shape`] if the maps differ in shape or are too small.
pub fn read(
    first: ArrayView3<'_, f32>,
    second: ArrayView3<'_, f32>,
    camera: &Pinhole,
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

/// The motion that explains the matches of a map of `cell_count` cells best.
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
    use seese3_core::geometry::{PixelCamera, exp};

    /// Four hundred matches under a known motion, at depths of 1.2 to 3.2 m; `noise` on the image
    /// plane, and every seventh match wrong if `is_wrong`.
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

    /// A camera whose focal length is the width of its images of 4 by 3.
    fn camera() -> Pinhole {
        Pinhole::new(PixelCamera {
            width: 320.0,
            height: 240.0,
            focal: 320.0,
            centre: None,
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

    /// Oracle: the motion that made the matches. Its rotation and the direction of its translation
    /// are told by the images; its length only by the depths that rooms have.
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

    /// A map of random cells, in which no two are alike.
    fn random_map(seed: u64) -> Array3<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        Array3::from_shape_simple_fn((16, 24, 32), || random.random_range(-1.0..1.0))
    }

    /// Oracle: the definition of a turn: all directions turn alike, whatever their depths, and the
    /// camera stays where it is.
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

    /// Oracle: by hand. Every cell of a map that is shifted to the right by two cells of 32 is found
    /// two cells further right, by a camera whose focal length is a width 1/16 further on the plane.
    #[test]
    fn the_cells_of_a_shifted_map_are_found_again() {
        let first = random_map(4);
        let second = Array3::from_shape_fn(first.dim(), |(channel, row, column)| {
            first[(channel, row, (column + 30) % 32)]
        });
        let camera = camera();
        let found = matching::matches(first.view(), second.view(), &camera);
        assert!(found.len() > 500, "{} matches", found.len());

        // Cells of noise have no slope between them, so that the peak may be half a cell off.
        for matched in &found {
            let shift = matched.point - matched.direction.xy();
            let is_near = (shift - Vector2::new(1.0 / 16.0, 0.0)).norm() < 0.5 / 32.0;
            let came_around = matched.point.x < matched.direction.x;
            assert!(is_near || came_around, "{shift}");
        }
    }

    /// Oracle: by hand. Images of 16 by 9 on a map of 24 by 32 cells have cells that are wider than
    /// high: a shift by three rows is 3 / 24 of 9 / 16 of a width.
    #[test]
    fn cells_need_not_be_square() {
        let wide = Pinhole::new(PixelCamera {
            width: 1_600.0,
            height: 900.0,
            focal: 1_600.0,
            centre: None,
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

    /// Oracle: the definitions. The same image twice shows no motion, and two unrelated images show
    /// nothing.
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

    /// Oracle: blank images have no features, and an encoder's answer to its own border, which is the
    /// same in all images without texture, is no place in a room. Maps of two encoders have no common
    /// place either.
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

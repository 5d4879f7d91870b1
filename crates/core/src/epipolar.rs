//! Epipolar errors of matches between frames with known poses: they measure the noise of poses and
//! camera together, and the focal length and radial distortion can be fitted to them.

use std::f64::consts::SQRT_2;

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use crate::geometry::{CameraError, CameraIntrinsics, Distortion, Pose};
use crate::statistics::quantile;

/// Why a camera cannot be fitted.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(
        "only {matches} points of nearby frames match, too few to check the camera; map frames that \
         overlap, 5 to 50 % of the depth apart"
    )]
    TooFewMatches { matches: usize },
    #[error("the matches do not determine the camera; the fit left the valid range: {problem}")]
    OutOfRange {
        #[source]
        problem: CameraError,
    },
}

/// Width of the images in which pixels are counted.
pub const PIXEL_IMAGE_WIDTH: f64 = 320.0;

/// Number of frames from which pairs begin.
const FRAMES: usize = 100;
/// Pairs per frame.
const PAIRS: usize = 4;
/// Distances between the cameras of a pair, in units.
const BASELINES: [f64; 2] = [0.06, 0.5];
/// Maximum angle between the optical axes of a pair, degrees.
const MAX_ANGLE_DEG: f64 = 40.0;
/// Minimum number of matches of a pair.
const MIN_MATCHES: usize = 30;
/// Maximum number of matches of a pair that are used.
const MATCHES: usize = 60;
/// Scale of the Cauchy loss, pixels.
const LOSS_SCALE_PX: f64 = 1.5;
/// Matches farther from their epipolar line, pixels, are wrong and not counted in the median.
const GROSS_PX: f64 = 12.0;
/// Gauss–Newton steps of the fit.
const STEPS: usize = 20;
/// Largest change of the logarithm of the focal length and of k1 in one step.
const LONGEST_STEP: f64 = 0.1;
/// A fit has converged when a step is shorter than this.
const CONVERGED: f64 = 1e-6;
/// Differences for the numerical derivatives by the logarithm of the focal length and by k1.
const DIFFERENCES: [f64; 2] = [1e-4, 1e-4];
/// Standard deviations of the prior on the logarithm of the focal length and on k1.
const PRIOR: [f64; 2] = [0.2, 0.2];
/// Minimum number of matches for a fit.
const MIN_FIT_MATCHES: usize = 200;
/// Consecutive blocks of the recording over which the deviation is estimated. Frames of one block
/// share their pose errors, those of different blocks do not.
const BLOCKS: usize = 10;

/// Matches between pairs of frames with known poses.
#[derive(Debug, Clone)]
pub struct EpipolarPairs {
    pairs: Vec<Pair>,
}

/// Two frames and the matched image points of both, image widths.
#[derive(Debug, Clone)]
struct Pair {
    /// Block of the recording of the first frame, below [`BLOCKS`].
    block: usize,
    second_from_first: Pose,
    points: Vec<[Vector2<f64>; 2]>,
}

/// A camera fitted to a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraFit {
    /// The fitted camera: focal length and first radial coefficient; the rest as stated.
    pub camera: CameraIntrinsics,
    /// Standard deviation of the logarithm of the focal length, over blocks of the recording. It is
    /// about 0.2, that of the prior, if the motion does not determine the focal length.
    pub log_focal_deviation: f64,
    /// Median epipolar error with the fitted camera, pixels.
    pub median_px: f64,
    /// Median epipolar error with the stated camera, pixels.
    pub stated_median_px: f64,
    /// Number of matches.
    pub matches: usize,
}

impl EpipolarPairs {
    /// Matches pairs of nearby frames that see the scene from different places.
    ///
    /// - `poses`: `world_from_camera`.
    /// - `unit_m`: about the median depth of the scene, meters.
    /// - `matched`: the matched image points, image widths, of two frames, by their rows.
    pub fn of(
        poses: &[Pose],
        unit_m: f64,
        mut matched: impl FnMut(usize, usize) -> Vec<[Vector2<f64>; 2]>,
    ) -> Self {
        let every = (poses.len() / FRAMES).max(1);
        let rows: Vec<usize> = (0..poses.len()).step_by(every).collect();
        let [least, most] = BASELINES;

        let mut pairs = Vec::new();
        for (at, &first) in rows.iter().enumerate() {
            let later = &rows[at + 1..];
            let near: Vec<usize> = later
                .iter()
                .copied()
                .filter(|&second| {
                    let [a, b] = [&poses[first], &poses[second]];
                    let baseline = (a.translation.vector - b.translation.vector).norm() / unit_m;
                    (least..most).contains(&baseline)
                        && angle_between_axes(a, b).to_degrees() < MAX_ANGLE_DEG
                })
                .collect();

            let every = near.len().div_ceil(PAIRS).max(1);
            for &second in near.iter().step_by(every) {
                let points = matched(first, second);
                if points.len() >= MIN_MATCHES {
                    pairs.push(Pair {
                        block: first * BLOCKS / poses.len(),
                        second_from_first: poses[second].inv_mul(&poses[first]),
                        points: evenly(points),
                    });
                }
            }
        }

        Self { pairs }
    }

    /// Number of matches.
    pub fn match_count(&self) -> usize {
        self.pairs.iter().map(|pair| pair.points.len()).sum()
    }

    /// Median distance of the matches from their epipolar lines, pixels of an image
    /// [`PIXEL_IMAGE_WIDTH`] wide; `None` without matches.
    pub fn median_px(&self, camera: &CameraIntrinsics) -> Option<f64> {
        let mut errors = Vec::with_capacity(self.match_count());
        for pair in &self.pairs {
            pair.push_errors(camera, &mut errors);
        }
        errors.iter_mut().for_each(|error| *error = error.abs());
        errors.retain(|error| *error < GROSS_PX);
        quantile(&errors, 0.5)
    }

    /// Fits the focal length and the first radial coefficient, starting from `stated`.
    ///
    /// # Errors
    /// [`Error::TooFewMatches`] under 200 matches, [`Error::OutOfRange`] if the fit leaves the
    /// range of cameras.
    pub fn fit(&self, stated: &CameraIntrinsics) -> Result<CameraFit, Error> {
        let matches = self.match_count();
        if matches < MIN_FIT_MATCHES {
            return Err(Error::TooFewMatches { matches });
        }

        let failed = |problem: CameraError| Error::OutOfRange { problem };
        let center = Vector2::new(0.0, first_radial(stated.distortion()));
        let prior = Vector2::from(PRIOR).map(|deviation| deviation.powi(-2));
        let mut at = center;
        for _ in 0..STEPS {
            let cameras = CameraDifferences::of(stated, at).map_err(failed)?;
            let parts = self
                .pairs
                .iter()
                .map(|pair| pair.normal_equations(&cameras));
            let sum = parts.fold(NormalEquations::default(), NormalEquations::plus);

            let information = sum.information + Matrix2::from_diagonal(&prior);
            let gradient = sum.gradient - prior.component_mul(&(at - center));
            let step = information
                .try_inverse()
                .map_or_else(Vector2::zeros, |inverse| inverse * gradient);
            at += step.map(|change| change.clamp(-LONGEST_STEP, LONGEST_STEP));
            if step.norm() < CONVERGED {
                break;
            }
        }

        let camera = changed(stated, at).map_err(failed)?;
        let median = |camera: &CameraIntrinsics| self.median_px(camera).unwrap_or(f64::INFINITY);
        Ok(CameraFit {
            camera,
            log_focal_deviation: self.log_focal_deviation(stated, at).map_err(failed)?,
            median_px: median(&camera),
            stated_median_px: median(stated),
            matches,
        })
    }

    /// Sandwich estimate of the deviation of the log focal length: blocks of the recording are
    /// independent, pairs within a block are not. The prior counts as one more block.
    fn log_focal_deviation(
        &self,
        stated: &CameraIntrinsics,
        at: Vector2<f64>,
    ) -> Result<f64, CameraError> {
        let cameras = CameraDifferences::of(stated, at)?;
        let mut blocks = [NormalEquations::default(); BLOCKS];
        for pair in &self.pairs {
            blocks[pair.block] = blocks[pair.block].plus(pair.normal_equations(&cameras));
        }

        let prior = Vector2::from(PRIOR).map(|deviation| deviation.powi(-2));
        let mut information = Matrix2::from_diagonal(&prior);
        let mut scatter = information;
        for block in &blocks {
            information += block.information;
            scatter += block.gradient * block.gradient.transpose();
        }

        let inverse = information.try_inverse().unwrap_or_else(Matrix2::zeros);
        Ok((inverse * scatter * inverse)[(0, 0)].sqrt())
    }
}

/// Information matrix and negative gradient of the Cauchy loss by (log focal, k1).
#[derive(Debug, Clone, Copy, Default)]
struct NormalEquations {
    information: Matrix2<f64>,
    gradient: Vector2<f64>,
}

impl NormalEquations {
    fn plus(self, other: Self) -> Self {
        Self {
            information: self.information + other.information,
            gradient: self.gradient + other.gradient,
        }
    }
}

/// A camera and two that differ from it in the focal length and in k1, for numerical derivatives.
struct CameraDifferences {
    camera: CameraIntrinsics,
    /// Moved by [`DIFFERENCES`].
    moved: [CameraIntrinsics; 2],
}

impl CameraDifferences {
    fn of(stated: &CameraIntrinsics, at: Vector2<f64>) -> Result<Self, CameraError> {
        let [by_focal, by_radial] = DIFFERENCES;
        Ok(Self {
            camera: changed(stated, at)?,
            moved: [
                changed(stated, at + Vector2::new(by_focal, 0.0))?,
                changed(stated, at + Vector2::new(0.0, by_radial))?,
            ],
        })
    }
}

impl Pair {
    /// Appends the signed symmetric epipolar errors, pixels.
    fn push_errors(&self, camera: &CameraIntrinsics, errors: &mut Vec<f64>) {
        let shift = self.second_from_first.translation.vector.normalize();
        let rotation = self.second_from_first.rotation.to_rotation_matrix();
        let essential: Matrix3<f64> = shift.cross_matrix() * rotation.matrix();

        for [first, second] in &self.points {
            let a: Vector3<f64> = camera.to_image_plane(*first).push(1.0);
            let b: Vector3<f64> = camera.to_image_plane(*second).push(1.0);
            let line_in_second = essential * a;
            let line_in_first = essential.transpose() * b;

            // Gradients by the image points, in which the noise is the same everywhere.
            let [in_first, in_second] = [(a, line_in_first), (b, line_in_second)]
                .map(|(point, line)| camera.plane_derivative(point.xy()).tr_mul(&line.xy()));
            let scale = (in_first.norm_squared() + in_second.norm_squared())
                .sqrt()
                .max(1e-12);
            errors.push(b.dot(&line_in_second) / scale * PIXEL_IMAGE_WIDTH * SQRT_2);
        }
    }

    fn normal_equations(&self, cameras: &CameraDifferences) -> NormalEquations {
        let errors_of = |camera: &CameraIntrinsics| {
            let mut errors = Vec::with_capacity(self.points.len());
            self.push_errors(camera, &mut errors);
            errors
        };
        let errors = errors_of(&cameras.camera);
        let [by_focal, by_radial] = cameras.moved.each_ref().map(errors_of);

        let mut sum = NormalEquations::default();
        for (row, error) in errors.iter().enumerate() {
            let slope = Vector2::new(
                (by_focal[row] - error) / DIFFERENCES[0],
                (by_radial[row] - error) / DIFFERENCES[1],
            );
            let weight = 1.0 / (1.0 + (error / LOSS_SCALE_PX).powi(2));
            sum.information += slope * slope.transpose() * weight;
            sum.gradient -= slope * (error * weight);
        }

        sum
    }
}

/// The stated camera with the focal length multiplied by exp(`at`.x) and the first radial
/// coefficient `at`.y.
fn changed(stated: &CameraIntrinsics, at: Vector2<f64>) -> Result<CameraIntrinsics, CameraError> {
    let distortion = match stated.distortion() {
        Distortion::None if at.y == 0.0 => Distortion::None,
        Distortion::None => Distortion::BrownConrady([at.y, 0.0, 0.0, 0.0, 0.0]),
        Distortion::BrownConrady([_, k2, p1, p2, k3]) => {
            Distortion::BrownConrady([at.y, k2, p1, p2, k3])
        }
        Distortion::KannalaBrandt([_, k2, k3, k4]) => Distortion::KannalaBrandt([at.y, k2, k3, k4]),
    };
    stated.with(stated.focal() * at.x.exp(), distortion)
}

fn first_radial(distortion: Distortion) -> f64 {
    distortion.coefficients().first().copied().unwrap_or(0.0)
}

/// At most [`MATCHES`] of the points, evenly spaced.
fn evenly(points: Vec<[Vector2<f64>; 2]>) -> Vec<[Vector2<f64>; 2]> {
    let every = points.len().div_ceil(MATCHES).max(1);
    points.into_iter().step_by(every).collect()
}

/// Angle between the optical axes of two cameras, radians.
pub fn angle_between_axes(a: &Pose, b: &Pose) -> f64 {
    (a.rotation * Vector3::z()).angle(&(b.rotation * Vector3::z()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::PixelCamera;
    use crate::statistics::{normal_deviates, root_mean_square};
    use nalgebra::{Point3, UnitQuaternion};
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    /// Depth of the scene, meters.
    const DEPTH_M: f64 = 3.0;

    fn camera(focal_px: f64, k1: f64) -> CameraIntrinsics {
        CameraIntrinsics::new(PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: Vector2::repeat(focal_px),
            center: None,
            distortion: Distortion::brown_conrady([k1, 0.0, 0.0, 0.0, 0.0]),
        })
        .unwrap()
    }

    /// A camera that looks about while it moves by up to a meter.
    fn path() -> Vec<Pose> {
        let pose = |row: u32| {
            let wave = |period: f64| (f64::from(row) / period).sin();
            let position = Vector3::new(wave(17.0), 0.4 * wave(29.0), 0.7 * wave(23.0));
            let turn = Vector3::new(0.25 * wave(13.0), 0.5 * wave(31.0), 0.3 * wave(19.0));
            Pose::new(position, turn)
        };
        (0..200).map(pose).collect()
    }

    /// Image points, with normal noise, of points that both frames see. One in `one_wrong_of` has
    /// the place of another point in the second image.
    fn matches(
        poses: &[Pose],
        camera: &CameraIntrinsics,
        noise_px: f64,
        one_wrong_of: usize,
    ) -> EpipolarPairs {
        EpipolarPairs::of(poses, DEPTH_M, |first, second| {
            let mut random = ChaCha8Rng::seed_from_u64((1_000 * first + second) as u64);
            let numbers: Vec<f64> = normal_deviates(&mut random, 80 * 7).collect();
            let mut points = Vec::new();
            for number in numbers.chunks_exact(7) {
                let depth = DEPTH_M * (1.0 + 0.3 * number[0]).max(0.3);
                let place = Point3::new(0.4 * number[1] * depth, 0.3 * number[2] * depth, depth);
                let there = poses[second].inverse() * (poses[first] * place);
                let seen = [place, there].map(|point| camera.project(point.coords));
                let [Some(a), Some(b)] = seen else { continue };
                let is_inside = |at: Vector2<f64>| {
                    (0.0..1.0).contains(&at.x) && (0.0..camera.height()).contains(&at.y)
                };
                if is_inside(a) && is_inside(b) {
                    let noise = Vector2::new(number[3], number[4]) * noise_px;
                    let other_noise = Vector2::new(number[5], number[6]) * noise_px;
                    points.push([a + noise / 320.0, b + other_noise / 320.0]);
                }
            }
            for place in (0..points.len()).step_by(one_wrong_of) {
                points[place][1] = points[(place + 7) % points.len()][1];
            }
            points
        })
    }

    /// Oracle: the camera that projected the points, with one wrong match in ten.
    #[test]
    fn the_fit_finds_the_camera_from_far_off() {
        for k1 in [0.0, -0.15, 0.1] {
            let truth = camera(525.0, k1);
            let pairs = matches(&path(), &truth, 1.0, 10);
            assert!(pairs.match_count() > 5_000);

            for factor in [0.6, 0.8, 0.85, 1.0, 1.15, 1.25, 1.6] {
                let fit = pairs.fit(&camera(525.0 * factor, 0.0)).unwrap();
                let off = (fit.camera.focal().x / truth.focal().x).ln();
                let off_k1 = first_radial(fit.camera.distortion()) - k1;
                assert!(off.abs() < 0.003, "{factor} {k1}: {fit:?}");
                assert!(off_k1.abs() < 0.005, "{factor} {k1}: {fit:?}");
                assert!(fit.log_focal_deviation < 0.005, "{fit:?}");
                assert!(fit.median_px < 1.01 * fit.stated_median_px, "{fit:?}");
            }
        }
    }

    /// Oracle: the definition of a standard deviation, over fits to ten parts of the recording,
    /// which have independent noise.
    #[test]
    fn the_deviation_is_that_of_repeated_fits() {
        let truth = camera(525.0, -0.05);
        let poses = path();
        let fits = poses.chunks_exact(20).map(|part| {
            let fit = matches(part, &truth, 0.1, usize::MAX).fit(&truth).unwrap();
            let error = (fit.camera.focal().x / truth.focal().x).ln();
            error / fit.log_focal_deviation
        });
        let fits: Vec<f64> = fits.collect();
        let spread = root_mean_square(&fits);
        assert!((0.5..2.0).contains(&spread), "{fits:?}");
    }

    /// Oracle: the noise that was added: the symmetric error of a match is its distance from the
    /// line for noise in one image, so the median is 0.6745 deviations.
    #[test]
    fn the_median_error_of_the_true_camera_is_the_noise() {
        let truth = camera(525.0, -0.1);
        for noise_px in [0.3, 1.0] {
            let pairs = matches(&path(), &truth, noise_px, usize::MAX);
            let median_px = pairs.median_px(&truth).unwrap();
            let expected_px = 0.6745 * noise_px * std::f64::consts::SQRT_2;
            assert!(
                (median_px / expected_px - 1.0).abs() < 0.05,
                "{median_px} instead of {expected_px}"
            );
            assert!(pairs.median_px(&camera(600.0, -0.1)).unwrap() > 2.0 * expected_px);
        }
    }

    /// Oracle: epipolar geometry. Without translation there are no epipolar lines. Those of a
    /// camera that does not turn are the same at any focal length: parallel if it moves sideways,
    /// through the image center if it moves along its axis.
    #[test]
    fn a_motion_that_does_not_determine_the_focal_length_is_reported() {
        let truth = camera(525.0, 0.0);
        let turning: Vec<Pose> = path()
            .iter()
            .map(|pose| Pose::from_parts(Vector3::zeros().into(), pose.rotation))
            .collect();
        let error = matches(&turning, &truth, 0.5, usize::MAX)
            .fit(&truth)
            .unwrap_err();
        assert_eq!(error, Error::TooFewMatches { matches: 0 });

        let along = |axis: Vector3<f64>| -> Vec<Pose> {
            let along = |pose: &Pose| {
                let place = pose.translation.vector.component_mul(&axis);
                Pose::from_parts(place.into(), UnitQuaternion::identity())
            };
            path().iter().map(along).collect()
        };
        let sideways = along(Vector3::x());
        let fit = matches(&sideways, &truth, 0.5, usize::MAX).fit(&truth);
        assert!(fit.unwrap().log_focal_deviation > 0.05);

        let forward = along(Vector3::z());
        let is_determined = match matches(&forward, &truth, 0.5, usize::MAX).fit(&truth) {
            Ok(fit) => fit.log_focal_deviation < 0.05,
            Err(error) => !matches!(error, Error::OutOfRange { .. }),
        };
        assert!(!is_determined);

        let few = &path()[..5];
        let error = matches(few, &truth, 0.5, usize::MAX).fit(&truth);
        assert!(
            matches!(error, Err(Error::TooFewMatches { .. })),
            "{error:?}"
        );
    }
}

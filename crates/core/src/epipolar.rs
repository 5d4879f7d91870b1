//! Epipolar errors of matches between frames with known poses: they measure the noise of poses and
//! camera together, and the focal length and radial distortion can be fitted to them.

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
    #[error("the camera cannot be fitted to the matches: {problem}")]
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
const STEPS: usize = 12;
/// Differences for the numerical derivatives by the logarithm of the focal length and by k1.
const DIFFERENCES: [f64; 2] = [1e-4, 1e-4];
/// Standard deviations of the prior on the logarithm of the focal length and on k1.
const PRIOR: [f64; 2] = [0.2, 0.2];
/// Minimum number of matches for a fit.
const MIN_FIT_MATCHES: usize = 200;

/// Matches between pairs of frames with known poses.
#[derive(Debug, Clone)]
pub struct EpipolarPairs {
    pairs: Vec<Pair>,
}

/// Two frames and the matched image points of both, image widths.
#[derive(Debug, Clone)]
struct Pair {
    second_from_first: Pose,
    points: Vec<[Vector2<f64>; 2]>,
}

/// A camera fitted to a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraFit {
    /// The fitted camera: focal length and first radial coefficient; the rest as stated.
    pub camera: CameraIntrinsics,
    /// Standard deviation of the logarithm of the focal length, over blocks of the recording.
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
    /// [`Error::TooFewMatches`] under 200 matches, [`Error::OutOfRange`] if the fit leaves the range
    /// of cameras.
    pub fn fit(&self, stated: &CameraIntrinsics) -> Result<CameraFit, Error> {
        let matches = self.match_count();
        if matches < MIN_FIT_MATCHES {
            return Err(Error::TooFewMatches { matches });
        }

        let failed = |problem: CameraError| Error::OutOfRange { problem };
        let mut at = Vector2::new(0.0, first_radial(stated.distortion()));
        let mut normal = Matrix2::identity();
        for _ in 0..STEPS {
            let (information, step) = self.step(stated, at).map_err(failed)?;
            normal = information;
            at += step;
            if step.norm() < 1e-6 {
                break;
            }
        }

        let camera = changed(stated, at).map_err(failed)?;
        let median = |camera: &CameraIntrinsics| self.median_px(camera).unwrap_or(f64::INFINITY);
        Ok(CameraFit {
            camera,
            log_focal_deviation: self.log_focal_deviation(stated, at, &normal),
            median_px: median(&camera),
            stated_median_px: median(stated),
            matches,
        })
    }

    /// Information matrix and Gauss–Newton step of (log focal, k1).
    fn step(
        &self,
        stated: &CameraIntrinsics,
        at: Vector2<f64>,
    ) -> Result<(Matrix2<f64>, Vector2<f64>), CameraError> {
        let (information, gradient) = self
            .pairs
            .iter()
            .map(|pair| pair.normal_equations(stated, at))
            .try_fold((Matrix2::zeros(), Vector2::zeros()), |(h, g), part| {
                let (part_h, part_g) = part?;
                Ok((h + part_h, g + part_g))
            })?;

        let prior = Vector2::from(PRIOR).map(|deviation| deviation.powi(-2));
        let center = Vector2::new(0.0, first_radial(stated.distortion()));
        let information = information + Matrix2::from_diagonal(&prior);
        let gradient = gradient - prior.component_mul(&(at - center));
        let step = information
            .try_inverse()
            .map_or_else(Vector2::zeros, |inverse| inverse * gradient);
        Ok((information, step.map(|change| change.clamp(-0.1, 0.1))))
    }

    /// Sandwich estimate of the deviation of the log focal length: pairs are independent, matches
    /// within a pair are not.
    fn log_focal_deviation(
        &self,
        stated: &CameraIntrinsics,
        at: Vector2<f64>,
        information: &Matrix2<f64>,
    ) -> f64 {
        let mut scatter = Matrix2::zeros();
        for pair in &self.pairs {
            if let Ok((_, gradient)) = pair.normal_equations(stated, at) {
                scatter += gradient * gradient.transpose();
            }
        }

        let inverse = information.try_inverse().unwrap_or_else(Matrix2::zeros);
        (inverse * scatter * inverse)[(0, 0)].sqrt()
    }
}

impl Pair {
    /// Appends the signed symmetric epipolar errors, pixels.
    fn push_errors(&self, camera: &CameraIntrinsics, errors: &mut Vec<f64>) {
        let focal_px = camera.focal().mean() * PIXEL_IMAGE_WIDTH;
        let shift = self.second_from_first.translation.vector.normalize();
        let rotation = self.second_from_first.rotation.to_rotation_matrix();
        let essential: Matrix3<f64> = shift.cross_matrix() * rotation.matrix();

        for [first, second] in &self.points {
            let a: Vector3<f64> = camera.to_image_plane(*first).push(1.0);
            let b: Vector3<f64> = camera.to_image_plane(*second).push(1.0);
            let line_in_second = essential * a;
            let line_in_first = essential.transpose() * b;
            let scale = (line_in_second.xy().norm_squared() + line_in_first.xy().norm_squared())
                .sqrt()
                .max(1e-12);
            errors.push(b.dot(&line_in_second) / scale * focal_px * std::f64::consts::SQRT_2);
        }
    }

    /// Information matrix and negative gradient of the Cauchy loss by (log focal, k1).
    fn normal_equations(
        &self,
        stated: &CameraIntrinsics,
        at: Vector2<f64>,
    ) -> Result<(Matrix2<f64>, Vector2<f64>), CameraError> {
        let errors_at = |at: Vector2<f64>| {
            let mut errors = Vec::with_capacity(self.points.len());
            self.push_errors(&changed(stated, at)?, &mut errors);
            Ok(errors)
        };
        let errors = errors_at(at)?;
        let [by_focal, by_radial] = [0, 1].map(|axis| {
            let mut moved = at;
            moved[axis] += DIFFERENCES[axis];
            errors_at(moved)
        });
        let [by_focal, by_radial] = [by_focal?, by_radial?];

        let mut information = Matrix2::zeros();
        let mut gradient = Vector2::zeros();
        for (row, error) in errors.iter().enumerate() {
            let slope = Vector2::new(
                (by_focal[row] - error) / DIFFERENCES[0],
                (by_radial[row] - error) / DIFFERENCES[1],
            );
            let weight = 1.0 / (1.0 + (error / LOSS_SCALE_PX).powi(2));
            information += slope * slope.transpose() * weight;
            gradient -= slope * (error * weight);
        }

        Ok((information, gradient))
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

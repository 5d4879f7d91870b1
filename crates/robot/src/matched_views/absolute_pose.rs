//! The pose of a camera from matches of image points with map points: LO-RANSAC over P3P, then a
//! robust refinement.

use nalgebra::{
    Cholesky, Isometry3, Matrix2, Matrix2x3, Matrix2x6, Matrix6, Point3, Vector2, Vector3, Vector6,
};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::p3p::p3p;
#[cfg(doc)]
use seese3_core::epipolar::PIXEL_IMAGE_WIDTH;
use seese3_core::geometry::{Pose, Twist, exp};
use seese3_core::statistics::mean;

/// Sample size of P3P.
const SAMPLE: usize = 3;
/// Gauss–Newton steps of a local optimization within RANSAC.
const LOCAL_STEPS: usize = 4;
/// Gauss–Newton steps of the final refinement.
const FINAL_STEPS: usize = 8;
/// Degrees of freedom of the Student-t loss of the final refinement.
const DEGREES_OF_FREEDOM: f64 = 4.0;
/// Number of matches after which a hypothesis that is already worse than the best is dropped.
const BLOCK: usize = 32;
/// Minimum variance of a keypoint's position, squared pixels.
const LEAST_VARIANCE_PX: f64 = 0.01;
/// Minimum depth of a map point in front of the camera, meters.
const MIN_DEPTH: f64 = 1e-6;

/// A keypoint of a view and a map point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Correspondence {
    /// Place of the keypoint in the view.
    pub keypoint: usize,
    /// The mapped frame of the map point.
    pub frame: usize,
    /// The keypoint on the plane at depth 1.
    pub plane: Vector2<f64>,
    /// The map point, world, meters.
    pub world: Vector3<f64>,
    /// The map point from the camera of the mapped frame, in the axes of the world, meters.
    pub from_frame: Vector3<f64>,
    /// Relative standard deviation of the map point's depth, at a deviation of 1 pixel.
    pub deviation: f64,
}

/// Noise of a map, from which the covariance of a view's pose follows:
///
/// covariance = H⁻¹ · `design_effect` · (1 + gap / `gap_scale`)
///            + (`pose_noise`² + (`relative_error` · gap)²) · I
///
/// H is the information matrix of the matches for independent errors, at the measured variance of
/// their reprojection errors. The errors are correlated: nearby points share depth errors, whose
/// effect on the pose grows with the gap. Stated poses have independent noise. Errors of the
/// camera's focal length and lens, and of the scale of depths, move the pose by a share of the gap.
/// I is the identity in units (median depths) and radians.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MapNoise {
    /// Factor on the variance of independent matches, at a gap of 0.
    pub design_effect: f64,
    /// The gap that doubles that variance.
    pub gap_scale: f64,
    /// Standard deviation of the independent errors of stated poses: units (median depths) along
    /// each axis, and radians about it.
    pub pose_noise: f64,
    /// Standard deviation of errors that are proportional to the gap, a share of the gap.
    pub relative_error: f64,
}

impl MapNoise {
    /// Default noise, for maps in which it was not measured.
    pub const TYPICAL: Self = Self {
        design_effect: 5.0,
        gap_scale: 0.05,
        pose_noise: 0.001,
        relative_error: 0.01,
    };

    /// The noise with all covariances multiplied by a factor.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        let deviation = factor.sqrt();
        Self {
            design_effect: self.design_effect * factor,
            gap_scale: self.gap_scale,
            pose_noise: self.pose_noise * deviation,
            relative_error: self.relative_error * deviation,
        }
    }
}

/// Settings of the search. Pixels are those of an image that is [`PIXEL_IMAGE_WIDTH`] pixels wide.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Search {
    /// Focal length of the view's camera: pixels per unit length on the plane at depth 1.
    pub focal_px: f64,
    /// Largest reprojection error of an inlier, pixels.
    pub threshold_px: f64,
    /// Standard deviation of a keypoint's position, pixels.
    pub deviation_px: f64,
    /// Minimum and maximum number of iterations.
    pub iterations: [usize; 2],
    /// Accepted probability that no all-inlier sample was drawn.
    pub miss_probability: f64,
    /// Seed of the samples.
    pub seed: u64,
}

/// Coordinates of correspondences, in blocks. The last block is filled with NaN, which costs as
/// much as an outlier.
struct Columns {
    /// x, y and z of the map points.
    world: Vec<[[f64; BLOCK]; 3]>,
    /// x and y on the plane at depth 1.
    plane: Vec<[[f64; BLOCK]; 2]>,
}

impl Columns {
    fn of(matches: &[Correspondence]) -> Self {
        let mut world = vec![[[f64::NAN; BLOCK]; 3]; matches.len().div_ceil(BLOCK)];
        let mut plane = vec![[[f64::NAN; BLOCK]; 2]; world.len()];
        for (number, match_) in matches.iter().enumerate() {
            let (block, place) = (number / BLOCK, number % BLOCK);
            for (axis, values) in world[block].iter_mut().enumerate() {
                values[place] = match_.world[axis];
            }
            for (axis, values) in plane[block].iter_mut().enumerate() {
                values[place] = match_.plane[axis];
            }
        }
        Self { world, plane }
    }
}

/// A refined pose and its support.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Indices of the inliers among the correspondences.
    pub inliers: Vec<usize>,
    /// Information matrix (inverse covariance) of δ in true = pose · exp(δ), ordered (v, ω), if
    /// the errors of all matches were independent, at the variance of their reprojection errors.
    pub information: Matrix6<f64>,
    /// Variance of a keypoint's position, measured on the inliers, squared pixels.
    pub variance_px: f64,
}

/// The pose with the most support; `None` if no sample gives a pose.
pub(crate) fn find_pose(matches: &[Correspondence], search: &Search) -> Option<Found> {
    if matches.len() < SAMPLE + 1 {
        return None;
    }

    let columns = Columns::of(matches);
    let mut rng = ChaCha8Rng::seed_from_u64(search.seed);
    let mut best: Option<(f64, Isometry3<f64>)> = None;
    let [least, most] = search.iterations;
    let mut wanted = most;
    let mut iteration = 0;

    while iteration < wanted.max(least).min(most) {
        iteration += 1;
        let Some(sample) = sampled(matches, &mut rng) else {
            continue;
        };
        let directions = sample.map(|match_| match_.plane.push(1.0).normalize());
        let points = sample.map(|match_| match_.world);

        for hypothesis in p3p(&directions, &points) {
            let limit = best.as_ref().map_or(f64::INFINITY, |(cost, _)| *cost);
            let Some(cost) = search.cost(&columns, &hypothesis, limit) else {
                continue;
            };

            // Local optimization: refine the new best on its inliers.
            let refined = search.locally_optimized(matches, hypothesis);
            best = match search.cost(&columns, &refined, cost) {
                Some(lower) => Some((lower, refined)),
                None => Some((cost, hypothesis)),
            };

            let inliers = best
                .as_ref()
                .map_or(0, |(_, pose)| search.inliers(matches, pose).len());
            wanted = iterations_needed(inliers, matches.len(), search.miss_probability);
        }
    }

    let (_, camera_from_world) = best?;
    search.refined(matches, camera_from_world)
}

/// Iterations after which an all-inlier sample was drawn, except with the given probability.
fn iterations_needed(inliers: usize, count: usize, miss_probability: f64) -> usize {
    let all = (inliers as f64 / count as f64).powi(SAMPLE as i32);
    if all >= 1.0 {
        return 1;
    }

    let needed = miss_probability.ln() / (1.0 - all).ln();
    if needed.is_finite() {
        needed.ceil() as usize
    } else {
        usize::MAX
    }
}

/// Matches of three different keypoints.
fn sampled(matches: &[Correspondence], rng: &mut impl Rng) -> Option<[Correspondence; SAMPLE]> {
    let mut draw = || matches[rng.random_range(0..matches.len())];
    let sample = [draw(), draw(), draw()];
    let [a, b, c] = sample.map(|match_| match_.keypoint);

    (a != b && a != c && b != c).then_some(sample)
}

impl Search {
    /// Squared reprojection error in pixels; infinite behind the camera.
    pub(super) fn squared_error(
        &self,
        match_: &Correspondence,
        camera_from_world: &Isometry3<f64>,
    ) -> f64 {
        let seen = camera_from_world * Point3::from(match_.world);
        if seen.z < MIN_DEPTH {
            return f64::INFINITY;
        }
        let dx = seen.x / seen.z - match_.plane.x;
        let dy = seen.y / seen.z - match_.plane.y;
        (dx * dx + dy * dy) * self.focal_px * self.focal_px
    }

    /// Truncated squared errors of all matches (MSAC), in squared thresholds; `None` if it reaches
    /// `limit`.
    fn cost(
        &self,
        matches: &Columns,
        camera_from_world: &Isometry3<f64>,
        limit: f64,
    ) -> Option<f64> {
        let rotation = camera_from_world.rotation.to_rotation_matrix();
        let shift = camera_from_world.translation.vector;
        let scale = (self.focal_px / self.threshold_px).powi(2);
        let mut cost = 0.0;
        for (world, plane) in matches.world.iter().zip(&matches.plane) {
            let mut errors = [0.0; BLOCK];
            let [x, y, z] = world;
            let [u, v] = plane;
            for (at, error) in errors.iter_mut().enumerate() {
                let seen = |row: usize| {
                    rotation[(row, 0)] * x[at]
                        + rotation[(row, 1)] * y[at]
                        + rotation[(row, 2)] * z[at]
                        + shift[row]
                };
                let depth = seen(2);
                let dx = seen(0) / depth - u[at];
                let dy = seen(1) / depth - v[at];
                let squared = (dx * dx + dy * dy) * scale;
                *error = if depth < MIN_DEPTH {
                    1.0
                } else {
                    squared.min(1.0)
                };
            }
            cost += errors.iter().sum::<f64>();
            if cost >= limit {
                return None;
            }
        }

        Some(cost)
    }

    fn inliers(
        &self,
        matches: &[Correspondence],
        camera_from_world: &Isometry3<f64>,
    ) -> Vec<usize> {
        let threshold = self.threshold_px * self.threshold_px;
        (0..matches.len())
            .filter(|&place| self.squared_error(&matches[place], camera_from_world) < threshold)
            .collect()
    }

    /// A few Gauss–Newton steps on the inliers, with a Cauchy loss of the scale of the threshold.
    fn locally_optimized(
        &self,
        matches: &[Correspondence],
        mut camera_from_world: Isometry3<f64>,
    ) -> Isometry3<f64> {
        for _ in 0..LOCAL_STEPS {
            let inliers = self.inliers(matches, &camera_from_world);
            let world_from_camera = camera_from_world.inverse();
            let scale = (0.5 * self.threshold_px).powi(2);
            let mut normal = NormalEquations::default();
            for &place in &inliers {
                let Some(row) = self.linearized(&matches[place], &world_from_camera) else {
                    continue;
                };
                let weight = 1.0 / (1.0 + row.residual.norm_squared() / scale);
                normal.add(&row, &(Matrix2::identity() * weight));
            }

            let Some(step) = normal.step() else {
                break;
            };
            camera_from_world = (world_from_camera * exp(&Twist::from_vector(&step))).inverse();
        }

        camera_from_world
    }

    /// The refined pose on the inliers of a hypothesis: Student-t weights, with the uncertainty of
    /// the map points along their rays.
    fn refined(
        &self,
        matches: &[Correspondence],
        camera_from_world: Isometry3<f64>,
    ) -> Option<Found> {
        let inliers = self.inliers(matches, &camera_from_world);
        let mut pose = camera_from_world.inverse();
        for _ in 0..FINAL_STEPS {
            let step = self.normal_equations(matches, &inliers, &pose).step()?;
            pose *= exp(&Twist::from_vector(&step));
            if step.norm() < 1e-7 {
                break;
            }
        }

        // The information uses the measured variance of keypoint positions instead of the assumed
        // one.
        let inliers = self.inliers(matches, &pose.inverse());
        let assumed = self.normal_equations(matches, &inliers, &pose).information;
        let variance_px = self.variance_px(matches, &inliers, &pose);
        let information = assumed * (self.deviation_px.powi(2) / variance_px);
        Some(Found {
            pose,
            inliers,
            information,
            variance_px,
        })
    }

    /// Mean squared reprojection error of the inliers along one axis, squared pixels; at least
    /// [`LEAST_VARIANCE_PX`].
    fn variance_px(&self, matches: &[Correspondence], inliers: &[usize], pose: &Pose) -> f64 {
        let camera_from_world = pose.inverse();
        let squared: Vec<f64> = inliers
            .iter()
            .map(|&place| 0.5 * self.squared_error(&matches[place], &camera_from_world))
            .collect();
        mean(&squared).max(LEAST_VARIANCE_PX)
    }

    fn normal_equations(
        &self,
        matches: &[Correspondence],
        inliers: &[usize],
        pose: &Pose,
    ) -> NormalEquations {
        let camera_from_world = pose.rotation.inverse().to_rotation_matrix();
        let mut normal = NormalEquations::default();
        for &place in inliers {
            let match_ = &matches[place];
            let Some(row) = self.linearized(match_, pose) else {
                continue;
            };

            // Position noise of the keypoint, and of the map point along its ray.
            let along = row.by_point * (camera_from_world * match_.from_frame) * match_.deviation;
            let covariance = (Matrix2::identity() + along * along.transpose())
                * (self.deviation_px * self.deviation_px);
            let Some(inverse) = covariance.try_inverse() else {
                continue;
            };
            let squared = row.residual.dot(&(inverse * row.residual));
            let weight = (DEGREES_OF_FREEDOM + 2.0) / (DEGREES_OF_FREEDOM + squared);
            normal.add(&row, &(inverse * weight));
        }

        normal
    }

    /// The residual of a match in pixels, and its derivatives; `None` behind the camera.
    pub(super) fn linearized(&self, match_: &Correspondence, pose: &Pose) -> Option<Linearized> {
        let seen = pose
            .inverse_transform_point(&Point3::from(match_.world))
            .coords;
        if seen.z < MIN_DEPTH {
            return None;
        }

        let projected = seen.xy() / seen.z;
        let by_point = Matrix2x3::new(1.0, 0.0, -projected.x, 0.0, 1.0, -projected.y)
            * (self.focal_px / seen.z);

        // Under pose · exp(δ), δ = (v, ω), the point moves by −v − ω × p = −v + p × ω.
        let mut by_step = Matrix2x6::zeros();
        by_step.fixed_columns_mut::<3>(0).copy_from(&-by_point);
        by_step
            .fixed_columns_mut::<3>(3)
            .copy_from(&(by_point * seen.cross_matrix()));

        Some(Linearized {
            residual: (match_.plane - projected) * self.focal_px,
            by_step,
            by_point,
        })
    }
}

/// A residual in pixels and the derivatives of the projection.
pub(super) struct Linearized {
    pub residual: Vector2<f64>,
    /// By a step δ of the pose on the right, ordered (v, ω).
    pub by_step: Matrix2x6<f64>,
    /// By the point in the camera frame.
    by_point: Matrix2x3<f64>,
}

/// Normal equations of a Gauss–Newton step of the pose.
#[derive(Default)]
struct NormalEquations {
    information: Matrix6<f64>,
    gradient: Vector6<f64>,
}

impl NormalEquations {
    fn add(&mut self, row: &Linearized, weight: &Matrix2<f64>) {
        let weighted = row.by_step.transpose() * weight;
        self.information += weighted * row.by_step;
        self.gradient += weighted * row.residual;
    }

    fn step(&self) -> Option<Vector6<f64>> {
        let step = Cholesky::new(self.information)?.solve(&self.gradient);
        step.iter().all(|x| x.is_finite()).then_some(step)
    }
}

/// Information of a view's matches about its pose, for any noise of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseInformation {
    /// Information matrix (inverse covariance) of δ in true = pose · exp(δ), ordered (v, ω), if
    /// the errors of all matches were independent, at the variance of their reprojection errors.
    pub independent: Matrix6<f64>,
    /// Distance of the view from the mean of the matched frames: the length of their mean
    /// displacement, in units and radians. It is small for a view between the frames, where their
    /// errors cancel.
    pub gap: f64,
    /// The unit: the median depth of the map's keypoints, meters.
    pub unit_m: f64,
}

impl PoseInformation {
    /// Factor on the variances of independent matches.
    pub fn factor(&self, noise: &MapNoise) -> f64 {
        noise.design_effect * (1.0 + self.gap / noise.gap_scale)
    }

    /// Covariance of δ in true = pose · exp(δ), ordered (v, ω), meters and radians, where the true
    /// pose is stated with the same noise as the poses of the map; `None` if the matches do not
    /// determine the pose.
    pub fn covariance(&self, noise: &MapNoise) -> Option<Matrix6<f64>> {
        let of_matches = self.factor(noise);
        let rotation = noise.pose_noise.powi(2) + (noise.relative_error * self.gap).powi(2);
        let position = rotation * self.unit_m.powi(2);
        let of_poses = Matrix6::from_diagonal(&Vector6::new(
            position, position, position, rotation, rotation, rotation,
        ));

        let covariance = Cholesky::new(self.independent)?.inverse() * of_matches + of_poses;
        Some((covariance + covariance.transpose()) * 0.5)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use nalgebra::{Vector2, Vector3};
    use seese3_core::geometry::log;
    use seese3_testing::{golden, json, number, pose};
    use serde_json::Value;

    use super::*;

    fn numbers(value: &Value) -> Vec<f64> {
        match value {
            Value::Array(values) => values.iter().flat_map(numbers).collect(),
            number_value => vec![number(number_value)],
        }
    }

    fn matches_of(case: &Value) -> Vec<Correspondence> {
        let world = numbers(&case["world"]);
        let plane = numbers(&case["plane"]);
        let points = world.chunks_exact(3).zip(plane.chunks_exact(2));
        points
            .enumerate()
            .map(|(keypoint, (world, plane))| Correspondence {
                keypoint,
                frame: 0,
                plane: Vector2::from_column_slice(plane),
                world: Vector3::from_column_slice(world),
                from_frame: Vector3::z(),
                deviation: 0.0,
            })
            .collect()
    }

    fn search(case: &Value, focal_px: f64, seed: u64) -> Search {
        Search {
            focal_px,
            threshold_px: number(&case["threshold_px"]),
            deviation_px: 0.7,
            iterations: [100, 1_000],
            miss_probability: 1e-4,
            seed,
        }
    }

    /// Oracle: PoseLib on the same correspondences (`tests/golden/absolute_pose`). With noise, the
    /// two losses differ, and the poses agree within a standard deviation.
    #[test]
    fn the_pose_is_that_of_poselib() {
        let file = json(&golden().join("absolute_pose/expected.json"));
        for case in file["cases"].as_array().unwrap() {
            let name = case["name"].as_str().unwrap();
            let matches = matches_of(case);
            let expected = pose(&numbers(&case["world_from_camera"]));
            let depth = number(&case["median_depth"]);
            for seed in 0..5 {
                let search = search(case, number(&file["focal_px"]), seed);
                let found = find_pose(&matches, &search).unwrap();
                let off = log(&found.pose.inv_mul(&expected));
                if name.starts_with("exact") {
                    assert!(off.linear.norm() < 1e-6 * depth, "{name}: {off:?}");
                    assert!(off.angular.norm() < 1e-6, "{name}: {off:?}");
                    // PoseLib counts inliers before its last refinement.
                    let count = found.inliers.len() as f64;
                    assert!((count - number(&case["inliers"])).abs() < 2.0, "{name}");
                } else {
                    let off = off.to_vector();
                    let squared = off.dot(&(found.information * off));
                    assert!(squared < 1.0, "{name}: {squared}");
                }
            }
        }
    }

    /// Oracle: the definition. A pose has 6 degrees of freedom, which three points of one line, one
    /// point and numbers that are not finite do not determine.
    #[test]
    fn degenerate_matches_give_no_pose_that_many_agree_with() {
        let file = json(&golden().join("absolute_pose/expected.json"));
        let case = &file["cases"][1];
        let search = search(case, number(&file["focal_px"]), 1);
        let matches = matches_of(case);

        assert!(find_pose(&[], &search).is_none());
        assert!(find_pose(&matches[..3], &search).is_none());
        let changed = |change: &dyn Fn(&mut Correspondence)| {
            let mut changed = matches.clone();
            changed.iter_mut().for_each(change);
            find_pose(&changed, &search)
        };

        // One keypoint; one map point.
        assert!(changed(&|match_| match_.keypoint = 0).is_none());
        assert!(changed(&|match_| match_.world = Vector3::z()).is_none());
        let on_a_line = changed(&|match_| match_.world = Vector3::x() * match_.world.x);
        assert!(on_a_line.is_none_or(|found| found.inliers.len() < matches.len() / 2));
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            assert!(changed(&|match_| match_.world.x = bad).is_none_or(|found| {
                found.inliers.is_empty() || found.pose.translation.vector.norm().is_finite()
            }));
            assert!(changed(&|match_| match_.plane.x = bad).is_none_or(|found| {
                found.inliers.is_empty() || found.pose.translation.vector.norm().is_finite()
            }));
        }
    }
}

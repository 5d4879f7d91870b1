//! The pose of a camera from matches of image points with map points: LO-RANSAC over P3P, then a
//! robust refinement.

use std::collections::BTreeMap;

use nalgebra::{
    Cholesky, Isometry3, Matrix2, Matrix2x3, Matrix2x6, Matrix3, Matrix6, Point3, SMatrix, SVector,
    Vector2, Vector3, Vector6,
};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::p3p::p3p;
use seese3_core::geometry::{Pose, Twist, exp};

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
/// Minimum depth of a map point in front of the camera, meters.
const MIN_DEPTH: f64 = 1e-6;

/// A keypoint of a view and a map point.
#[derive(Debug, Clone, Copy)]
pub(super) struct Correspondence {
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

impl Correspondence {
    /// Derivative of the map point by the errors that all points of its mapped frame share:
    /// translation and rotation of the frame in the axes of the world, logarithm of the depths.
    fn by_shared_errors(&self) -> BySharedErrors {
        let mut by_errors = BySharedErrors::zeros();
        by_errors
            .fixed_columns_mut::<3>(0)
            .copy_from(&Matrix3::identity());
        by_errors
            .fixed_columns_mut::<3>(3)
            .copy_from(&-self.from_frame.cross_matrix());
        by_errors.set_column(6, &self.from_frame);
        by_errors
    }
}

/// Number of errors that all points of a mapped frame share.
const SHARED: usize = 7;

/// Errors that all points of a mapped frame share.
type SharedErrors = SVector<f64, SHARED>;
type BySharedErrors = SMatrix<f64, 3, SHARED>;

/// Standard deviations of the errors that all points of a mapped frame share: the error of the
/// frame's stated pose, and of the scale of its depths, which comes from the poses of its
/// neighbors.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MapNoise {
    /// Translation along each axis, meters.
    pub translation_m: f64,
    /// Rotation about each axis, radians.
    pub rotation_rad: f64,
    /// Logarithm of the scale of the depths.
    pub log_depth: f64,
    /// Factor on the variance of a pose from its matches (design effect): errors of nearby matches
    /// are correlated.
    pub design_effect: f64,
    /// Growth of the translation error of a view with its distance from the matched frames, meters
    /// per unit of [`PoseInformation::gap`].
    pub translation_growth_m: f64,
    /// Growth of the rotation error, radians per unit of [`PoseInformation::gap`].
    pub rotation_growth_rad: f64,
}

impl MapNoise {
    /// Noise of a map in which it was not measured. `unit_m` is the median depth, meters.
    pub fn typical(unit_m: f64) -> Self {
        Self {
            translation_m: 0.003 * unit_m,
            rotation_rad: 0.003,
            log_depth: 0.03,
            design_effect: 4.0,
            translation_growth_m: 0.03 * unit_m,
            rotation_growth_rad: 0.03,
        }
    }

    fn information(&self) -> SharedErrors {
        let Self {
            translation_m: t,
            rotation_rad: r,
            log_depth: s,
            ..
        } = *self;
        SharedErrors::from([t, t, t, r, r, r, s]).map(|deviation| deviation.powi(-2))
    }
}

/// Settings of the search.
#[derive(Debug, Clone, Copy)]
pub(super) struct Search {
    /// Pixels per unit length on the plane at depth 1.
    pub focal_px: f64,
    /// Largest reprojection error of an inlier, pixels.
    pub threshold_px: f64,
    /// Standard deviation of a keypoint's position, pixels.
    pub deviation_px: f64,
    /// Errors that the points of a mapped frame share.
    pub noise: MapNoise,
    /// Minimum and maximum number of iterations.
    pub iterations: [usize; 2],
    /// Probability of stopping without an all-inlier sample.
    pub miss_probability: f64,
    /// Seed of the samples.
    pub seed: u64,
}

/// A refined pose and its support.
#[derive(Debug, Clone)]
pub(super) struct Found {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Indices of the inliers among the correspondences.
    pub inliers: Vec<usize>,
    /// What the inliers tell about the pose.
    pub information: PoseInformation,
}

/// The pose with the most support; `None` if no sample gives a pose.
pub(super) fn find_pose(matches: &[Correspondence], search: &Search) -> Option<Found> {
    if matches.len() < SAMPLE + 1 {
        return None;
    }

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
            let Some(cost) = search.cost(matches, &hypothesis, limit) else {
                continue;
            };

            // Local optimization: refine the new best on its inliers.
            let refined = search.locally_optimized(matches, hypothesis);
            best = match search.cost(matches, &refined, cost) {
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
    fn squared_error(&self, match_: &Correspondence, camera_from_world: &Isometry3<f64>) -> f64 {
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
        matches: &[Correspondence],
        camera_from_world: &Isometry3<f64>,
        limit: f64,
    ) -> Option<f64> {
        let threshold = self.threshold_px * self.threshold_px;
        let mut cost = 0.0;
        for block in matches.chunks(BLOCK) {
            for match_ in block {
                let error = self.squared_error(match_, camera_from_world) / threshold;
                cost += error.min(1.0);
            }
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
    /// the map points along their rays, and the errors that the points of a mapped frame share
    /// ([`MapNoise`]) as unknowns with a prior.
    fn refined(
        &self,
        matches: &[Correspondence],
        camera_from_world: Isometry3<f64>,
    ) -> Option<Found> {
        let inliers = self.inliers(matches, &camera_from_world);
        let mut pose = camera_from_world.inverse();
        let mut shared: BTreeMap<usize, SharedErrors> = inliers
            .iter()
            .map(|&place| (matches[place].frame, SharedErrors::zeros()))
            .collect();

        for _ in 0..FINAL_STEPS {
            let normal = self.normal_equations(matches, &inliers, &pose, &shared);
            let step = normal.step()?;
            normal.update_shared(&step, &mut shared);
            pose *= exp(&Twist::from_vector(&step));
            if step.norm() < 1e-7 {
                break;
            }
        }

        let normal = self.normal_equations(matches, &inliers, &pose, &shared);
        let information = normal.information(&self.noise);
        let inliers = self.inliers(matches, &pose.inverse());
        Some(Found {
            pose,
            inliers,
            information,
        })
    }

    fn normal_equations(
        &self,
        matches: &[Correspondence],
        inliers: &[usize],
        pose: &Pose,
        shared: &BTreeMap<usize, SharedErrors>,
    ) -> JointEquations {
        let prior = self.noise.information();
        let mut frames: BTreeMap<usize, FrameEquations> = shared
            .iter()
            .map(|(&frame, errors)| (frame, FrameEquations::prior(&prior, errors)))
            .collect();

        let camera_from_world = pose.rotation.inverse();
        for &place in inliers {
            let match_ = &matches[place];
            let (Some(errors), Some(equations)) =
                (shared.get(&match_.frame), frames.get_mut(&match_.frame))
            else {
                continue;
            };

            let by_errors = match_.by_shared_errors();
            let moved = Correspondence {
                world: match_.world + by_errors * errors,
                ..*match_
            };
            let Some(row) = self.linearized(&moved, pose) else {
                continue;
            };

            // Position noise of the keypoint, and of the map point along its ray.
            let by_world = row.by_point * camera_from_world.to_rotation_matrix();
            let along = by_world * match_.from_frame * match_.deviation;
            let covariance = (Matrix2::identity() + along * along.transpose())
                * (self.deviation_px * self.deviation_px);
            let Some(inverse) = covariance.try_inverse() else {
                continue;
            };
            let squared = row.residual.dot(&(inverse * row.residual));
            let weight = (DEGREES_OF_FREEDOM + 2.0) / (DEGREES_OF_FREEDOM + squared);
            equations.add(&row, &(by_world * by_errors), &(inverse * weight));
        }

        JointEquations { frames }
    }

    /// The residual of a match in pixels, and its derivatives; `None` behind the camera.
    fn linearized(&self, match_: &Correspondence, pose: &Pose) -> Option<Linearized> {
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
struct Linearized {
    residual: Vector2<f64>,
    /// By a step δ of the pose on the right, ordered (v, ω).
    by_step: Matrix2x6<f64>,
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

/// The part of one mapped frame in the joint normal equations of the pose and of the errors that
/// the frame's points share.
struct FrameEquations {
    pose: NormalEquations,
    mixed: SMatrix<f64, 6, SHARED>,
    shared: SMatrix<f64, SHARED, SHARED>,
    shared_gradient: SharedErrors,
}

impl FrameEquations {
    fn prior(information: &SharedErrors, errors: &SharedErrors) -> Self {
        Self {
            pose: NormalEquations::default(),
            mixed: SMatrix::zeros(),
            shared: SMatrix::from_diagonal(information),
            shared_gradient: -information.component_mul(errors),
        }
    }

    fn add(
        &mut self,
        row: &Linearized,
        by_shared: &SMatrix<f64, 2, SHARED>,
        weight: &Matrix2<f64>,
    ) {
        self.pose.add(row, weight);
        let weighted = by_shared.transpose() * weight;
        self.shared += weighted * by_shared;
        self.shared_gradient += weighted * row.residual;
        self.mixed += row.by_step.transpose() * weight * by_shared;
    }
}

/// Information of the matches of one mapped frame about δ in true = pose · exp(δ), ordered (v, ω),
/// and about the errors that the frame's points share.
#[derive(Debug, Clone, PartialEq)]
struct FrameInformation {
    pose: Matrix6<f64>,
    mixed: SMatrix<f64, 6, SHARED>,
    shared: SMatrix<f64, SHARED, SHARED>,
}

/// Information of a view's matches about its pose, for any noise of the map.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseInformation {
    frames: Vec<FrameInformation>,
    /// Distance of the view from the nearest matched frame, in units (median depths) plus radians.
    pub gap: f64,
}

impl PoseInformation {
    /// Covariance of δ in true = pose · exp(δ), ordered (v, ω), meters and radians, where the true
    /// pose is stated with the same noise as the poses of the map; `None` if the matches do not
    /// determine the pose.
    pub fn covariance(&self, noise: &MapNoise) -> Option<Matrix6<f64>> {
        let prior = SMatrix::<f64, SHARED, SHARED>::from_diagonal(&noise.information());
        let mut information = Matrix6::zeros();
        for frame in &self.frames {
            let share = noise.design_effect.recip();
            let factors = Cholesky::new(frame.shared * share + prior)?;
            let mixed = frame.mixed * share;
            information += frame.pose * share - mixed * factors.solve(&mixed.transpose());
        }

        // The stated poses drift, and depths err together: both errors grow with the distance from
        // the matched frames.
        let variance = |still: f64, growth: f64| still.powi(2) + (growth * self.gap).powi(2);
        let v = variance(noise.translation_m, noise.translation_growth_m);
        let w = variance(noise.rotation_rad, noise.rotation_growth_rad);
        let drift = Matrix6::from_diagonal(&Vector6::new(v, v, v, w, w, w));
        let covariance = Cholesky::new(information)?.inverse() + drift;
        Some((covariance + covariance.transpose()) * 0.5)
    }
}

/// Joint normal equations: the shared errors of different frames are independent given the pose.
struct JointEquations {
    frames: BTreeMap<usize, FrameEquations>,
}

impl JointEquations {
    /// The equations of the pose, with all shared errors eliminated.
    fn reduced(&self) -> NormalEquations {
        let mut reduced = NormalEquations::default();
        for frame in self.frames.values() {
            let Some(factors) = Cholesky::new(frame.shared) else {
                continue;
            };
            let solved = factors.solve(&frame.mixed.transpose());
            reduced.information += frame.pose.information - frame.mixed * solved;
            reduced.gradient += frame.pose.gradient - solved.transpose() * frame.shared_gradient;
        }

        reduced
    }

    fn step(&self) -> Option<Vector6<f64>> {
        self.reduced().step()
    }

    /// The information of the matches alone, without the prior on the shared errors.
    fn information(&self, noise: &MapNoise) -> PoseInformation {
        let prior = SMatrix::<f64, SHARED, SHARED>::from_diagonal(&noise.information());
        let frames = self.frames.values().map(|frame| FrameInformation {
            pose: frame.pose.information,
            mixed: frame.mixed,
            shared: frame.shared - prior,
        });
        PoseInformation {
            frames: frames.collect(),
            gap: 0.0,
        }
    }

    /// Adds to the shared errors their steps that belong to a step of the pose.
    fn update_shared(&self, step: &Vector6<f64>, shared: &mut BTreeMap<usize, SharedErrors>) {
        for (frame, errors) in shared {
            let Some(equations) = self.frames.get(frame) else {
                continue;
            };
            let gradient = equations.shared_gradient - equations.mixed.transpose() * step;
            if let Some(factors) = Cholesky::new(equations.shared) {
                *errors += factors.solve(&gradient);
            }
        }
    }
}

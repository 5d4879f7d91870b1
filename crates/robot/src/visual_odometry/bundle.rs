//! Bundle adjustment: camera poses and landmark depths that explain the matched keypoints best.
//!
//! A landmark lies on the ray of a keypoint of one camera, its anchor, at an unknown inverse depth
//! ρ with a Gaussian prior. The depths are eliminated from the normal equations (Schur complement).
//! Reprojection errors have Student-t weights.

use nalgebra::{
    Cholesky, DMatrix, DVector, Matrix2x3, Matrix3, Matrix6, Matrix6x2, UnitQuaternion, Vector2,
    Vector3, Vector6,
};

use seese3_core::geometry::{Pose, Twist, exp};
use seese3_core::statistics::median;

/// Degrees of freedom of the Student-t distribution of a reprojection error.
const DEGREES_OF_FREEDOM: f64 = 4.0;
/// Minimum depth of a landmark in a camera, in depths in its anchor.
const MIN_DEPTH: f64 = 0.05;
/// Squared error of an observation behind the camera, squared standard deviations.
const BEHIND: f64 = 1e4;
/// Minimum inverse depth of a landmark, in prior means.
const LEAST_INVERSE_DEPTH: f64 = 0.02;
/// Minimum inverse depth of a landmark of a reversed scene, in medians.
const LEAST_REVERSED: f64 = 0.2;
/// Damping of the first Levenberg–Marquardt step, the smallest, and the largest that is tried.
const FIRST_DAMPING: f64 = 1e-4;
const MIN_DAMPING: f64 = 1e-9;
const MAX_DAMPING: f64 = 1e3;
/// Relative decrease of the cost below which the adjustment ends.
const LEAST_DECREASE: f64 = 1e-4;
/// Factors on the deviation of observations far from the minimum, with the number of steps. Larger
/// deviations smooth out local minima.
const ANNEALING: [(f64, usize); 2] = [(8.0, 4), (3.0, 4)];

/// A landmark and its matched keypoints.
#[derive(Debug, Clone)]
pub(super) struct BundleLandmark {
    /// Camera of the anchor.
    pub anchor: usize,
    /// The keypoint of the anchor, (x, y, 1) on the plane at depth 1.
    pub direction: Vector3<f64>,
    /// Inverse depth ρ in the anchor, 1/m.
    pub inverse_depth: f64,
    /// Prior of ρ: mean and standard deviation.
    pub prior: [f64; 2],
    /// Matched keypoints: camera, and the point on the plane at depth 1.
    pub observations: Vec<(usize, Vector2<f64>)>,
    /// Standard deviation of ρ for known camera poses; set by the adjustment.
    pub deviation: f64,
}

/// What an adjustment minimizes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Objective {
    /// The posterior of poses and depths together. It suits landmarks with enough parallax.
    Joint,
    /// The posterior of the poses, with the depths integrated out (Laplace's approximation).
    /// Without parallax, the joint posterior prefers any translation to none: each depth absorbs
    /// some noise.
    Marginal,
}

/// Cameras and landmarks.
#[derive(Debug, Clone)]
pub(super) struct Bundle {
    /// `odom_from_camera`.
    pub poses: Vec<Pose>,
    /// Whether the adjustment may change each pose.
    pub is_free: Vec<bool>,
    pub landmarks: Vec<BundleLandmark>,
    pub objective: Objective,
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Standard deviation of a reprojection error along one axis, pixels.
    pub deviation_px: f64,
}

/// `camera_from_anchor` of the observations of a bundle.
struct Relative {
    count: usize,
    poses: Vec<Option<(Matrix3<f64>, Vector3<f64>)>>,
}

impl Relative {
    fn of(bundle: &Bundle) -> Self {
        let count = bundle.poses.len();
        let mut poses = vec![None; count * count];
        for landmark in &bundle.landmarks {
            for (camera, _) in &landmark.observations {
                poses[camera * count + landmark.anchor].get_or_insert_with(|| {
                    let camera_from_anchor =
                        bundle.poses[*camera].inv_mul(&bundle.poses[landmark.anchor]);
                    let rotation = camera_from_anchor.rotation.to_rotation_matrix();
                    (rotation.into_inner(), camera_from_anchor.translation.vector)
                });
            }
        }
        Self { count, poses }
    }

    fn get(&self, camera: usize, anchor: usize) -> (Matrix3<f64>, Vector3<f64>) {
        self.poses[camera * self.count + anchor]
            .unwrap_or_else(|| (Matrix3::identity(), Vector3::zeros()))
    }

    /// The landmark from a camera, in units of its depth in the anchor; `None` behind the camera.
    fn seen(&self, landmark: &BundleLandmark, camera: usize) -> Option<Vector3<f64>> {
        let (rotation, shift) = self.get(camera, landmark.anchor);
        let seen = rotation * landmark.direction + shift * landmark.inverse_depth;
        (seen.z > MIN_DEPTH).then_some(seen)
    }
}

/// A reprojection error, pixels, with the derivatives of the projection.
struct Row {
    residual: Vector2<f64>,
    /// By a step (v, ω) on the right of the pose of the observing camera, and of the anchor.
    by_camera: Matrix6x2<f64>,
    by_anchor: Matrix6x2<f64>,
    /// By ρ.
    by_depth: Vector2<f64>,
    /// Of `by_depth`, by the translations of both steps.
    slope_by_camera: Matrix6x2<f64>,
    slope_by_anchor: Matrix6x2<f64>,
}

/// Normal equations of the free poses, after the elimination of the depths.
struct Normal {
    information: DMatrix<f64>,
    gradient: DVector<f64>,
    depths: Vec<EliminatedDepth>,
}

/// The part of the normal equations of one landmark's depth.
struct EliminatedDepth {
    curvature: f64,
    gradient: f64,
    /// Mixed second derivatives, by free pose.
    mixed: Vec<(usize, Vector6<f64>)>,
}

impl Bundle {
    /// Minimizes the cost from poses that may be far from the minimum, with at most `steps`
    /// Levenberg–Marquardt steps at the end.
    pub fn adjust_from_afar(&mut self, steps: usize) {
        let deviation_px = self.deviation_px;
        for (factor, steps) in ANNEALING {
            self.deviation_px = factor * deviation_px;
            self.adjust(steps);
        }

        self.deviation_px = deviation_px;
        self.adjust(steps);
    }

    /// The bundle with the relief of the scene reversed: near landmarks are far, and the free
    /// cameras move to the opposite side of the last fixed one. Both explain small parallax almost
    /// equally well (the reversal of Necker's cube), so an adjustment that starts at one of them
    /// does not find the other.
    pub fn reversed(&self) -> Self {
        let mut reversed = self.clone();
        let Some(first_free) = self.is_free.iter().position(|is_free| *is_free) else {
            return reversed;
        };
        let fixed = self.poses[first_free.saturating_sub(1)];
        let depths: Vec<f64> = self
            .landmarks
            .iter()
            .map(|landmark| landmark.inverse_depth)
            .collect();
        if depths.is_empty() {
            return reversed;
        }

        let middle = median(&depths);
        let center = Vector3::z() / middle;
        let free = reversed.poses.iter_mut().zip(&self.is_free);
        for (pose, _) in free.filter(|(_, is_free)| **is_free) {
            let from_fixed = fixed.inv_mul(pose);
            let shift = from_fixed.translation.vector;
            let opposite = Vector3::new(-shift.x, -shift.y, shift.z);
            let turn = UnitQuaternion::rotation_between(&(center - shift), &(center - opposite));
            let rotation = turn.unwrap_or_default() * from_fixed.rotation;
            *pose = fixed * Pose::from_parts(opposite.into(), rotation);
        }
        for landmark in &mut reversed.landmarks {
            let opposite = 2.0 * middle - landmark.inverse_depth;
            landmark.inverse_depth = opposite.max(LEAST_REVERSED * middle);
        }
        reversed
    }

    /// Minimizes the cost with at most `steps` Levenberg–Marquardt steps.
    pub fn adjust(&mut self, steps: usize) {
        let mut damping = FIRST_DAMPING;
        let mut cost = self.cost();
        for _ in 0..steps {
            let normal = self.normal();
            let mut lower = None;
            while damping < MAX_DAMPING && lower.is_none() {
                let tried = self.stepped(&normal, damping);
                lower = tried
                    .map(|tried| (tried.cost(), tried))
                    .filter(|(at, _)| *at < cost);
                damping *= if lower.is_some() { 0.1 } else { 10.0 };
            }

            let Some((at, tried)) = lower else { break };
            damping = damping.max(MIN_DAMPING);
            let decrease = (cost - at) / cost;
            *self = tried;
            cost = at;
            if decrease < LEAST_DECREASE {
                break;
            }
        }

        let normal = self.normal();
        for (landmark, depth) in self.landmarks.iter_mut().zip(&normal.depths) {
            landmark.deviation = depth.curvature.sqrt().recip();
        }
    }

    /// Covariance of δ of the only free pose, true = pose · exp(δ), ordered (v, ω), for independent
    /// errors; `None` if the observations do not determine it.
    pub fn covariance(&self) -> Option<Matrix6<f64>> {
        let normal = self.normal();
        let information: Matrix6<f64> = normal.information.fixed_view::<6, 6>(0, 0).into();
        Some(Cholesky::new(information)?.inverse())
    }

    /// Reprojection error of an observation, pixels; infinite behind the camera.
    pub fn error_px(&self, landmark: &BundleLandmark, camera: usize, point: &Vector2<f64>) -> f64 {
        let camera_from_anchor = self.poses[camera].inv_mul(&self.poses[landmark.anchor]);
        let seen = camera_from_anchor.rotation * landmark.direction
            + camera_from_anchor.translation.vector * landmark.inverse_depth;
        self.error_of(Some(seen).filter(|seen| seen.z > MIN_DEPTH), point)
    }

    fn error_of(&self, seen: Option<Vector3<f64>>, point: &Vector2<f64>) -> f64 {
        match seen {
            Some(seen) => (seen.xy() / seen.z - point).norm() * self.focal_px,
            None => f64::INFINITY,
        }
    }

    /// Twice the negative logarithm of the posterior density, up to a constant.
    pub fn cost(&self) -> f64 {
        let relative = Relative::of(self);
        let mut cost = 0.0;
        for landmark in &self.landmarks {
            let [mean, deviation] = landmark.prior;
            cost += ((landmark.inverse_depth - mean) / deviation).powi(2);
            if self.objective == Objective::Marginal {
                cost += (self.depth_curvature(landmark, &relative) * deviation * deviation).ln();
            }

            for (camera, point) in &landmark.observations {
                let seen = relative.seen(landmark, *camera);
                let error = self.error_of(seen, point) / self.deviation_px;
                let squared = (error * error).min(BEHIND);
                cost += (DEGREES_OF_FREEDOM + 2.0) * (squared / DEGREES_OF_FREEDOM).ln_1p();
            }
        }
        cost
    }

    /// Information about ρ for known poses, with full weights.
    fn depth_curvature(&self, landmark: &BundleLandmark, relative: &Relative) -> f64 {
        let of_observation = |&(camera, _): &(usize, Vector2<f64>)| {
            let Some(seen) = relative.seen(landmark, camera) else {
                return 0.0;
            };
            let (_, shift) = relative.get(camera, landmark.anchor);
            let slope = (shift.xy() - seen.xy() / seen.z * shift.z) / seen.z;
            slope.norm_squared() * (self.focal_px / self.deviation_px).powi(2)
        };
        let observations = landmark.observations.iter().map(of_observation);
        landmark.prior[1].powi(-2) + observations.sum::<f64>()
    }

    fn row(
        &self,
        landmark: &BundleLandmark,
        relative: &Relative,
        camera: usize,
        point: &Vector2<f64>,
    ) -> Option<Row> {
        let seen = relative.seen(landmark, camera)?;
        let (rotation, shift) = relative.get(camera, landmark.anchor);

        let projected = seen.xy() / seen.z;
        let by_seen = Matrix2x3::new(1.0, 0.0, -projected.x, 0.0, 1.0, -projected.y)
            * (self.focal_px / seen.z);
        let rows = |linear: Matrix2x3<f64>, angular: Matrix2x3<f64>| {
            let mut rows = Matrix6x2::zeros();
            rows.fixed_rows_mut::<3>(0).copy_from(&linear.transpose());
            rows.fixed_rows_mut::<3>(3).copy_from(&angular.transpose());
            rows
        };

        let of_camera = -by_seen;
        let of_anchor = by_seen * rotation;
        let turned_anchor = -of_anchor * landmark.direction.cross_matrix();
        Some(Row {
            residual: (point - projected) * self.focal_px,
            by_camera: rows(
                of_camera * landmark.inverse_depth,
                by_seen * seen.cross_matrix(),
            ),
            by_anchor: rows(of_anchor * landmark.inverse_depth, turned_anchor),
            by_depth: by_seen * shift,
            slope_by_camera: rows(of_camera, Matrix2x3::zeros()),
            slope_by_anchor: rows(of_anchor, Matrix2x3::zeros()),
        })
    }

    fn normal(&self) -> Normal {
        let mut columns = vec![None; self.poses.len()];
        let mut count = 0;
        for (column, &is_free) in columns.iter_mut().zip(&self.is_free) {
            if is_free {
                *column = Some(count);
                count += 1;
            }
        }

        let mut normal = Normal {
            information: DMatrix::zeros(6 * count, 6 * count),
            gradient: DVector::zeros(6 * count),
            depths: Vec::with_capacity(self.landmarks.len()),
        };
        let relative = Relative::of(self);
        for landmark in &self.landmarks {
            let depth = self.add_landmark(landmark, &relative, &columns, &mut normal);
            normal.eliminate(&depth);
            normal.depths.push(depth);
        }
        normal
    }

    /// Adds the observations of a landmark; the depth is not eliminated yet.
    fn add_landmark(
        &self,
        landmark: &BundleLandmark,
        relative: &Relative,
        columns: &[Option<usize>],
        normal: &mut Normal,
    ) -> EliminatedDepth {
        let [mean, deviation] = landmark.prior;
        let of_prior = deviation.powi(-2);
        let mut depth = EliminatedDepth {
            curvature: of_prior,
            gradient: (mean - landmark.inverse_depth) * of_prior,
            mixed: Vec::new(),
        };

        let variance = self.deviation_px.powi(2);
        let curvature = self.depth_curvature(landmark, relative);
        for (camera, point) in &landmark.observations {
            let Some(row) = self.row(landmark, relative, *camera, point) else {
                continue;
            };
            let squared = row.residual.norm_squared() / variance;
            let weight = (DEGREES_OF_FREEDOM + 2.0) / (DEGREES_OF_FREEDOM + squared) / variance;
            let ends = [columns[*camera], columns[landmark.anchor]];

            depth.curvature += weight * row.by_depth.norm_squared();
            depth.gradient += weight * row.by_depth.dot(&row.residual);
            let blocks = [row.by_camera, row.by_anchor];
            for (column, block) in ends.into_iter().zip(&blocks) {
                if let Some(column) = column {
                    depth.add(column, &(block * row.by_depth * weight));
                }
            }
            normal.add(ends, &blocks, &row.residual, weight);

            if self.objective == Objective::Marginal {
                let slopes = [row.slope_by_camera, row.slope_by_anchor];
                normal.add(
                    ends,
                    &slopes,
                    &-row.by_depth,
                    (variance * curvature).recip(),
                );
            }
        }
        depth
    }

    /// The bundle after a damped step; `None` if the normal equations are singular.
    fn stepped(&self, normal: &Normal, damping: f64) -> Option<Self> {
        let mut damped = normal.information.clone();
        for at in 0..damped.nrows() {
            damped[(at, at)] *= 1.0 + damping;
        }
        let step = Cholesky::new(damped)?.solve(&normal.gradient);
        if !step.iter().all(|value| value.is_finite()) {
            return None;
        }

        let mut stepped = self.clone();
        let free = (0..self.poses.len()).filter(|&camera| self.is_free[camera]);
        for (column, camera) in free.enumerate() {
            let of_pose: Vector6<f64> = step.fixed_rows::<6>(6 * column).into_owned();
            stepped.poses[camera] *= exp(&Twist::from_vector(&of_pose));
        }
        for (landmark, depth) in stepped.landmarks.iter_mut().zip(&normal.depths) {
            let mixed = depth.mixed.iter();
            let by_poses: f64 = mixed
                .map(|(column, mixed)| mixed.dot(&step.fixed_rows::<6>(6 * column)))
                .sum();
            let change = (depth.gradient - by_poses) / (depth.curvature * (1.0 + damping));
            let least = LEAST_INVERSE_DEPTH * landmark.prior[0];
            landmark.inverse_depth = (landmark.inverse_depth + change).max(least);
        }
        Some(stepped)
    }
}

impl Normal {
    /// Adds a residual with its derivatives by the free ones of two poses.
    fn add(
        &mut self,
        ends: [Option<usize>; 2],
        blocks: &[Matrix6x2<f64>; 2],
        residual: &Vector2<f64>,
        weight: f64,
    ) {
        let free = || ends.into_iter().zip(blocks);
        for (column, block) in free() {
            let Some(column) = column else { continue };
            let mut gradient = self.gradient.fixed_rows_mut::<6>(6 * column);
            gradient += block * residual * weight;
            for (other, by_other) in free() {
                let Some(other) = other else { continue };
                let product: Matrix6<f64> = block * by_other.transpose() * weight;
                let mut information = self
                    .information
                    .fixed_view_mut::<6, 6>(6 * column, 6 * other);
                information += product;
            }
        }
    }

    fn eliminate(&mut self, depth: &EliminatedDepth) {
        for (column, mixed) in &depth.mixed {
            let scaled = mixed / depth.curvature;
            let mut gradient = self.gradient.fixed_rows_mut::<6>(6 * column);
            gradient -= scaled * depth.gradient;
            for (other, by_other) in &depth.mixed {
                let mut information = self
                    .information
                    .fixed_view_mut::<6, 6>(6 * column, 6 * other);
                information -= scaled * by_other.transpose();
            }
        }
    }
}

impl EliminatedDepth {
    fn add(&mut self, column: usize, mixed: &Vector6<f64>) {
        match self.mixed.iter_mut().find(|(known, _)| *known == column) {
            Some((_, sum)) => *sum += mixed,
            None => self.mixed.push((column, *mixed)),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector6};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const FOCAL_PX: f64 = 300.0;

    /// Four cameras with these steps between them, and 80 points 1.5 to 4 m away. The first camera
    /// is fixed. Every landmark is anchored at one of the first two.
    fn scene(step: [f64; 6], noise_px: f64) -> Bundle {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let step = exp(&Twist::from_vector(&Vector6::from(step)));
        let poses: Vec<Pose> =
            std::iter::successors(Some(Pose::identity()), |pose| Some(pose * step))
                .take(4)
                .collect();

        let landmarks = (0..80)
            .map(|number| {
                let anchor = number % 2;
                let direction = Vector3::new(
                    rng.random_range(-0.4..0.4),
                    rng.random_range(-0.3..0.3),
                    1.0,
                );
                let inverse_depth: f64 = 1.0 / rng.random_range(1.5..4.0);
                let point = poses[anchor] * Point3::from(direction / inverse_depth);
                let others = (0..4).filter(|&camera| camera != anchor);
                let observations = others.map(|camera| {
                    let there = poses[camera].inverse_transform_point(&point).coords;
                    let mut noise = || noise_px / FOCAL_PX * rng.random_range(-1.7..1.7);
                    (
                        camera,
                        there.xy() / there.z + Vector2::new(noise(), noise()),
                    )
                });
                BundleLandmark {
                    anchor,
                    direction,
                    inverse_depth,
                    prior: [inverse_depth, inverse_depth],
                    observations: observations.collect(),
                    deviation: inverse_depth,
                }
            })
            .collect();
        Bundle {
            poses,
            is_free: vec![false, true, true, true],
            landmarks,
            objective: Objective::Joint,
            focal_px: FOCAL_PX,
            deviation_px: 1.0,
        }
    }

    const ARC: [f64; 6] = [0.1, -0.02, 0.03, 0.01, -0.05, 0.02];

    /// Oracle: central differences of the projection.
    #[test]
    fn the_derivatives_are_those_of_the_projection() {
        let scene = scene(ARC, 0.0);
        let landmark = &scene.landmarks[7];
        let (camera, point) = landmark.observations[2];
        let relative = Relative::of(&scene);
        let row = scene.row(landmark, &relative, camera, &point).unwrap();
        let projection = |scene: &Bundle, landmark: &BundleLandmark| {
            let seen = Relative::of(scene).seen(landmark, camera).unwrap();
            seen.xy() / seen.z * FOCAL_PX
        };

        let h = 1e-6;
        for axis in 0..6 {
            let moved = |of: usize, by: f64| {
                let mut scene = scene.clone();
                let mut step = Vector6::zeros();
                step[axis] = by;
                scene.poses[of] *= exp(&Twist::from_vector(&step));
                projection(&scene, landmark)
            };
            for (of, derivative) in [(camera, row.by_camera), (landmark.anchor, row.by_anchor)] {
                let expected = (moved(of, h) - moved(of, -h)) / (2.0 * h);
                let found = derivative.row(axis).transpose();
                assert!(
                    (found - expected).norm() < 1e-4,
                    "{axis}: {found} {expected}"
                );
            }
        }
        let deeper = |by: f64| {
            let mut landmark = landmark.clone();
            landmark.inverse_depth += by;
            projection(&scene, &landmark)
        };
        let expected = (deeper(h) - deeper(-h)) / (2.0 * h);
        assert!((row.by_depth - expected).norm() < 1e-4);
    }

    /// Oracle: the scene that made the observations. The priors of the depths, whose means are
    /// right, determine the scale.
    #[test]
    fn an_adjustment_finds_the_scene() {
        let truth = scene(ARC, 0.0);
        let mut found = truth.clone();
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for pose in &mut found.poses[1..] {
            let step = Vector6::from_fn(|_, _| rng.random_range(-0.03..0.03));
            *pose *= exp(&Twist::from_vector(&step));
        }
        for landmark in &mut found.landmarks {
            landmark.inverse_depth *= rng.random_range(0.7..1.3);
        }
        found.adjust(30);

        for (found, truth) in found.poses.iter().zip(&truth.poses) {
            let off = found.inv_mul(truth);
            assert!(off.translation.vector.norm() < 1e-4, "{off}");
            assert!(off.rotation.angle() < 1e-4, "{off}");
        }
    }

    /// Oracle: the motion, a rotation without translation. The joint posterior would explain noise
    /// by a translation at any depths.
    #[test]
    fn a_rotation_is_no_translation() {
        let truth = scene([0.0, 0.0, 0.0, 0.0, 0.05, 0.0], 1.0);
        let translation = |objective: Objective| {
            let mut found = truth.clone();
            found.objective = objective;
            // One camera, as in tracking; depths are unknown.
            found.is_free = vec![false, false, false, true];
            for landmark in &mut found.landmarks {
                landmark.prior = [0.4, 0.14];
                landmark.inverse_depth = 0.4;
                landmark.observations.retain(|(camera, _)| *camera == 3);
            }
            found.poses[3].translation.vector = Vector3::new(0.05, 0.0, 0.0);
            found.adjust_from_afar(20);
            found.poses[3]
                .inv_mul(&truth.poses[3])
                .translation
                .vector
                .norm()
        };
        let [marginal, joint] = [Objective::Marginal, Objective::Joint].map(translation);
        assert!(marginal < 0.01, "{marginal}");
        assert!(joint > 2.0 * marginal, "{joint} {marginal}");
    }

    /// Oracle: the true path, sideways and with little parallax. An adjustment that starts at the
    /// reversed scene stays there, at a higher cost; reversed again, it finds the path.
    #[test]
    fn a_reversed_scene_is_left_by_reversing_it() {
        let mut scene = scene([0.02, 0.0, 0.0, 0.0, 0.0, 0.0], 0.2);
        for landmark in &mut scene.landmarks {
            landmark.prior = [0.4, 1.0];
        }
        let way = |scene: &Bundle| scene.poses[3].translation.vector.x;
        let turn_rad = |scene: &Bundle| scene.poses[3].rotation.angle();

        let mut wrong = scene.reversed();
        wrong.adjust(20);
        assert!(way(&wrong) < -0.03, "{}", way(&wrong));
        assert!(turn_rad(&wrong) > 0.02, "{}", turn_rad(&wrong));

        let mut right = wrong.reversed();
        right.adjust(20);
        assert!(right.cost() < wrong.cost());
        assert!((way(&right) - 0.06).abs() < 0.02, "{}", way(&right));
        assert!(turn_rad(&right) < 0.005, "{}", turn_rad(&right));
    }
}

//! Maximum a posteriori motion from matches, with its covariance.
//!
//! A motion (R, t) is `first_from_second`, the pose of the second camera in the first. Small steps
//! (v, ω) are applied on its right.

use nalgebra::{
    Cholesky, Matrix2x6, Matrix3, Matrix6, Rotation3, Translation3, UnitQuaternion, Vector2,
    Vector3, Vector6,
};

use super::Match;
use seese3_core::geometry::Pose;

/// Prior mean of log ρ, ρ the inverse depth in 1/m, at a point (x, y) in normalized coordinates:
/// coefficients of 1, x, y, x², xy and y². The edges of an image are nearer than its center. Fitted
/// to drawn rooms and one photographed room.
const LOG_INVERSE_DEPTH: [f64; 6] = [-0.9446, -0.1065, -0.0705, 0.4672, 0.0214, 0.2502];

/// Candidate standard deviations of log ρ; the solution with the lowest cost is kept.
const DEPTH_SPREADS: [f64; 2] = [0.15, 0.3];

/// Degrees of freedom of the Student-t distribution of a match.
const DEGREES_OF_FREEDOM: f64 = 4.0;

/// Prior standard deviation of the rotation, radians.
const ROTATION_PRIOR: f64 = 1.0;

/// Initial translations of the search, meters.
const STARTS: [[f64; 3]; 5] = [
    [0.0, 0.0, 0.0],
    [0.2, 0.0, 0.0],
    [-0.2, 0.0, 0.0],
    [0.0, 0.0, 0.2],
    [0.0, 0.0, -0.2],
];

/// Annealing schedule: a factor on the match deviations and the maximum number of steps with it.
/// Larger deviations smooth out local minima.
const ANNEALING: [(f64, usize); 2] = [(8.0, 4), (3.0, 4)];

/// Number of the best annealed solutions that are refined, and the maximum number of steps.
const FINISHED: usize = 2;
const LAST_STEPS: usize = 12;

/// Cauchy scale of the initial rotation fit, radians.
const FIRST_GUESS_SCALE: f64 = 0.05;

/// Number of matches that count as one independent match, since errors of neighbors are correlated.
const DEPENDENCE: f64 = 300.0;

/// Zero-mean prior of the translation: its standard deviation as a fraction of the estimated
/// length, and in meters. It shrinks a translation that the matches constrain poorly.
const SHRINKAGE: (f64, f64) = (0.8, 0.02);

/// Scale factors and additional terms of the final covariance.
mod spread {
    /// Factor on the covariance from the matches.
    pub const MATCHES: f64 = 0.47;
    /// Standard deviation of the scale of the translation, as a fraction of its length: scene
    /// depths differ from the prior by a common factor.
    pub const SCALE: f64 = 0.31;
    /// Standard deviation of each translation component: fraction of the length, and meters.
    pub const SHARE: f64 = 0.10;
    pub const METERS: f64 = 0.006;
    /// Standard deviation of each rotation component: fraction of the angle, and radians.
    pub const TURN_SHARE: f64 = 0.06;
    pub const RADIANS: f64 = 0.004;
    /// Factor on the sum of all terms.
    pub const ALL: f64 = 1.165;
}

/// A motion hypothesis with the residuals of all matches.
pub(super) struct Found<'a> {
    matches: &'a [Match],
    /// Factor on the deviations of the matches.
    factor: f64,
    depth_spread: f64,
    rotation: Rotation3<f64>,
    translation: Vector3<f64>,
    seen: Vec<MatchedPoint>,
    /// Twice the negative log posterior density, up to a constant.
    cost: f64,
}

/// A match evaluated under a motion hypothesis.
#[derive(Clone, Copy)]
struct MatchedPoint {
    /// log ρ minus its prior mean.
    excess: f64,
    inverse_depth: f64,
    /// Vector to the point in the second camera's frame, in units of the depth in the first.
    direction: Vector3<f64>,
    /// Depth in the second camera, in units of the depth in the first; at least 0.05.
    depth: f64,
    /// Predicted point in the second image, and the residual of the match.
    expected: Vector2<f64>,
    residual: Vector2<f64>,
    /// Derivative of `expected` with respect to log ρ.
    by_depth: Vector2<f64>,
    /// Variance of the point due to the unknown depth, divided by the match's own variance.
    depth_share: f64,
    /// Student-t weight of the match, at most (ν + 2) / ν.
    weight: f64,
}

/// Finds the most probable motion for the matches.
pub(super) fn solve(matches: &[Match]) -> Found<'_> {
    let rotation = rotation_alone(matches);
    let unmoved = Guess {
        rotation,
        translation: Vector3::zeros(),
        excess: vec![0.0; matches.len()],
    };
    let mut best = Found::at(matches, 1.0, DEPTH_SPREADS[0], unmoved.clone());

    for depth_spread in DEPTH_SPREADS {
        let mut ends: Vec<Found<'_>> = STARTS
            .into_iter()
            .map(|start| {
                let mut guess = Guess {
                    translation: Vector3::from(start),
                    ..unmoved.clone()
                };
                for (factor, steps) in ANNEALING {
                    let mut found = Found::at(matches, factor, depth_spread, guess);
                    found.descend(steps);
                    guess = found.guess();
                }

                Found::at(matches, 1.0, depth_spread, guess)
            })
            .collect();

        ends.push(Found::at(matches, 1.0, depth_spread, best.guess()));
        ends.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        for mut end in ends.into_iter().take(FINISHED) {
            end.descend(LAST_STEPS);
            if end.cost < best.cost {
                best = end;
            }
        }
    }

    best
}

/// A motion, with each match's log inverse depth minus its prior mean.
#[derive(Clone)]
struct Guess {
    rotation: Rotation3<f64>,
    translation: Vector3<f64>,
    excess: Vec<f64>,
}

/// Fits a rotation to the directions of the matches with zero translation: Wahba's problem, with
/// Cauchy weights against outliers.
fn rotation_alone(matches: &[Match]) -> Rotation3<f64> {
    let ends: Vec<[Vector3<f64>; 2]> = matches
        .iter()
        .map(|matched| {
            [
                matched.direction.normalize(),
                matched.point.push(1.0).normalize(),
            ]
        })
        .collect();
    let mut rotation = Rotation3::identity();
    let mut weights = vec![1.0; matches.len()];

    for _ in 0..15 {
        let mut sum = Matrix3::zeros();
        for ((matched, [first, second]), weight) in matches.iter().zip(&ends).zip(&weights) {
            sum += first * second.transpose() * (weight / matched.deviation.powi(2));
        }

        // Nearest rotation by SVD; flip the weakest axis if the result is a reflection.
        let svd = sum.svd(true, true);
        let (Some(left), Some(right)) = (svd.u, svd.v_t) else {
            return rotation;
        };
        let mirror = Vector3::new(1.0, 1.0, (left * right).determinant());
        rotation = Rotation3::from_matrix_unchecked(left * Matrix3::from_diagonal(&mirror) * right);

        for (weight, [first, second]) in weights.iter_mut().zip(&ends) {
            let off = (first - rotation * second).norm_squared();
            *weight = 1.0 / (1.0 + off / FIRST_GUESS_SCALE.powi(2));
        }
    }

    rotation
}

impl<'a> Found<'a> {
    /// Evaluates the matches under a motion; each depth is optimized, starting from the guess.
    fn at(matches: &'a [Match], factor: f64, depth_spread: f64, guess: Guess) -> Self {
        let Guess {
            rotation,
            translation,
            excess,
        } = guess;
        let shift = rotation.inverse() * translation;
        let seen: Vec<MatchedPoint> = matches
            .iter()
            .zip(excess)
            .map(|(matched, excess)| {
                let direction = rotation.inverse() * matched.direction;
                MatchedPoint::of(
                    matched,
                    direction,
                    shift,
                    matched.deviation * factor,
                    depth_spread,
                    excess,
                )
            })
            .collect();

        let mut cost = rotation.scaled_axis().norm_squared() / ROTATION_PRIOR.powi(2);
        for (matched, seen) in matches.iter().zip(&seen) {
            let distance = seen.distance(matched.deviation * factor, depth_spread);
            cost += (DEGREES_OF_FREEDOM + 2.0) * (distance / DEGREES_OF_FREEDOM).ln_1p()
                + seen.depth_share.ln_1p();
        }

        Self {
            matches,
            factor,
            depth_spread,
            rotation,
            translation,
            seen,
            cost,
        }
    }

    /// The motion and the depths, as the start of another search.
    fn guess(&self) -> Guess {
        Guess {
            rotation: self.rotation,
            translation: self.translation,
            excess: self.seen.iter().map(|seen| seen.excess).collect(),
        }
    }

    /// Minimizes the cost by Levenberg–Marquardt, with at most `steps` steps.
    fn descend(&mut self, steps: usize) {
        let mut damping = 1e-4;
        for _ in 0..steps {
            let (information, depth_curvature, gradient) = self.normal_equations();
            let curvature = information + depth_curvature;
            let mut lower = None;

            for _ in 0..6 {
                let damped = curvature + Matrix6::from_diagonal(&(curvature.diagonal() * damping));
                let Some(step) = Cholesky::new(damped).map(|factors| factors.solve(&gradient))
                else {
                    damping = f64::max(damping * 10.0, 1e-3);
                    continue;
                };

                let tried = self.moved(&step);
                if tried.cost < self.cost {
                    damping = f64::max(damping / 10.0, 1e-7);
                    lower = Some(tried);
                    break;
                }
                damping = f64::max(damping * 10.0, 1e-3);
            }

            let Some(lower) = lower else { return };
            let gain = self.cost - lower.cost;
            *self = lower;
            if gain < 1e-2 {
                return;
            }
        }
    }

    /// Evaluates the matches under this motion followed by a small step, ordered (v, ω).
    fn moved(&self, step: &Vector6<f64>) -> Self {
        let linear = step.fixed_rows::<3>(0).into_owned();
        let angular = step.fixed_rows::<3>(3).into_owned();
        let guess = Guess {
            rotation: self.rotation * Rotation3::new(angular),
            translation: self.translation + self.rotation * linear,
            ..self.guess()
        };

        Self::at(self.matches, self.factor, self.depth_spread, guess)
    }

    /// Normal equations of a small step on the right, ordered (v, ω), with every depth eliminated:
    /// the information matrix, the additional curvature due to the unknown depths, and the negative
    /// gradient.
    fn normal_equations(&self) -> (Matrix6<f64>, Matrix6<f64>, Vector6<f64>) {
        let shift = self.rotation.inverse() * self.translation;
        let mut information = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        let mut by_shift = Matrix3::zeros();

        for (matched, seen) in self.matches.iter().zip(&self.seen) {
            let variance = (matched.deviation * self.factor).powi(2);
            let rows = seen.by_motion();

            // The Schur complement of the depth.
            let own = seen.by_depth.norm_squared() / variance + self.depth_spread.powi(-2);
            let slope = seen.by_depth.dot(&seen.residual) / variance
                - seen.excess / self.depth_spread.powi(2);
            let mixed = rows.transpose() * seen.by_depth / variance;

            information += seen.weight
                * (rows.transpose() * rows / variance - mixed * mixed.transpose() / own);
            gradient +=
                seen.weight * (rows.transpose() * seen.residual / variance - mixed * (slope / own));

            // Log-determinant term: the depth share is k |(I, −h) shift|², with h = `expected`.
            let share = (seen.inverse_depth * self.depth_spread / seen.depth).powi(2)
                / variance
                / (1.0 + seen.depth_share);
            let [x, y] = [seen.expected.x, seen.expected.y];
            by_shift += share * Matrix3::new(1.0, 0.0, -x, 0.0, 1.0, -y, -x, -y, x * x + y * y);
        }

        let prior = ROTATION_PRIOR.powi(-2);
        let turned = self.rotation.scaled_axis();
        let pull = by_shift * shift;
        let mut depth_curvature = Matrix6::zeros();
        for row in 0..3 {
            information[(3 + row, 3 + row)] += prior;
            gradient[3 + row] -= turned[row] * prior;
            gradient[row] -= pull[row];
        }
        depth_curvature
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&by_shift);

        (information, depth_curvature, gradient)
    }

    /// Effective number of inlier matches: the sum of their weights, 0 to 1 each.
    pub fn support(&self) -> f64 {
        let most = (DEGREES_OF_FREEDOM + 2.0) / DEGREES_OF_FREEDOM;
        self.seen.iter().map(|seen| seen.weight / most).sum()
    }

    /// The motion after shrinkage of the translation, and the covariance of ξ in
    /// true = motion · exp(ξ), ordered (v, ω). `None` if the matches are degenerate.
    pub fn shrunk_with_covariance(&self) -> Option<(Pose, Matrix6<f64>)> {
        let (share, meters) = SHRINKAGE;
        let (information, ..) = self.normal_equations();
        let shift = self.rotation.inverse() * self.translation;
        let towards_none = 1.0 / (share.powi(2) * shift.norm_squared() + meters.powi(2));

        let mut posterior = information / DEPENDENCE;
        let mut pull = Vector6::zeros();
        for row in 0..3 {
            posterior[(row, row)] += towards_none;
            pull[row] = -towards_none * shift[row];
        }

        let covariance = Cholesky::new(posterior)?.inverse();
        let step = covariance * pull;
        let drawn = self.moved(&step);
        let shift = drawn.rotation.inverse() * drawn.translation;

        let turned =
            spread::RADIANS.powi(2) + (spread::TURN_SHARE * drawn.rotation.angle()).powi(2);
        let even = spread::SHARE.powi(2) * shift.norm_squared() + spread::METERS.powi(2);
        let mut spread = covariance * spread::MATCHES;
        let along = shift * shift.transpose() * spread::SCALE.powi(2);
        for row in 0..3 {
            spread[(row, row)] += even;
            spread[(3 + row, 3 + row)] += turned;
            for column in 0..3 {
                spread[(row, column)] += along[(row, column)];
            }
        }

        let motion = Pose::from_parts(
            Translation3::from(drawn.translation),
            UnitQuaternion::from_rotation_matrix(&drawn.rotation),
        );
        Some((motion, spread * spread::ALL))
    }
}

impl MatchedPoint {
    /// Evaluates a match at its most probable depth. `turned` is its direction and `shift` the
    /// translation, both in the axes of the second camera.
    fn of(
        matched: &Match,
        turned: Vector3<f64>,
        shift: Vector3<f64>,
        deviation: f64,
        depth_spread: f64,
        excess: f64,
    ) -> Self {
        let prior = usual_log_inverse_depth(matched.direction.xy());
        let at = |excess: f64| {
            let inverse_depth = (prior + excess).exp();
            let direction = turned - shift * inverse_depth;
            let depth = direction.z.max(0.05);
            let expected = direction.xy() / depth;
            let by_depth = (shift.xy() - expected * shift.z) * (-inverse_depth / depth);

            Self {
                excess,
                inverse_depth,
                direction,
                depth,
                expected,
                residual: matched.point - expected,
                by_depth,
                depth_share: by_depth.norm_squared() * (depth_spread / deviation).powi(2),
                weight: 1.0,
            }
        };

        // Two Newton steps towards the most probable depth.
        let mut seen = at(excess);
        for _ in 0..2 {
            let slope = seen.by_depth.dot(&seen.residual) / deviation.powi(2)
                - seen.excess / depth_spread.powi(2);
            let curvature =
                seen.by_depth.norm_squared() / deviation.powi(2) + depth_spread.powi(-2);
            let step = (slope / curvature).clamp(-0.7, 0.7);
            seen = at((seen.excess + step).clamp(-3.0 * depth_spread, 3.0 * depth_spread));
        }

        seen.weight = (DEGREES_OF_FREEDOM + 2.0)
            / (DEGREES_OF_FREEDOM + seen.distance(deviation, depth_spread));
        seen
    }

    /// Squared Mahalanobis distance of the point from its prediction and of log ρ from its prior
    /// mean.
    fn distance(&self, deviation: f64, depth_spread: f64) -> f64 {
        self.residual.norm_squared() / deviation.powi(2) + (self.excess / depth_spread).powi(2)
    }

    /// Derivative of `expected` with respect to a small step on the right, ordered (v, ω).
    fn by_motion(&self) -> Matrix2x6<f64> {
        let mut rows = Matrix2x6::zeros();
        for axis in 0..2 {
            let mut by_direction = Vector3::zeros();
            by_direction[axis] = 1.0 / self.depth;
            by_direction[2] = -self.expected[axis] / self.depth;

            let by_turn = by_direction.cross(&self.direction);
            for column in 0..3 {
                rows[(axis, column)] = -self.inverse_depth * by_direction[column];
                rows[(axis, 3 + column)] = by_turn[column];
            }
        }

        rows
    }
}

/// Prior mean of log ρ at a point on the plane at depth 1.
pub(crate) fn usual_log_inverse_depth(point: Vector2<f64>) -> f64 {
    let [x, y] = [point.x, point.y];
    let terms = [1.0, x, y, x * x, x * y, y * y];

    LOG_INVERSE_DEPTH
        .iter()
        .zip(terms)
        .map(|(factor, term)| factor * term)
        .sum()
}

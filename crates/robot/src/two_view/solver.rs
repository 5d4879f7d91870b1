//! Maximum a posteriori motion from matches, with its covariance.
//!
//! A motion (R, t) is `first_from_second`, the pose of the second camera in the first. Small steps
//! (v, ω) are applied on its right.

use nalgebra::{
    Cholesky, Matrix3, Matrix6, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6,
};

use super::Match;
use super::seen::{Hypothesis, Lanes, Matches, NormalEquations, Seen};
use seese3_core::geometry::Pose;

/// Candidate standard deviations of log ρ; the solution with the lowest cost is kept.
const DEPTH_SPREADS: [f64; 2] = [0.15, 0.3];

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
    matches: &'a Matches,
    hypothesis: Hypothesis,
    seen: Seen,
    /// Twice the negative log posterior density, up to a constant.
    cost: f64,
}

/// Finds the most probable motion for matches, which `blocks` holds too.
pub(super) fn solve<'a>(matches: &[Match], blocks: &'a Matches) -> Found<'a> {
    let rotation = rotation_alone(matches);
    let usual = blocks.usual_depths();
    let at = |translation: Vector3<f64>, factor: f64, depth_spread: f64| Hypothesis {
        rotation,
        translation,
        factor,
        depth_spread,
    };
    let mut best = Found::at(blocks, at(Vector3::zeros(), 1.0, DEPTH_SPREADS[0]), &usual);

    for depth_spread in DEPTH_SPREADS {
        let mut ends: Vec<Found<'_>> = STARTS
            .into_iter()
            .map(|start| {
                let [(smoothest, steps), (smoother, more_steps)] = ANNEALING;
                let start = at(Vector3::from(start), smoothest, depth_spread);
                let mut found = Found::at(blocks, start, &usual);
                found.descend(steps);

                found = found.with(smoother, depth_spread);
                found.descend(more_steps);
                found.with(1.0, depth_spread)
            })
            .collect();

        ends.push(best.with(1.0, depth_spread));
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
    /// The matches under a hypothesis; each depth is optimized from its excess.
    fn at(matches: &'a Matches, hypothesis: Hypothesis, excess: &[Lanes]) -> Self {
        let seen = matches.seen(&hypothesis, excess);
        let turned = hypothesis.rotation.scaled_axis().norm_squared();
        Self {
            matches,
            hypothesis,
            cost: turned / ROTATION_PRIOR.powi(2) + seen.cost,
            seen,
        }
    }

    /// The same motion under other assumptions.
    fn with(&self, factor: f64, depth_spread: f64) -> Self {
        let hypothesis = Hypothesis {
            factor,
            depth_spread,
            ..self.hypothesis
        };
        Self::at(self.matches, hypothesis, &self.seen.excess())
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
        let Hypothesis {
            rotation,
            translation,
            ..
        } = self.hypothesis;
        let hypothesis = Hypothesis {
            rotation: rotation * Rotation3::new(angular),
            translation: translation + rotation * linear,
            ..self.hypothesis
        };

        Self::at(self.matches, hypothesis, &self.seen.excess())
    }

    /// The translation in the axes of the second camera, meters.
    fn shift(&self) -> Vector3<f64> {
        self.hypothesis.rotation.inverse() * self.hypothesis.translation
    }

    /// Normal equations of a small step on the right, ordered (v, ω), with every depth eliminated:
    /// the information matrix, the additional curvature due to the unknown depths, and the negative
    /// gradient.
    fn normal_equations(&self) -> (Matrix6<f64>, Matrix6<f64>, Vector6<f64>) {
        let NormalEquations {
            mut information,
            depth_curvature: by_shift,
            mut gradient,
        } = self.matches.normal_equations(&self.hypothesis, &self.seen);

        let prior = ROTATION_PRIOR.powi(-2);
        let turned = self.hypothesis.rotation.scaled_axis();
        let pull = by_shift * self.shift();
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
        self.matches.support(&self.seen)
    }

    /// The motion after shrinkage of the translation, and the covariance of ξ in
    /// true = motion · exp(ξ), ordered (v, ω). `None` if the matches are degenerate.
    pub fn shrunk_with_covariance(&self) -> Option<(Pose, Matrix6<f64>)> {
        let (share, meters) = SHRINKAGE;
        let (information, ..) = self.normal_equations();
        let shift = self.shift();
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
        let shift = drawn.shift();
        let Hypothesis {
            rotation,
            translation,
            ..
        } = drawn.hypothesis;

        let turned = spread::RADIANS.powi(2) + (spread::TURN_SHARE * rotation.angle()).powi(2);
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
            Translation3::from(translation),
            UnitQuaternion::from_rotation_matrix(&rotation),
        );
        Some((motion, spread * spread::ALL))
    }
}

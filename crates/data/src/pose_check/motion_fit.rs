//! Fits stated camera motions to image motions and measures the explained share.

use super::ObservedPair;
use seese3_core::geometry::Pose;

/// Minimum share of the motion that translations must explain for a depth estimate.
const TELLS_DEPTH: f64 = 0.03;
/// Scale of the Cauchy weight of a pair's residual, image widths and radians together. It reduces
/// the influence of failed alignments and of objects close to the camera.
const ROBUST_MOTION: f64 = 0.02;
/// Number of rounds of a fit; pairs are reweighted after each.
const ROUNDS: usize = 8;

/// Focal length and depth fitted to the images, assuming that the poses are right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneEstimate {
    /// The focal length, image widths: about 0.8 for a phone or a webcam, 0 if the camera does not
    /// turn.
    pub focal: f64,
    /// The typical depth of the scene, in the unit of the translations. `None` if rotations explain
    /// nothing, or translations explain too little of the motion.
    pub depth: Option<f64>,
}

/// The result of fitting camera motions to image motions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MotionFit {
    /// The explained share of the motion, 0 to 1, with shifts in image widths, turns in radians and
    /// growths taken together. A pair whose residual exceeds its motion counts as 0, not less.
    pub explained: f64,
    /// The best-fitting focal length and depth.
    pub seen: SceneEstimate,
}

/// The regressors of one observed number: it is predicted as a factor times `by_rotation` plus a
/// factor times `by_translation`.
#[derive(Clone, Copy, Default)]
struct Causes {
    by_rotation: f64,
    by_translation: f64,
}

/// A pair of frames: the observed shift right, shift down, turn and growth, with their regressors.
struct Pair {
    observed: [f64; 4],
    causes: [Causes; 4],
}

/// The non-negative factors of the regressors.
#[derive(Debug, Clone, Copy, Default)]
struct Factors {
    rotation: f64,
    translation: f64,
}

/// The index of each observed number's factors. Both shifts share the first: focal length, and
/// focal length over depth.
const KIND: [usize; 4] = [0, 0, 1, 2];

/// Fits camera motions, `first_from_second` in the first camera's axes, to the motions of images.
pub(super) fn fit_motions(motions: &[Pose], observed: &[ObservedPair]) -> MotionFit {
    let pairs: Vec<Pair> = motions
        .iter()
        .zip(observed)
        .map(|(motion, pair)| pair_of(motion, pair))
        .collect();
    let (explained, factors) = fit(&pairs);

    let turning = pairs.into_iter().map(|pair| Pair {
        causes: pair.causes.map(|causes| Causes {
            by_translation: 0.0,
            ..causes
        }),
        ..pair
    });
    let (explained_by_rotations, _) = fit(&turning.collect::<Vec<_>>());

    // If translations explain little, the depth would be a quotient of noise.
    let of_shifts = factors[KIND[0]];
    let has_both = of_shifts.rotation > 0.0 && of_shifts.translation > 0.0;
    let tells_depth = has_both && explained - explained_by_rotations >= TELLS_DEPTH;
    MotionFit {
        explained,
        seen: SceneEstimate {
            focal: of_shifts.rotation,
            depth: tells_depth.then(|| of_shifts.rotation / of_shifts.translation),
        },
    }
}

/// The residual of each pair's motion, image widths and radians together.
pub(super) fn unexplained(motions: &[Pose], observed: &[ObservedPair]) -> Vec<f64> {
    let pairs = motions.iter().zip(observed);
    let pairs: Vec<Pair> = pairs.map(|(motion, pair)| pair_of(motion, pair)).collect();
    let (_, factors) = fit(&pairs);

    pairs.iter().map(|pair| residual(pair, &factors)).collect()
}

fn pair_of(motion: &Pose, pair: &ObservedPair) -> Pair {
    let turn = motion.rotation.scaled_axis();
    let moved = motion.translation.vector;
    let causes = |by_rotation, by_translation| Causes {
        by_rotation,
        by_translation,
    };

    let seen = pair.motion;
    Pair {
        observed: [seen.shift.x, seen.shift.y, seen.turn, seen.growth],
        causes: [
            causes(-turn.y, -moved.x),
            causes(turn.x, -moved.y),
            causes(-turn.z, 0.0),
            causes(0.0, moved.z),
        ],
    }
}

/// Fits the factors of shifts, turns and growths, and returns them with the explained share.
fn fit(pairs: &[Pair]) -> (f64, [Factors; 3]) {
    let mut factors = [Factors::default(); 3];
    let mut weights = vec![1.0; pairs.len()];
    for _ in 0..ROUNDS {
        factors = std::array::from_fn(|kind| factors_of(kind, pairs, &weights));
        for (weight, pair) in weights.iter_mut().zip(pairs) {
            *weight = (1.0 + (residual(pair, &factors) / ROBUST_MOTION).powi(2)).recip();
        }
    }

    let mut explained = 0.0;
    let mut total = 0.0;
    for pair in pairs {
        let motion = pair.observed.iter().map(|number| number * number);
        let motion = motion.sum::<f64>().sqrt();
        if motion > 0.0 {
            explained += motion * (1.0 - (residual(pair, &factors) / motion).powi(2)).max(0.0);
            total += motion;
        }
    }

    (if total > 0.0 { explained / total } else { 0.0 }, factors)
}

/// The distance between a pair's observed and predicted motion.
fn residual(pair: &Pair, factors: &[Factors; 3]) -> f64 {
    let numbers = pair.observed.iter().zip(&pair.causes).zip(KIND);
    let squares = numbers.map(|((observed, causes), kind)| {
        let Factors {
            rotation,
            translation,
        } = factors[kind];
        let expected = rotation * causes.by_rotation + translation * causes.by_translation;
        (observed - expected).powi(2)
    });

    squares.sum::<f64>().sqrt()
}

/// Weighted least squares with non-negative factors.
fn factors_of(kind: usize, pairs: &[Pair], weights: &[f64]) -> Factors {
    let mut rr = 0.0;
    let mut tt = 0.0;
    let mut rt = 0.0;
    let mut ro = 0.0;
    let mut to = 0.0;
    for (pair, weight) in pairs.iter().zip(weights) {
        for (number, causes) in pair.causes.iter().enumerate() {
            if KIND[number] == kind {
                let observed = pair.observed[number];
                rr += weight * causes.by_rotation * causes.by_rotation;
                tt += weight * causes.by_translation * causes.by_translation;
                rt += weight * causes.by_rotation * causes.by_translation;
                ro += weight * causes.by_rotation * observed;
                to += weight * causes.by_translation * observed;
            }
        }
    }

    // At the optimum, either no factor is constrained or one is 0. If one is 0, keep the one that
    // reduces the sum of squares more.
    let quotient = |observed: f64, cause: f64| match observed / cause {
        factor if factor.is_finite() => factor.max(0.0),
        _ => 0.0,
    };
    let determinant = rr * tt - rt * rt;
    let rotation = (ro * tt - to * rt) / determinant;
    let translation = (to * rr - ro * rt) / determinant;
    if determinant > 1e-9 * rr * tt && rotation >= 0.0 && translation >= 0.0 {
        return Factors {
            rotation,
            translation,
        };
    }

    let turns_alone = quotient(ro, rr);
    let moves_alone = quotient(to, tt);
    if turns_alone * ro >= moves_alone * to {
        Factors {
            rotation: turns_alone,
            translation: 0.0,
        }
    } else {
        Factors {
            rotation: 0.0,
            translation: moves_alone,
        }
    }
}

//! How well stated camera motions explain the motion of images.

use super::ObservedPair;
use seese3_core::geometry::Pose;

/// The depth is told only where translations explain at least this share of the motion.
const TELLS_DEPTH: f64 = 0.03;
/// Pairs whose motion is off by more than this, image widths and radians together, count for less and
/// less in a fit: their alignment went wrong, or something near to the camera fills the image.
const ROBUST_MOTION: f64 = 0.02;
/// Rounds of a fit; pairs are weighed again after each.
const ROUNDS: usize = 8;

/// What the images tell of the camera and of the scene, if the poses are right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneEstimate {
    /// The focal length, image widths; about 0.8 for a phone or a webcam; 0 if the camera does not turn.
    pub focal: f64,
    /// How far away the things in view are, in the unit of the translations; none if the camera
    /// moves too little, or along a line that tells nothing.
    pub depth: Option<f64>,
}

/// How much of the motion of images a list of camera motions explains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MotionFit {
    /// The share of the motion that is explained, 0 to 1: shifts in image widths, turns in radians
    /// and growths, taken together. A pair whose residual is larger than its motion counts as 0, and
    /// not as less.
    pub explained: f64,
    /// The focal length and the depth that fit best.
    pub seen: SceneEstimate,
}

/// What one observed number would be by a stated rotation and by a stated translation, each times a
/// factor: the regressors of the fit.
#[derive(Clone, Copy, Default)]
struct Causes {
    by_rotation: f64,
    by_translation: f64,
}

/// A pair of frames: right, down, turn and growth, and their causes.
struct Pair {
    observed: [f64; 4],
    causes: [Causes; 4],
}

/// The factors that causes are multiplied by, none below 0.
#[derive(Debug, Clone, Copy, Default)]
struct Factors {
    rotation: f64,
    translation: f64,
}

/// Which factors a number is predicted by: both shifts have those of focal length and depth.
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

    // Where translations explain little, the depth would be a quotient of noise.
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

/// What of each pair's motion is not explained, image widths and radians together.
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

/// The share of the motion that is explained, and the factors of shifts, turns and growths.
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

/// How far a pair's motion is from the predicted one.
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

/// Weighted least squares with factors that may not be negative.
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

    // The best factors lie inside, where both are positive, or on an edge, where one is 0. What they
    // take off the sum of squares tells which.
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

//! Scores of predicted motions: R² per component.

use nalgebra::{Vector3, Vector6};

use crate::geometry::Twist;
use crate::statistics::mean_of_known;

/// Minimum true translation |v| for a direction score, meters.
pub const LEAST_DIRECTED_M: f64 = 1e-3;

/// R² of predicted twists. A component with constant targets has no R² and is excluded from the
/// means; a mean without components is NaN.
///
/// R² = 1 − Σ(y − ŷ)² / Σ(y − ȳ)², with ȳ the mean of the evaluated targets (scikit-learn's
/// `r2_score`).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MotionScores {
    /// Number of pairs.
    pub n: usize,
    /// R² of each component, (v, ω); NaN for a constant component.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "nulls_as_nan"))]
    pub components: [f64; 6],
    /// Mean of the components' R².
    #[cfg_attr(feature = "serde", serde(deserialize_with = "null_as_nan"))]
    pub overall: f64,
    /// Mean over the components of v.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "null_as_nan"))]
    pub translation: f64,
    /// Mean over the components of ω.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "null_as_nan"))]
    pub rotation: f64,
    /// Mean R² of the components of v/|v|, over pairs with |v| > 1 mm.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "null_as_nan"))]
    pub direction: f64,
    /// R² of |v|.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "null_as_nan"))]
    pub magnitude: f64,
    /// Number of pairs excluded from `direction`, with |v| of at most 1 mm.
    pub direction_pairs_dropped: usize,
}

/// An undefined score is NaN, which JSON writes as null.
#[cfg(feature = "serde")]
fn null_as_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let score: Option<f64> = serde::Deserialize::deserialize(deserializer)?;
    Ok(score.unwrap_or(f64::NAN))
}

#[cfg(feature = "serde")]
fn nulls_as_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<[f64; 6], D::Error> {
    let scores: [Option<f64>; 6] = serde::Deserialize::deserialize(deserializer)?;
    Ok(scores.map(|score| score.unwrap_or(f64::NAN)))
}

impl MotionScores {
    /// Scores predictions against true motions, pair by pair. Both must have the same length.
    pub fn of(truth: &[Twist], predicted: &[Twist]) -> Self {
        let components: [f64; 6] =
            std::array::from_fn(|c| r2(pairs_of(truth, predicted, |twist| twist.to_vector()[c])));

        // Without translation the direction is noise: exclude such pairs.
        let moving: Vec<(Vector3<f64>, Vector3<f64>)> = truth
            .iter()
            .zip(predicted)
            .filter(|(truth, _)| truth.linear.norm() > LEAST_DIRECTED_M)
            .map(|(truth, predicted)| {
                // A predicted translation of zero stays zero instead of NaN.
                let length = predicted.linear.norm().max(1e-12);
                (truth.linear.normalize(), predicted.linear / length)
            })
            .collect();

        let direction: Vec<f64> = (0..3)
            .map(|c| r2(moving.iter().map(|(t, p)| (t[c], p[c])).collect()))
            .collect();

        Self {
            n: truth.len(),
            components,
            overall: mean_of_known(&components),
            translation: mean_of_known(&components[..3]),
            rotation: mean_of_known(&components[3..]),
            direction: mean_of_known(&direction),
            magnitude: r2(pairs_of(truth, predicted, |twist| twist.linear.norm())),
            direction_pairs_dropped: truth.len() - moving.len(),
        }
    }
}

impl MotionScores {
    /// Mean of several scores, field by field, ignoring NaN; counts are summed.
    pub fn mean(scores: &[Self]) -> Self {
        let of = |figure: fn(&Self) -> f64| {
            mean_of_known(&scores.iter().map(figure).collect::<Vec<_>>())
        };

        let component = |c: usize| {
            mean_of_known(
                &scores
                    .iter()
                    .map(|score| score.components[c])
                    .collect::<Vec<_>>(),
            )
        };

        Self {
            n: scores.iter().map(|score| score.n).sum(),
            components: std::array::from_fn(component),
            overall: of(|score| score.overall),
            translation: of(|score| score.translation),
            rotation: of(|score| score.rotation),
            direction: of(|score| score.direction),
            magnitude: of(|score| score.magnitude),
            direction_pairs_dropped: scores
                .iter()
                .map(|score| score.direction_pairs_dropped)
                .sum(),
        }
    }

    /// Number of constant components, which have no R².
    pub fn still_components(&self) -> usize {
        self.components.iter().filter(|r2| r2.is_nan()).count()
    }
}

/// Motions of the test pairs of a room: true, predicted, and the constant baseline.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReadMotions {
    /// True motions.
    pub truth: Vec<Twist>,
    /// Predicted motions.
    pub read: Vec<Twist>,
    /// Constant baseline: the mean training motion, for each pair.
    pub constant: Vec<Twist>,
}

impl ReadMotions {
    /// Motions from the true and the predicted ones, and the mean training motion.
    pub fn new(truth: Vec<Twist>, read: Vec<Twist>, mean: &Vector6<f64>) -> Self {
        let constant = vec![Twist::from_vector(mean); truth.len()];
        Self {
            truth,
            read,
            constant,
        }
    }

    /// Adds the motions of another fold of the same room.
    pub fn append(&mut self, mut other: Self) {
        self.truth.append(&mut other.truth);
        self.read.append(&mut other.read);
        self.constant.append(&mut other.constant);
    }

    /// R² of the predicted motions.
    pub fn scores(&self) -> MotionScores {
        MotionScores::of(&self.truth, &self.read)
    }

    /// R² of the constant baseline.
    pub fn constant_r2(&self) -> f64 {
        MotionScores::of(&self.truth, &self.constant).overall
    }
}

/// Mean R² over the components of the constant prediction `constant`.
pub fn constant_r2(truth: &[Twist], constant: &Vector6<f64>) -> f64 {
    let predicted = vec![Twist::from_vector(constant); truth.len()];
    MotionScores::of(truth, &predicted).overall
}

/// Standard deviation below which true values count as constant up to rounding, in their unit.
const STILL: f64 = 1e-9;

/// R² of (truth, prediction) pairs; NaN when the true values are constant.
pub fn r2(pairs: Vec<(f64, f64)>) -> f64 {
    let mean = pairs.iter().map(|(truth, _)| truth).sum::<f64>() / pairs.len() as f64;
    let total: f64 = pairs.iter().map(|(truth, _)| (truth - mean).powi(2)).sum();

    let residual: f64 = pairs
        .iter()
        .map(|(truth, predicted)| (truth - predicted).powi(2))
        .sum();

    if total > pairs.len() as f64 * STILL * STILL {
        1.0 - residual / total
    } else {
        f64::NAN
    }
}

fn pairs_of(
    truth: &[Twist],
    predicted: &[Twist],
    value: impl Fn(&Twist) -> f64,
) -> Vec<(f64, f64)> {
    truth
        .iter()
        .zip(predicted)
        .map(|(truth, predicted)| (value(truth), value(predicted)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition of R² on three points: residual 1, total 8.
    #[test]
    fn r2_by_hand() {
        assert!((r2(vec![(1.0, 1.0), (3.0, 2.0), (5.0, 5.0)]) - 0.875).abs() < 1e-15);
        assert!(r2(vec![(1.0, 0.0), (1.0, 2.0)]).is_nan());
    }
}

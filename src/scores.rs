//! How well motions are predicted: R² by component, hit rates, and the interval that n allows.

use nalgebra::{Vector3, Vector6};

use crate::geometry::Twist;

/// Motions whose true translation |v| is shorter, metres, have no direction to score.
pub const LEAST_DIRECTED_M: f64 = 1e-3;

/// R² of predicted twists. A component whose targets do not vary has no R²; it is left out of the
/// means, and a mean of none is NaN.
///
/// R² = 1 − Σ(y − ŷ)² / Σ(y − ȳ)², ȳ the mean of the evaluated targets (scikit-learn's `r2_score`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionScores {
    /// Pairs scored.
    pub n: usize,
    /// R² of each component, (v, ω); NaN when it does not vary.
    pub components: [f64; 6],
    /// Mean of the components' R².
    pub overall: f64,
    /// Mean over the components of v.
    pub translation: f64,
    /// Mean over the components of ω.
    pub rotation: f64,
    /// Mean R² of the components of v/|v|, over pairs with |v| > 1 mm.
    pub direction: f64,
    /// R² of |v|.
    pub magnitude: f64,
    /// Pairs left out of `direction` because they hardly move.
    pub direction_pairs_dropped: usize,
}

impl MotionScores {
    /// Scores predictions against truths, pair by pair; both must be equally long.
    pub fn of(truth: &[Twist], predicted: &[Twist]) -> Self {
        let components: [f64; 6] =
            std::array::from_fn(|c| r2(pairs_of(truth, predicted, |twist| twist.to_vector()[c])));

        let moving: Vec<(Vector3<f64>, Vector3<f64>)> = truth
            .iter()
            .zip(predicted)
            .filter(|(truth, _)| truth.linear.norm() > LEAST_DIRECTED_M)
            .map(|(truth, predicted)| {
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
    /// The mean of several scores, figure by figure, over those that have it; counts are added up.
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

    /// How many components do not vary, and so have no R².
    pub fn still_components(&self) -> usize {
        self.components.iter().filter(|r2| r2.is_nan()).count()
    }
}

/// Mean of R² over the components when `constant` is predicted for every pair.
pub fn constant_r2(truth: &[Twist], constant: &Vector6<f64>) -> f64 {
    let predicted = vec![Twist::from_vector(constant); truth.len()];
    MotionScores::of(truth, &predicted).overall
}

/// Truths that deviate by less than this, in their own unit, do not vary: it is rounding.
const STILL: f64 = 1e-9;

/// R² of (truth, prediction) pairs; NaN when the truths do not vary.
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

/// A rate with its count and its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rate {
    /// Successes over `n`.
    pub rate: f64,
    /// Lower end of Wilson's 95 % interval.
    pub low: f64,
    /// Upper end of Wilson's 95 % interval.
    pub high: f64,
    /// Trials.
    pub n: usize,
}

impl Rate {
    /// The rate of `successes` in `n` > 0 trials with Wilson's score interval.
    pub fn of(successes: usize, n: usize) -> Self {
        /// The 97.5 % point of the normal distribution.
        const Z: f64 = 1.959_963_984_540_054;

        let count = n as f64;
        let rate = successes as f64 / n as f64;
        let spread = Z * (rate * (1.0 - rate) / count + Z * Z / (4.0 * count * count)).sqrt();
        let centre = rate + Z * Z / (2.0 * count);

        let scale = 1.0 + Z * Z / count;
        let low = if successes == 0 {
            0.0
        } else {
            (centre - spread) / scale
        };

        let high = if successes == n {
            1.0
        } else {
            (centre + spread) / scale
        };

        Self { rate, low, high, n }
    }

    /// How many trials succeeded.
    pub fn successes(&self) -> usize {
        (self.rate * self.n as f64).round() as usize
    }
}

/// The middle of the values, the mean of the two middle ones when there are two; NaN of none.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);

    match sorted.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => sorted[n / 2],
        n => 0.5 * (sorted[n / 2 - 1] + sorted[n / 2]),
    }
}

/// The arithmetic mean; NaN of none.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The arithmetic mean of the values that are numbers; NaN of none.
pub fn mean_of_known(values: &[f64]) -> f64 {
    mean(
        &values
            .iter()
            .copied()
            .filter(|value| !value.is_nan())
            .collect::<Vec<_>>(),
    )
}

/// Sample standard deviation (n − 1).
pub fn deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    let squares: f64 = values.iter().map(|value| (value - centre).powi(2)).sum();
    (squares / (values.len() as f64 - 1.0)).sqrt()
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

    /// Oracle: by hand; SciPy's `binomtest(8, 40).proportion_ci(method="wilson")` is (0.10497,
    /// 0.34758).
    #[test]
    fn wilson_interval_of_eight_in_forty() {
        let rate = Rate::of(8, 40);
        assert!(
            (rate.low - 0.104_97).abs() < 1e-4 && (rate.high - 0.347_58).abs() < 1e-4,
            "{rate:?}"
        );

        assert_eq!(Rate::of(0, 40).low, 0.0);
        assert_eq!(Rate::of(40, 40).high, 1.0);
    }

    /// Oracle: the definition of R² on three points: residual 1, total 8.
    #[test]
    fn r2_by_hand() {
        assert!((r2(vec![(1.0, 1.0), (3.0, 2.0), (5.0, 5.0)]) - 0.875).abs() < 1e-15);
        assert!(r2(vec![(1.0, 0.0), (1.0, 2.0)]).is_nan());
    }

    #[test]
    fn medians_of_odd_and_even_counts() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
    }
}

//! Tests of a mean against zero, and their correction when a report makes many of them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use statrs::distribution::ContinuousCDF;

use super::{deviation, mean, student, t_quantile_975};

/// Number of random sign patterns of [`sign_flip_p`].
const FLIPS: usize = 100_000;

/// Two-sided p-value of "the values are symmetric around zero", by random flips of their signs.
///
/// It is the share of sign patterns whose mean is at least as far from zero as the mean of
/// `values`, with the given pattern counted. For values of ±1 this is the binomial sign test. 1
/// without values. The smallest possible p-value of n rooms is about 2^(1−n).
///
/// Source: Fisher's randomization test of paired differences.
pub fn sign_flip_p(values: &[f64], seed: u64) -> f64 {
    let observed = values.iter().sum::<f64>().abs();
    // Sums in another order differ by rounding errors.
    let tolerance = 1e-12 * values.iter().map(|value| value.abs()).sum::<f64>();

    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let as_far = (0..FLIPS).filter(|_| {
        let flipped = values.iter().map(|value| {
            if random.random_bool(0.5) {
                *value
            } else {
                -value
            }
        });
        flipped.sum::<f64>().abs() >= observed - tolerance
    });
    (as_far.count() + 1) as f64 / (FLIPS + 1) as f64
}

/// Holm's adjustment of p-values for making several tests: rejecting where the adjusted value is
/// below α bounds the probability of any false rejection by α, whatever the dependence.
///
/// Source: S. Holm, "A Simple Sequentially Rejective Multiple Test Procedure", 1979.
pub fn holm(p_values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|&a, &b| p_values[a].total_cmp(&p_values[b]));

    let mut adjusted = vec![1.0; p_values.len()];
    let mut largest: f64 = 0.0;
    for (rank, &place) in order.iter().enumerate() {
        let scaled = p_values[place] * (p_values.len() - rank) as f64;
        largest = largest.max(scaled.min(1.0));
        adjusted[place] = largest;
    }
    adjusted
}

/// A mean over rooms and trainings, with the uncertainty of both.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CrossedMean {
    /// The mean of all values.
    pub mean: f64,
    /// Lower end of the 95 % interval.
    pub low: f64,
    /// Upper end of the 95 % interval.
    pub high: f64,
    /// Two-sided p-value of a mean of zero.
    pub p: f64,
}

/// The mean of values by training and room: `by_training[k][r]` is the value of room r with
/// training k. `None` with fewer than two trainings or rooms: their spread is unknown.
///
/// Its variance is the variance of the room means over the number of rooms, plus the variance of
/// the training means over the number of trainings. That counts the residual twice, so the
/// interval is rather too wide. Interval and p-value are of Student's t with the degrees of freedom
/// of Satterthwaite's approximation.
pub fn crossed_mean(by_training: &[Vec<f64>]) -> Option<CrossedMean> {
    let rooms = by_training.first()?.len();
    if rooms < 2 || by_training.len() < 2 {
        return None;
    }

    let training_means: Vec<f64> = by_training.iter().map(|values| mean(values)).collect();
    let room_means: Vec<f64> = (0..rooms)
        .map(|room| {
            mean(
                &by_training
                    .iter()
                    .map(|values| values[room])
                    .collect::<Vec<_>>(),
            )
        })
        .collect();
    let center = mean(&training_means);

    let [of_rooms, of_trainings] =
        [&room_means, &training_means].map(|means| deviation(means).powi(2) / means.len() as f64);
    let variance = of_rooms + of_trainings;
    if variance == 0.0 {
        return Some(CrossedMean {
            mean: center,
            low: center,
            high: center,
            p: if center == 0.0 { 1.0 } else { 0.0 },
        });
    }

    let freedom = variance.powi(2)
        / (of_rooms.powi(2) / (rooms - 1) as f64
            + of_trainings.powi(2) / (by_training.len() - 1) as f64);
    let error = variance.sqrt();
    let reach = t_quantile_975(freedom) * error;
    Some(CrossedMean {
        mean: center,
        low: center - reach,
        high: center + reach,
        p: 2.0 * student(freedom).cdf(-(center / error).abs()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: SciPy's exact `permutation_test(permutation_type="samples")` of the mean, and its
    /// `binomtest(8, 10)`.
    #[test]
    fn flipped_signs_have_the_exact_p_values() {
        let differences = [0.3, 0.1, -0.05, 0.2, 0.4, -0.1, 0.15, 0.25];
        let p = sign_flip_p(&differences, 0);
        assert!((p - 0.054_687_5).abs() < 0.003, "{p}");

        let won = [1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0];
        let p = sign_flip_p(&won, 0);
        assert!((p - 0.109_375).abs() < 0.004, "{p}");

        assert_eq!(sign_flip_p(&[], 0), 1.0);
        assert_eq!(sign_flip_p(&[0.0; 12], 0), 1.0);
    }

    /// Oracle: statsmodels' `multipletests(method="holm")`.
    #[test]
    fn holm_adjusts_in_the_order_of_the_p_values() {
        let adjusted = holm(&[0.01, 0.04, 0.03, 0.005]);
        for (found, expected) in adjusted.iter().zip([0.03, 0.06, 0.06, 0.02]) {
            assert!((found - expected).abs() < 1e-12, "{adjusted:?}");
        }
        assert_eq!(holm(&[0.7, 0.9]), [1.0, 1.0]);
    }

    /// Oracle: the formula in NumPy and SciPy's `t`, for 3 trainings in 4 rooms.
    #[test]
    fn a_crossed_mean_has_the_spread_of_rooms_and_trainings() {
        let values = [
            vec![0.10, 0.30, 0.20, 0.25],
            vec![0.05, 0.22, 0.18, 0.10],
            vec![0.12, 0.35, 0.15, 0.30],
        ];
        let found = crossed_mean(&values).unwrap();
        assert!((found.mean - 0.193_333_33).abs() < 1e-8, "{found:?}");
        assert!(
            (found.high - found.mean - 0.130_738_53).abs() < 1e-7,
            "{found:?}"
        );
        assert!((found.p - 0.012_867_66).abs() < 1e-7, "{found:?}");

        assert_eq!(crossed_mean(&values[..1]), None);
        assert_eq!(crossed_mean(&[]), None);
        let equal = crossed_mean(&vec![vec![0.0; 5]; 3]).unwrap();
        assert_eq!((equal.mean, equal.p), (0.0, 1.0));
    }
}

//! Tests of a mean against zero, and their correction when a report makes many of them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use statrs::distribution::ContinuousCDF;

use super::{deviation, mean, student, t_quantile_975};

/// Largest number of values of which [`sign_flip_p`] takes all sign patterns.
const MOST_ENUMERATED: usize = 16;
/// Number of random sign patterns for more values.
const FLIPS: usize = 100_000;

/// Two-sided p-value of "the values are symmetric around zero", by flipping their signs.
///
/// It is the share of sign patterns whose mean is at least as far from zero as the mean of
/// `values`: of all patterns up to 16 values, else of 100,000 random ones and the given one. For
/// values of ±1 this is the binomial sign test. 1 without values. The smallest possible p-value is
/// 2^(1−n) of up to 16 values, and 1e-5 of more. The values have to be finite.
///
/// Source: Fisher's randomization test of paired differences.
pub fn sign_flip_p(values: &[f64], seed: u64) -> f64 {
    let observed = values.iter().sum::<f64>().abs();
    // Sums in another order differ by rounding errors.
    let tolerance = 1e-12 * values.iter().map(|value| value.abs()).sum::<f64>();
    let is_as_far = |sum: f64| sum.abs() >= observed - tolerance;
    let signed = |is_kept: bool, value: f64| if is_kept { value } else { -value };

    if values.len() <= MOST_ENUMERATED {
        let patterns = 1_u32 << values.len();
        let sum = |pattern: u32| -> f64 {
            let places = values.iter().enumerate();
            places
                .map(|(place, &value)| signed(pattern >> place & 1 == 1, value))
                .sum()
        };
        let as_far = (0..patterns).filter(|&pattern| is_as_far(sum(pattern)));
        return as_far.count() as f64 / f64::from(patterns);
    }

    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let as_far = (0..FLIPS).filter(|_| {
        let flipped = values
            .iter()
            .map(|&value| signed(random.random_bool(0.5), value));
        is_as_far(flipped.sum())
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

/// The mean of finite values by training and room: `by_training[k][r]` is the value of room r with
/// training k; every training has the same rooms. `None` with fewer than two trainings or rooms, or
/// if all room means and all training means are equal and not zero: their spread is unknown.
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
    // Rounding leaves equal values a variance of about (1e-16 times the mean)².
    if variance <= (1e-12 * center).powi(2) {
        // Equal values show no spread: they are no evidence for a mean that is not zero.
        return (center == 0.0).then_some(CrossedMean {
            mean: center,
            low: center,
            high: center,
            p: 1.0,
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

    /// Oracle: SciPy's exact `permutation_test(permutation_type="samples")` of the mean, its
    /// `binomtest(8, 10)`, and its `binomtest(15, 20)` for random patterns.
    #[test]
    fn flipped_signs_have_the_exact_p_values() {
        let differences = [0.3, 0.1, -0.05, 0.2, 0.4, -0.1, 0.15, 0.25];
        assert_eq!(sign_flip_p(&differences, 0), 0.054_687_5);

        let won = [1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0];
        assert_eq!(sign_flip_p(&won, 0), 0.109_375);

        let many: Vec<f64> = (0..20).map(|i| if i < 15 { 1.0 } else { -1.0 }).collect();
        let p = sign_flip_p(&many, 0);
        assert!((p - 0.041_389).abs() < 0.002, "{p}");

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
        assert_eq!(crossed_mean(&vec![vec![1.0; 5]; 3]), None);
    }
}

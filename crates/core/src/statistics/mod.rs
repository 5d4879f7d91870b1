//! Common statistics: means, quantiles, rates with confidence intervals, bootstraps over rooms and
//! over blocks of a recording, tests over rooms, and the coverage of covariances.
//!
//! Items of one recording are correlated, so its intervals are computed from blocks of the
//! recording ([`Blocks`], [`median_of_recording`]), and those over many rooms from the rooms
//! ([`bootstrap_mean`]). Only independent trials have Wilson's interval ([`Rate::of`]).

mod blocks;
mod coverage;
mod robust_covariance;
mod significance;

pub use blocks::{Blocks, Extent, MeanInterval};
pub use coverage::{
    CHI_SQUARED_68, CHI_SQUARED_95, Coverage, balancing_factor, coverage, coverage_deviation,
};
pub use robust_covariance::robust_covariance;
pub use significance::{CrossedMean, crossed_mean, holm, sign_flip_p};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use statrs::distribution::{ContinuousCDF, StudentsT};

/// Number of resamples of [`bootstrap_mean`].
const RESAMPLES: usize = 10_000;

/// A success rate with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Rate {
    /// Successes over `n`.
    pub rate: f64,
    /// Lower end of the 95 % interval.
    pub low: f64,
    /// Upper end of the 95 % interval.
    pub high: f64,
    /// The number of trials.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub n: usize,
}

impl Rate {
    /// The rate of `successes` in `n` > 0 independent trials, with Wilson's score interval.
    pub fn of(successes: usize, n: usize) -> Self {
        /// The 97.5 % point of the standard normal distribution.
        const Z: f64 = 1.959_963_984_540_054;

        let rate = successes as f64 / n as f64;
        let [low, high] = wilson(rate, n as f64, Z);

        Self { rate, low, high, n }
    }

    /// The number of successes.
    pub fn successes(&self) -> usize {
        (self.rate * self.n as f64).round() as usize
    }
}

/// Wilson's score interval for a rate over `trials` trials, with the normal quantile `z`.
fn wilson(rate: f64, trials: f64, z: f64) -> [f64; 2] {
    let spread = z * (rate * (1.0 - rate) / trials + z * z / (4.0 * trials * trials)).sqrt();
    let center = rate + z * z / (2.0 * trials);
    let scale = 1.0 + z * z / trials;

    // Exact bounds at the rates 0 and 1, without rounding errors.
    let low = if rate == 0.0 {
        0.0
    } else {
        (center - spread) / scale
    };
    let high = if rate == 1.0 {
        1.0
    } else {
        (center + spread) / scale
    };
    [low, high]
}

/// Student's t distribution with `freedom` > 0 degrees of freedom.
#[allow(
    clippy::expect_used,
    reason = "the library refuses only a scale or a freedom that is not positive"
)]
fn student(freedom: f64) -> StudentsT {
    StudentsT::new(0.0, 1.0, freedom.max(f64::MIN_POSITIVE)).expect("positive parameters")
}

/// The 97.5 % point of Student's t distribution with `freedom` > 0 degrees of freedom.
fn t_quantile_975(freedom: f64) -> f64 {
    student(freedom).inverse_cdf(0.975)
}

/// The median; for an even count, the mean of the two middle values. NaN without values.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => sorted[n / 2],
        n => 0.5 * (sorted[n / 2 - 1] + sorted[n / 2]),
    }
}

/// The quantile at `share`, 0 to 1, by the nearest rank. `None` without values.
pub fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = (sorted.len().saturating_sub(1) as f64 * share).round() as usize;

    sorted.get(rank).copied()
}

/// The arithmetic mean; NaN without values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// √(mean of x²); NaN without values.
pub fn root_mean_square(values: &[f64]) -> f64 {
    let squares: f64 = values.iter().map(|value| value * value).sum();
    (squares / values.len() as f64).sqrt()
}

/// The arithmetic mean of the values that are not NaN; NaN if there are none.
pub fn mean_of_known(values: &[f64]) -> f64 {
    let known: Vec<f64> = values.iter().copied().filter(|x| !x.is_nan()).collect();
    mean(&known)
}

/// Sample standard deviation, with n − 1 in the denominator.
pub fn deviation(values: &[f64]) -> f64 {
    let center = mean(values);
    let squares: f64 = values.iter().map(|value| (value - center).powi(2)).sum();
    (squares / (values.len() as f64 - 1.0)).sqrt()
}

/// Independent draws from the standard normal distribution, by the Box–Muller transform.
pub fn normal_deviates(random: &mut ChaCha8Rng, count: usize) -> impl Iterator<Item = f64> + '_ {
    let pair = |random: &mut ChaCha8Rng| {
        let a: f32 = random.random();
        let b: f32 = random.random();
        let radius = (-2.0 * (1.0 - a).ln()).sqrt();
        let (sine, cosine) = (std::f32::consts::TAU * b).sin_cos();

        [f64::from(radius * cosine), f64::from(radius * sine)]
    };

    (0..count.div_ceil(2))
        .flat_map(move |_| pair(random))
        .take(count)
}

/// A mean over rooms with its 95 % bootstrap interval.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RoomMean {
    /// The mean.
    pub mean: f64,
    /// The 2.5 % point of the resampled means.
    pub low: f64,
    /// The 97.5 % point of the resampled means.
    pub high: f64,
    /// The number of rooms.
    pub rooms: usize,
}

/// Mean of one value per room, with a percentile bootstrap over the rooms; NaN without values.
pub fn bootstrap_mean(values: &[f64], seed: u64) -> RoomMean {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let drawn = (0..values.len()).map(|_| values[random.random_range(0..values.len())]);
            drawn.sum::<f64>() / values.len() as f64
        })
        .collect();

    means.sort_by(f64::total_cmp);
    let point = |share: f64| means[((RESAMPLES - 1) as f64 * share).round() as usize];

    RoomMean {
        mean: mean(values),
        low: point(0.025),
        high: point(0.975),
        rooms: values.len(),
    }
}

/// Mean of the differences `ours − theirs`, paired by room: both lists have the same rooms in the
/// same order.
pub fn paired_difference(ours: &[f64], theirs: &[f64], seed: u64) -> RoomMean {
    let differences: Vec<f64> = ours.iter().zip(theirs).map(|(a, b)| a - b).collect();
    bootstrap_mean(&differences, seed)
}

/// A median with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct RecordedMedian {
    /// The median.
    pub median: f64,
    /// The lower end of the interval.
    pub low: f64,
    /// The upper end of the interval.
    pub high: f64,
}

/// Median of values in recording order. The interval allows for correlated neighbors: it is the
/// standard deviation of medians of resampled contiguous blocks, at most 10 of equal length (the
/// last may be shorter), times the quantile of Student's t. With one value it is unbounded. NaN
/// without values.
pub fn median_of_recording(values: &[f64], seed: u64) -> RecordedMedian {
    const BLOCKS: usize = 10;
    const MEDIANS: usize = 2_000;

    let blocks: Vec<&[f64]> = values
        .chunks(values.len().div_ceil(BLOCKS).max(1))
        .collect();
    let median_of_all = median(values);
    if blocks.len() < 2 {
        return RecordedMedian {
            median: median_of_all,
            low: f64::NEG_INFINITY,
            high: f64::INFINITY,
        };
    }

    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let medians: Vec<f64> = (0..MEDIANS)
        .map(|_| {
            let drawn: Vec<f64> = (0..blocks.len())
                .flat_map(|_| blocks[random.random_range(0..blocks.len())])
                .copied()
                .collect();
            median(&drawn)
        })
        .collect();

    // Resampled blocks vary less than new ones would, by the factor (b − 1) / b in variance.
    let count = blocks.len() as f64;
    let spread = deviation(&medians) * (count / (count - 1.0)).sqrt();
    let reach = t_quantile_975((blocks.len() - 1) as f64) * spread;

    RecordedMedian {
        median: median_of_all,
        low: median_of_all - reach,
        high: median_of_all + reach,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. From five blocks of zeros and five of ones, half of the resamples have the
    /// median 0 or 1 each, so the interval contains both. If 0 and 1 alternate within the blocks,
    /// every resample has the median 0.5.
    #[test]
    fn medians_of_a_recording_are_resampled_by_blocks() {
        let stays: Vec<f64> = (0..1_000).map(|i| f64::from(i / 500)).collect();
        let found = median_of_recording(&stays, 1);
        assert_eq!(found.median, 0.5);
        assert!(found.low <= 0.0 && found.high >= 1.0, "{found:?}");

        let alternates: Vec<f64> = (0..1_000).map(|i| f64::from(i % 2)).collect();
        let found = median_of_recording(&alternates, 1);
        assert_eq!((found.low, found.median, found.high), (0.5, 0.5, 0.5));

        assert!(median_of_recording(&[], 1).median.is_nan());
        let alone = median_of_recording(&[3.0], 1);
        assert_eq!(alone.median, 3.0);
        assert!(alone.low < 0.0 && alone.high > 1e9);
    }

    /// Oracle: the definition of a 95 % interval, for errors that keep their value over 10 frames
    /// on average.
    #[test]
    fn intervals_of_correlated_errors_contain_the_median() {
        const RECORDINGS: usize = 100;
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let covered = (0..RECORDINGS).filter(|_| {
            let mut error: f64 = random.random();
            let errors: Vec<f64> = (0..1_000)
                .map(|_| {
                    if random.random_bool(0.1) {
                        error = random.random();
                    }
                    error
                })
                .collect();
            let found = median_of_recording(&errors, 0);
            found.low <= 0.5 && 0.5 <= found.high
        });
        let covered = covered.count();
        assert!(covered >= 88, "{covered}");
    }

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

    /// Oracle: SciPy's `t.ppf(0.975, freedom)`.
    #[test]
    fn quantiles_of_student() {
        for (freedom, point) in [
            (1.0, 12.706_205),
            (2.5, 3.574_655),
            (10.0, 2.228_139),
            (99.0, 1.984_217),
        ] {
            let found = t_quantile_975(freedom);
            assert!((found - point).abs() < 1e-5, "{freedom}: {found}");
        }
    }

    /// Oracle: by hand.
    #[test]
    fn medians_of_odd_and_even_counts() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
    }

    /// Oracle: NumPy's `quantile(method="nearest")` of 0, 1, …, 10 at 0.97, 0.02 and 0.5.
    #[test]
    fn quantiles_are_of_the_nearest_rank() {
        let values: Vec<f64> = (0..11).rev().map(f64::from).collect();
        assert_eq!(quantile(&values, 0.97), Some(10.0));
        assert_eq!(quantile(&values, 0.02), Some(0.0));
        assert_eq!(quantile(&values, 0.5), Some(5.0));
        assert_eq!(quantile(&[], 0.5), None);
    }

    /// Oracle: the normal approximation, mean ± 1.96 standard errors, for 100 evenly spaced values.
    #[test]
    fn the_bootstrap_interval_is_near_the_normal_one() {
        let values: Vec<f64> = (0..100).map(|i| f64::from(i) / 99.0).collect();
        let found = bootstrap_mean(&values, 1);
        let error = 1.96 * deviation(&values) / 10.0;

        assert!((found.mean - 0.5).abs() < 1e-12 && found.rooms == 100);
        assert!(
            (found.low - (0.5 - error)).abs() < 0.005 && (found.high - (0.5 + error)).abs() < 0.005,
            "{found:?}"
        );
    }

    /// Oracle: by hand. A constant difference has an interval of width zero, even if the rooms
    /// differ.
    #[test]
    fn differences_are_paired_by_room() {
        let found = paired_difference(&[0.9, 0.5, 0.1], &[0.8, 0.4, 0.0], 1);
        assert!(
            (found.mean - 0.1).abs() < 1e-12 && (found.high - found.low).abs() < 1e-12,
            "{found:?}"
        );
    }
}

//! Intervals for one recording, whose neighboring items are correlated.
//!
//! Pairs of frames that overlap hit or miss together, so that n pairs hold less information than n
//! independent trials. The variance between contiguous blocks of the recording measures how much
//! less.

use super::{Rate, t_quantile_975, wilson};

/// Maximum number of blocks of a recording. More blocks are shorter, and so correlated with each
/// other: in the tests' simulated recordings, 10 blocks cover the rate more often than 20.
const MOST_BLOCKS: usize = 10;

/// The extent of an item: the rows of the recording that it was computed from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extent {
    /// The first row.
    pub start: u32,
    /// The number of rows to the last one; for a pair of frames, its stride.
    pub length: u32,
}

/// A division of the items of a recording into contiguous blocks.
///
/// There are at most 10 blocks, and not more than items that fit into the covered rows without
/// overlap. Blocks have equal numbers of items (the last may have fewer), in the order of the
/// items' first rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Blocks {
    /// Positions of the items in the given list, by block.
    blocks: Vec<Vec<usize>>,
    /// The number of items that would fit into the covered rows without overlap.
    disjoint_count: usize,
}

/// A mean with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct MeanInterval {
    /// The mean.
    pub mean: f64,
    /// The lower end of the interval.
    pub low: f64,
    /// The upper end of the interval.
    pub high: f64,
}

impl Blocks {
    /// Divides items with these extents, given in any order.
    pub fn of(extents: &[Extent]) -> Self {
        let mut order: Vec<usize> = (0..extents.len()).collect();
        order.sort_by_key(|&item| extents[item].start);

        // As many blocks as items of the median length fit into the covered rows.
        let mut lengths: Vec<u32> = extents.iter().map(|extent| extent.length).collect();
        lengths.sort_unstable();
        let length = lengths
            .get(lengths.len() / 2)
            .map_or(1, |&rows| rows.max(1));
        let gap = |pair: &[usize]| (extents[pair[1]].start - extents[pair[0]].start).min(length);
        let gaps: Vec<u64> = order.windows(2).map(|pair| gap(pair).into()).collect();
        // The last item counts as the one before it; a single one as a whole.
        let last = gaps.last().copied().unwrap_or(length.into());
        let covered = gaps.iter().sum::<u64>() + last;
        let disjoint_count = (covered / u64::from(length)).max(1) as usize;

        let per_block = extents.len().div_ceil(disjoint_count.min(MOST_BLOCKS));
        Self {
            blocks: order
                .chunks(per_block.max(1))
                .map(<[usize]>::to_vec)
                .collect(),
            disjoint_count,
        }
    }

    /// The rate of items for which `is_success` holds, by position in the given list.
    pub fn rate(&self, is_success: impl Fn(usize) -> bool) -> Rate {
        Rate::of_counts(&self.counts(is_success), self.disjoint_count)
    }

    /// The difference of two rates over the same items, paired, -1 to 1. If it is the same in all
    /// blocks, they show no variance: the interval then is that of as many independent items as fit
    /// without overlap, of which none differs (0.05 = (1 − reach)^count).
    pub fn rate_difference(
        &self,
        ours: impl Fn(usize) -> bool,
        theirs: impl Fn(usize) -> bool,
    ) -> MeanInterval {
        let number = |holds: bool| f64::from(u8::from(holds));
        let found = self.mean(|item| number(ours(item)) - number(theirs(item)));
        let unseen = 1.0 - 0.05_f64.powf(1.0 / self.disjoint_count as f64);
        let reach = match found.high - found.mean {
            0.0 => unseen,
            reach => reach,
        };
        MeanInterval {
            low: (found.mean - reach).max(-1.0),
            high: (found.mean + reach).min(1.0),
            ..found
        }
    }

    /// The numbers of successes and of items in each block, for [`Rate::of_blocks`] of several
    /// recordings.
    pub fn counts(&self, is_success: impl Fn(usize) -> bool) -> Vec<(usize, usize)> {
        let count = |block: &Vec<usize>| {
            let successes = block.iter().filter(|&&item| is_success(item)).count();
            (successes, block.len())
        };
        self.blocks.iter().map(count).collect()
    }

    /// The mean of `value` over the items, by position in the given list. NaN without items; with
    /// one block, the interval is unbounded.
    pub fn mean(&self, value: impl Fn(usize) -> f64) -> MeanInterval {
        let sums: Vec<(f64, usize)> = self
            .blocks
            .iter()
            .map(|block| (block.iter().map(|&item| value(item)).sum(), block.len()))
            .collect();
        let (mean, variance) = mean_of_blocks(&sums);
        let reach = match variance {
            Some(variance) => t_quantile_975((sums.len() - 1) as f64) * variance.sqrt(),
            None => f64::INFINITY,
        };

        MeanInterval {
            mean,
            low: mean - reach,
            high: mean + reach,
        }
    }
}

impl Rate {
    /// The rate over blocks of correlated trials, for example rooms, each with its numbers of
    /// successes and trials.
    ///
    /// The interval is Wilson's, with the effective number of trials of which the variance between
    /// blocks is that of independent trials, and with the quantile of Student's t. It is never
    /// narrower than the interval of independent trials. With a single block it is 0 to 1.
    pub fn of_blocks(blocks: &[(usize, usize)]) -> Self {
        Self::of_counts(blocks, blocks.len())
    }

    /// [`Self::of_blocks`]; `least_trials` is the effective number of trials if all succeed or all
    /// fail, since blocks then show no variance.
    fn of_counts(blocks: &[(usize, usize)], least_trials: usize) -> Self {
        let successes = blocks.iter().map(|block| block.0).sum();
        let independent = Self::of(successes, blocks.iter().map(|block| block.1).sum());

        let sums: Vec<(f64, usize)> = blocks.iter().map(|&(s, n)| (s as f64, n)).collect();
        let Some(variance) = mean_of_blocks(&sums).1 else {
            return Self {
                low: 0.0,
                high: 1.0,
                ..independent
            };
        };

        let rate = independent.rate;
        let trials = match rate * (1.0 - rate) {
            0.0 => least_trials as f64,
            spread => spread / variance,
        };
        let trials = trials.min(independent.n as f64);
        let [low, high] = wilson(rate, trials, t_quantile_975((blocks.len() - 1) as f64));

        Self {
            low: low.min(independent.low),
            high: high.max(independent.high),
            ..independent
        }
    }
}

/// The mean over blocks with sums and counts of their items, and the variance of that mean, by the
/// sums' deviations from what their counts predict. No variance with fewer than two blocks.
fn mean_of_blocks(sums: &[(f64, usize)]) -> (f64, Option<f64>) {
    let count = sums.iter().map(|sum| sum.1).sum::<usize>() as f64;
    let mean = sums.iter().map(|sum| sum.0).sum::<f64>() / count;
    if sums.len() < 2 {
        return (mean, None);
    }

    let squares: f64 = sums
        .iter()
        .map(|&(sum, items)| (sum - mean * items as f64).powi(2))
        .sum();
    let blocks = sums.len() as f64;
    (
        mean,
        Some(blocks / (blocks - 1.0) * squares / (count * count)),
    )
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn pairs(count: u32, stride: u32) -> Vec<Extent> {
        let pair = |start| Extent {
            start,
            length: stride,
        };
        (0..count).map(pair).collect()
    }

    /// Oracle: by hand. 195 pairs of stride 25 begin within 195 rows, in which 7 fit; 100 begin 25
    /// rows or more apart.
    #[test]
    fn blocks_are_as_long_as_an_item() {
        let sizes = |extents: &[Extent]| -> Vec<usize> {
            let divided = Blocks::of(extents);
            divided.blocks.iter().map(Vec::len).collect()
        };

        assert_eq!(sizes(&pairs(195, 25)), [28, 28, 28, 28, 28, 28, 27]);
        assert_eq!(sizes(&pairs(20, 25)), [20]);
        let apart: Vec<Extent> = pairs(100, 25)
            .into_iter()
            .map(|pair| Extent {
                start: pair.start * 30,
                ..pair
            })
            .rev()
            .collect();
        assert_eq!(sizes(&apart), [10; 10]);
        assert_eq!(Blocks::of(&apart).blocks[0][..3], [99, 98, 97]);
        assert!(Blocks::of(&[]).blocks.is_empty());
    }

    /// Oracle: by hand, with SciPy's `t.ppf(0.975, 3)` = 3.182446. Four blocks of ten trials with
    /// 2, 4, 6 and 8 successes: the rate is 0.5, its variance 4/3 · 20 / 40² = 1/60, so the
    /// effective number of trials is 0.25 · 60 = 15. Wilson's formula then gives 0.5 ± 0.317433.
    #[test]
    fn the_variance_between_blocks_widens_the_interval() {
        let rate = Rate::of_blocks(&[(2, 10), (4, 10), (6, 10), (8, 10)]);
        assert_eq!((rate.rate, rate.n), (0.5, 40));
        assert!((rate.low - 0.182_567).abs() < 1e-6, "{rate:?}");
        assert!((rate.high - 0.817_433).abs() < 1e-6, "{rate:?}");

        let alone = Rate::of_blocks(&[(3, 10)]);
        assert_eq!((alone.low, alone.high), (0.0, 1.0));
    }

    /// Oracle: by hand: of 975 pairs of stride 25 in a row, 39 fit without overlap, and all hit.
    /// Wilson's lower end for 39 of 39 trials is 39 / (39 + z²), with z = 2.262157.
    #[test]
    fn rates_of_one_have_the_interval_of_disjoint_items() {
        let rate = Blocks::of(&pairs(975, 25)).rate(|_| true);
        assert!((rate.low - 0.883_991).abs() < 1e-4, "{rate:?}");
        assert_eq!(rate.high, 1.0);
        let of_rooms = Rate::of_blocks(&[(0, 50), (0, 50)]);
        assert!(of_rooms.low == 0.0 && of_rooms.high > 0.9, "{of_rooms:?}");
    }

    /// Oracle: by hand: the differences 0, 0, 1, 1 in two blocks have the mean 0.5, the variance
    /// 2 · (1 + 1) / 16 = 1/4, and Student's t quantile 12.7062 of one degree of freedom.
    #[test]
    fn means_have_the_interval_of_student() {
        let blocks = Blocks {
            blocks: vec![vec![0, 1], vec![2, 3]],
            disjoint_count: 2,
        };
        let found = blocks.mean(|item| f64::from(u8::from(item > 1)));
        assert_eq!(found.mean, 0.5);
        assert!((found.high - 0.5 - 0.5 * 12.7062).abs() < 1e-3, "{found:?}");

        let alone = Blocks {
            blocks: vec![vec![0, 1]],
            disjoint_count: 1,
        };
        assert_eq!(alone.mean(|_| 1.0).high, f64::INFINITY);
        let unknown = alone.rate_difference(|_| true, |_| false);
        assert_eq!((unknown.low, unknown.high), (-1.0, 1.0));
    }

    /// Oracle: by hand: with 39 disjoint pairs of which none differs, a share of 7.4 % that differ
    /// would be missed in 5 % of recordings: 0.926^39 = 0.05.
    #[test]
    fn rates_that_never_differ_have_no_interval_of_zero() {
        let found = Blocks::of(&pairs(975, 25)).rate_difference(|_| true, |_| true);
        assert_eq!(found.mean, 0.0);
        assert!(
            (found.high - 0.073_93).abs() < 1e-4 && found.low == -found.high,
            "{found:?}"
        );
    }

    /// Oracle: the definition of a 95 % interval. Hits follow a Markov chain with rate 0.3 that
    /// keeps its state for 25 pairs on average, as pairs of stride 25 do. Independent trials would
    /// give intervals that contain 0.3 in fewer than half of the recordings.
    #[test]
    fn intervals_of_correlated_hits_contain_the_rate() {
        const RECORDINGS: usize = 1_000;
        let blocks = Blocks::of(&pairs(975, 25));
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut covered = [0; 2];
        for _ in 0..RECORDINGS {
            let mut is_hit = random.random_bool(0.3);
            let hits: Vec<bool> = (0..975)
                .map(|_| {
                    if random.random_bool(1.0 / 25.0) {
                        is_hit = random.random_bool(0.3);
                    }
                    is_hit
                })
                .collect();

            let independent = Rate::of(hits.iter().filter(|hit| **hit).count(), hits.len());
            for (place, rate) in [blocks.rate(|item| hits[item]), independent]
                .iter()
                .enumerate()
            {
                covered[place] += usize::from(rate.low <= 0.3 && 0.3 <= rate.high);
            }
        }

        assert!(covered[0] * 100 >= RECORDINGS * 90, "{covered:?}");
        assert!(covered[1] * 2 < RECORDINGS, "{covered:?}");
    }

    proptest! {
        /// Oracle: the definition of a rate, and Wilson's interval for independent trials.
        #[test]
        fn intervals_contain_that_of_independent_trials(
            blocks in proptest::collection::vec((0_usize..=30, 1_usize..=30), 1..30)
        ) {
            let blocks: Vec<_> = blocks.into_iter().map(|(s, n)| (s.min(n), n)).collect();
            let found = Rate::of_blocks(&blocks);
            let plain = Rate::of(found.successes(), found.n);
            prop_assert!(0.0 <= found.low && found.low <= plain.low);
            prop_assert!(plain.high <= found.high && found.high <= 1.0);
        }
    }
}

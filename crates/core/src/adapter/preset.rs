//! Named training protocols: two of the paper and two of ours.

use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::TrainConfig;
use crate::room::Timeline;
use crate::splits::{Error as PairError, Pair, Split, StrideRange};

/// A training protocol.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
pub enum Preset {
    /// As paper-base, but with enough epochs for 400 optimizer steps, at least 10.
    ///
    /// In a short recording, ten epochs can be only ten steps, which is too few.
    Base,
    /// The paper's base protocol: all training pairs at one stride, 10 epochs.
    PaperBase,
    /// The paper's range protocol: 30,000 pairs with strides 10 to 40, 200 epochs.
    ///
    /// Its "optimal config".
    PaperRange,
    /// Not from the paper, for rooms outside the training set: 17 epochs of 30,000 pairs with
    /// strides 1 to 40 (about 1,000 steps), z-scored features with noise, averaged weights.
    ///
    /// μ = 0.
    Steady,
}

/// Selection of the training pairs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PairPlan {
    /// Every training pair at one stride, in frames.
    Stride(u32),
    /// Pairs drawn at random from a range of strides.
    Range(StrideRange),
}

impl Preset {
    /// Name on the command line and in a manifest.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Optimizer settings, with the given seed.
    pub fn config(self, seed: u64) -> TrainConfig {
        let plain = TrainConfig {
            seed,
            ..TrainConfig::default()
        };

        match self {
            Self::Base | Self::PaperBase => TrainConfig {
                epochs: 10,
                ..plain
            },
            Self::PaperRange => TrainConfig {
                epochs: 200,
                ..plain
            },
            Self::Steady => TrainConfig {
                epochs: 17,
                learning_rate: 3e-4,
                standardize: true,
                noise: 0.5,
                average: 0.99,
                through_zero: true,
                ..plain
            },
        }
    }

    /// Minimum number of optimizer steps; epochs are added until it is reached.
    pub fn least_steps(self) -> usize {
        match self {
            Self::Base => 400,
            Self::PaperBase | Self::PaperRange | Self::Steady => 0,
        }
    }

    /// The training pairs of this preset for an adapter that is tested at `stride` frames.
    pub fn plan(self, stride: u32) -> PairPlan {
        match self {
            Self::Base | Self::PaperBase => PairPlan::Stride(stride),
            Self::PaperRange => PairPlan::Range(StrideRange {
                low: 10,
                high: 40,
                count: 30_000,
            }),
            Self::Steady => PairPlan::Range(StrideRange {
                low: 1,
                high: 40,
                count: 30_000,
            }),
        }
    }
}

impl PairPlan {
    /// The training pairs of several rooms, each with the index of its room in `rooms`.
    ///
    /// # Errors
    /// The errors of [`Split::train_pairs`] for a single stride, and of [`Split::sampled_range`]
    /// for a range.
    pub fn pairs(
        &self,
        split: Split,
        rooms: &[&Timeline],
        seed: u64,
    ) -> Result<Vec<(usize, Pair)>, PairError> {
        match self {
            Self::Stride(stride) => {
                let mut pairs = Vec::new();
                for (room, timeline) in rooms.iter().enumerate() {
                    pairs.extend(
                        split
                            .train_pairs(timeline, *stride)?
                            .into_iter()
                            .map(|pair| (room, pair)),
                    );
                }

                Ok(pairs)
            }
            Self::Range(range) => split.sampled_range(rooms, range, seed),
        }
    }
}

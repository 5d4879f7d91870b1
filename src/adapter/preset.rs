//! Training protocols by name: the paper's two, and ours.

use super::TrainConfig;
use crate::pairs::{Error as PairError, Pair, Split, StrideRange};
use crate::room::Timeline;

/// A training protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Preset {
    /// All training pairs at one stride, 10 epochs.
    PaperBase,
    /// 30,000 pairs with strides 10 to 40, 200 epochs: the paper's "optimal config".
    PaperRange,
    /// Ours, for rooms that were never seen: 17 epochs of 30,000 pairs with strides 1 to 40, about
    /// 1,000 steps, on z-scored features with noise, with averaged weights and no mean motion.
    Steady,
}

/// Which training pairs a preset takes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PairPlan {
    /// Every training pair at one stride, frames.
    Stride(u32),
    /// Drawn from a range of strides.
    Range(StrideRange),
}

impl Preset {
    /// Every preset.
    pub const ALL: [Self; 3] = [Self::PaperBase, Self::PaperRange, Self::Steady];

    /// The word for it on the command line and in a manifest.
    pub fn name(self) -> &'static str {
        match self {
            Self::PaperBase => "paper-base",
            Self::PaperRange => "paper-range",
            Self::Steady => "steady",
        }
    }

    /// The optimiser's settings with a seed.
    pub fn config(self, seed: u64) -> TrainConfig {
        let plain = TrainConfig {
            seed,
            ..TrainConfig::default()
        };

        match self {
            Self::PaperBase => TrainConfig {
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
                standardise: true,
                noise: 0.5,
                average: 0.99,
                through_zero: true,
                ..plain
            },
        }
    }

    /// The pairs it trains on, when tested at `stride`.
    pub fn plan(self, stride: u32) -> PairPlan {
        match self {
            Self::PaperBase => PairPlan::Stride(stride),
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
    /// The training pairs of rooms, each with the position of its room.
    ///
    /// # Errors
    /// As [`Split::train_pairs`] and [`Split::sampled_range`].
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

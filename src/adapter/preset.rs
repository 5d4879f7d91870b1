//! The two training protocols of the paper, by name.

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
    pub const ALL: [Self; 2] = [Self::PaperBase, Self::PaperRange];

    /// The word for it on the command line and in a manifest.
    pub fn name(self) -> &'static str {
        match self {
            Self::PaperBase => "paper-base",
            Self::PaperRange => "paper-range",
        }
    }

    /// The optimiser's settings with a seed.
    pub fn config(self, seed: u64) -> TrainConfig {
        let epochs = match self {
            Self::PaperBase => 10,
            Self::PaperRange => 200,
        };
        TrainConfig { epochs, seed, ..TrainConfig::default() }
    }

    /// The pairs it trains on, when tested at `stride`.
    pub fn plan(self, stride: u32) -> PairPlan {
        match self {
            Self::PaperBase => PairPlan::Stride(stride),
            Self::PaperRange => PairPlan::Range(StrideRange { low: 10, high: 40, count: 30_000 }),
        }
    }
}

impl PairPlan {
    /// The training pairs of a room.
    ///
    /// # Errors
    /// As [`Split::train_pairs`] and [`Split::sampled_range`].
    pub fn pairs(&self, split: Split, timeline: &Timeline, seed: u64) -> Result<Vec<Pair>, PairError> {
        match self {
            Self::Stride(stride) => split.train_pairs(timeline, *stride),
            Self::Range(range) => split.sampled_range(timeline, range, seed),
        }
    }
}

//! What a training protocol is made of, on the command line.

use anyhow::Context;
use clap::{Args, ValueEnum};

use crate::adapter::{Loss, Mixing, PairPlan, Preset};
use crate::pairs::{Split, StrideRange};
use crate::training::Recipe;

/// A preset, and what is to be different from it.
#[derive(Debug, Clone, Args)]
pub struct ProtocolOptions {
    /// The protocol
    #[arg(long, value_enum, default_value_t = PresetName::PaperBase)]
    preset: PresetName,
    /// Frames from source to target
    #[arg(long, default_value_t = 40)]
    stride: u32,
    /// How frames are kept apart for testing; `pairs` leaks on purpose
    #[arg(long, value_enum, default_value_t = SplitName::Time)]
    split: SplitName,
    /// Passes over the pairs, instead of the preset's
    #[arg(long)]
    epochs: Option<usize>,
    /// Draw training pairs with strides LOW-HIGH, instead of the preset's
    #[arg(long, value_name = "LOW-HIGH")]
    strides: Option<String>,
    /// How many pairs are drawn from a range of strides
    #[arg(long)]
    pairs: Option<usize>,
    /// Learning rate
    #[arg(long)]
    lr: Option<f64>,
    /// Decoupled decay of every weight
    #[arg(long)]
    weight_decay: Option<f64>,
    /// Pairs in a step of the optimiser
    #[arg(long)]
    batch: Option<usize>,
    /// Columns between the two layers of φ
    #[arg(long)]
    hidden: Option<usize>,
    /// Columns of a chart's latent
    #[arg(long)]
    geo_dim: Option<usize>,
    /// Charts that a gate mixes, the paper's K
    #[arg(long)]
    charts: Option<usize>,
    /// How charts are mixed
    #[arg(long, value_enum)]
    mixing: Option<MixingName>,
    /// What is minimised
    #[arg(long, value_enum)]
    loss: Option<LossName>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PresetName {
    /// All pairs at one stride, 10 epochs
    PaperBase,
    /// 30,000 pairs with strides 10 to 40, 200 epochs
    PaperRange,
    /// Ours, for rooms never seen: strides 1 to 40, 1,000 steps on z-scored features with noise,
    /// averaged weights
    Steady,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SplitName {
    /// The first 80 % of the frames train
    Time,
    /// Blocks of 50 frames
    Blocks,
    /// By source frame: leaks on purpose, to check an implementation
    Pairs,
    /// The recording's own, where it has one
    Dataset,
    /// Every pair trains and tests: for rooms that are learned from, or held out, as a whole
    Whole,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MixingName {
    /// By a gate that is learned with them, the paper's
    Gate,
    /// Evenly: an ensemble of adapters, each learned for its share of the epochs
    Even,
}

impl From<MixingName> for Mixing {
    fn from(name: MixingName) -> Self {
        match name {
            MixingName::Gate => Self::Gate,
            MixingName::Even => Self::Even,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LossName {
    /// Mean squared error, the paper's
    Mse,
    /// One minus the cosine of the six numbers
    Cosine,
    /// Mean squared error of the rotation alone
    Rotation,
}

impl From<PresetName> for Preset {
    fn from(name: PresetName) -> Self {
        match name {
            PresetName::PaperBase => Self::PaperBase,
            PresetName::PaperRange => Self::PaperRange,
            PresetName::Steady => Self::Steady,
        }
    }
}

impl From<SplitName> for Split {
    fn from(name: SplitName) -> Self {
        match name {
            SplitName::Time => Self::Time,
            SplitName::Blocks => Self::Blocks,
            SplitName::Pairs => Self::Pairs,
            SplitName::Dataset => Self::Dataset,
            SplitName::Whole => Self::Whole,
        }
    }
}

impl From<LossName> for Loss {
    fn from(name: LossName) -> Self {
        match name {
            LossName::Mse => Self::MeanSquaredError,
            LossName::Cosine => Self::Cosine,
            LossName::Rotation => Self::Rotation,
        }
    }
}

impl ProtocolOptions {
    /// Refuses the split that sets nothing apart, where test pairs are what is asked for.
    pub fn needs_test_pairs(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            self.split != SplitName::Whole,
            "--split whole sets no test pairs apart; take another split"
        );

        Ok(())
    }

    /// Refuses what a grid decides.
    pub fn leaves_to_the_grid(&self) -> anyhow::Result<()> {
        for (given, option, grid) in [
            (self.geo_dim.is_some(), "--geo-dim", "--geo-dims"),
            (self.charts.is_some(), "--charts", "--chart-counts"),
            (self.lr.is_some(), "--lr", "--lrs"),
            (self.loss.is_some(), "--loss", "--losses"),
        ] {
            anyhow::ensure!(
                !given,
                "{option} is one of the sweep's own; give {grid}, with commas"
            );
        }

        Ok(())
    }

    /// The same at another stride.
    pub fn at_stride(&self, stride: u32) -> Self {
        Self {
            stride,
            ..self.clone()
        }
    }

    /// The preset with what was given in its place.
    pub fn recipe(&self, seed: u64) -> anyhow::Result<Recipe> {
        anyhow::ensure!(
            (1..=MAX_STRIDE).contains(&self.stride),
            "--stride must be 1 to {MAX_STRIDE}, got {}",
            self.stride
        );

        let mut recipe = Recipe::of(self.preset.into(), self.split.into(), self.stride, seed);
        let config = &mut recipe.config;
        let put = |into: &mut usize, given: Option<usize>| given.map_or((), |given| *into = given);
        put(&mut config.epochs, self.epochs);

        put(&mut config.batch, self.batch);
        put(&mut config.hidden, self.hidden);
        put(&mut config.latent, self.geo_dim);
        put(&mut config.charts, self.charts);

        config.learning_rate = self.lr.unwrap_or(config.learning_rate);
        config.weight_decay = self.weight_decay.unwrap_or(config.weight_decay);
        config.mixing = self.mixing.map_or(config.mixing, Into::into);
        config.loss = self.loss.map_or(config.loss, Into::into);

        recipe.pairs = self.plan(recipe.pairs)?;
        Ok(recipe)
    }

    fn plan(&self, preset: PairPlan) -> anyhow::Result<PairPlan> {
        let (low, high, count) = match (&self.strides, &preset) {
            (None, PairPlan::Stride(_)) if self.pairs.is_none() => return Ok(preset),
            (None, PairPlan::Stride(stride)) => (*stride, *stride, 30_000),
            (None, PairPlan::Range(range)) => (range.low, range.high, range.count),
            (Some(text), _) => {
                let ends = text
                    .split_once('-')
                    .context("--strides is LOW-HIGH, for instance 10-40")?;

                let end = |text: &str| {
                    text.trim()
                        .parse()
                        .with_context(|| format!("--strides: '{text}' is no stride"))
                };

                let count = if let PairPlan::Range(range) = &preset {
                    range.count
                } else {
                    30_000
                };

                (end(ends.0)?, end(ends.1)?, count)
            }
        };

        anyhow::ensure!(
            low >= 1 && low <= high && high <= MAX_STRIDE,
            "--strides: {low}-{high} is no range from 1 to {MAX_STRIDE}"
        );

        let count = self.pairs.unwrap_or(count);
        anyhow::ensure!(
            (1..=MAX_PAIRS).contains(&count),
            "--pairs must be 1 to {MAX_PAIRS}, got {count}"
        );

        Ok(PairPlan::Range(StrideRange { low, high, count }))
    }
}

/// The longest stride.
const MAX_STRIDE: u32 = 100_000;

/// The most pairs that are drawn.
const MAX_PAIRS: usize = 10_000_000;

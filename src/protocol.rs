//! The options of a training protocol, shared by the commands that train.

use anyhow::Context;
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use super::named::{one_of, possible_values};

use seese3_core::adapter::{Loss, Mixing, PairPlan, Preset, RelationalConfig};
use seese3_core::splits::{Split, StrideRange};
use seese3_core::training::TrainingPlan;

/// A reader beside the paper's adapter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Reader {
    /// Reads motions from the similarities of all cells of two feature maps
    ///
    /// Ours, not the paper's. Needs features of a grid (`encode --pool grid4x4`).
    Relational,
}

/// Options of a reader that is trained beside the adapter.
#[derive(Debug, Clone, Args)]
pub struct ReaderOptions {
    /// Also train a reader of this kind on the same features, which must be of a grid
    #[arg(long, value_enum)]
    reader: Option<Reader>,
    /// Number of networks of the reader, whose densities are averaged, 1 to 16
    #[arg(long, default_value_t = 1, requires = "reader")]
    reader_members: usize,
    /// Number of epochs of the reader, 1 to 100000, for each network; 24 if omitted. An epoch has
    /// 25600 pairs
    #[arg(long, requires = "reader")]
    reader_epochs: Option<usize>,
}

impl ReaderOptions {
    /// Number of epochs of all networks of the reader; 0 without one.
    pub fn epochs(&self) -> usize {
        let config = self.relational(0);
        config.map_or(0, |config| config.epochs.saturating_mul(config.members))
    }

    /// Settings of the relational reader, if one is requested.
    pub fn relational(&self, seed: u64) -> Option<RelationalConfig> {
        let default = RelationalConfig::default();
        self.reader.map(|Reader::Relational| RelationalConfig {
            members: self.reader_members,
            epochs: self.reader_epochs.unwrap_or(default.epochs),
            seed,
            ..default
        })
    }
}

/// A training preset, with options that override single settings.
#[derive(Debug, Clone, Args)]
pub struct ProtocolOptions {
    /// Training protocol that supplies every setting not given below
    #[arg(long, value_parser = one_of::<Preset>(), default_value = "base")]
    preset: Preset,
    /// Frames from the source to the target of a test pair, 1 to 100000; also of a training pair
    /// unless these are drawn from a range of strides
    #[arg(long, default_value_t = 40)]
    stride: u32,
    /// How training and test pairs are kept apart
    #[arg(long, value_parser = split_choice(), default_value = "time")]
    split: SplitChoice,
    /// Number of epochs, 1 to 100000; the preset's if omitted
    #[arg(long)]
    epochs: Option<usize>,
    /// Draw training pairs with strides LOW-HIGH in frames, for instance 10-40; the preset's if
    /// omitted
    #[arg(long, value_name = "LOW-HIGH")]
    strides: Option<String>,
    /// Number of training pairs drawn from the range of strides, 1 to 10000000; the preset's if
    /// omitted, 30000 if it has none
    #[arg(long)]
    pairs: Option<usize>,
    /// Learning rate; the preset's if omitted (1e-3, steady 3e-4)
    #[arg(long)]
    lr: Option<f64>,
    /// Decoupled weight decay (AdamW) of every parameter; the preset's if omitted (0.01)
    #[arg(long)]
    weight_decay: Option<f64>,
    /// Pairs per optimizer step; the preset's if omitted (512)
    #[arg(long)]
    batch: Option<usize>,
    /// Width of φ's hidden layer; the preset's if omitted (64)
    #[arg(long)]
    hidden: Option<usize>,
    /// Latent dimension of each chart, the paper's geo_dim, at least 6; the preset's if omitted
    /// (20)
    #[arg(long)]
    geo_dim: Option<usize>,
    /// Number of charts, the paper's K, 1 to 16; the preset's if omitted (1)
    #[arg(long)]
    charts: Option<usize>,
    /// How several charts are combined; the preset's if omitted (gate)
    #[arg(long, value_parser = one_of::<Mixing>())]
    mixing: Option<Mixing>,
    /// Training loss on z-scored motions; the preset's if omitted (mse)
    #[arg(long, value_parser = one_of::<Loss>())]
    loss: Option<Loss>,
}

impl ProtocolOptions {
    /// Rejects `--split whole`, which has no test pairs, for commands that score on test pairs.
    pub fn needs_test_pairs(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            self.split != SplitChoice::One(Split::Whole),
            "--split whole has no test pairs; choose another split"
        );

        Ok(())
    }

    /// Rejects single values for the settings that a sweep varies over a grid.
    pub fn leaves_to_the_grid(&self) -> anyhow::Result<()> {
        for (given, option, grid) in [
            (self.geo_dim.is_some(), "--geo-dim", "--geo-dims"),
            (self.charts.is_some(), "--charts", "--chart-counts"),
            (self.lr.is_some(), "--lr", "--lrs"),
            (self.loss.is_some(), "--loss", "--losses"),
        ] {
            anyhow::ensure!(
                !given,
                "{option} is set by the sweep; give its values to {grid}, separated by commas"
            );
        }

        Ok(())
    }

    /// The same options with another stride.
    pub fn at_stride(&self, stride: u32) -> Self {
        Self {
            stride,
            ..self.clone()
        }
    }

    /// The selected splits: one, or the five folds.
    pub fn splits(&self) -> Vec<Split> {
        self.split.splits()
    }

    /// Name of the split; `folds` for the five folds.
    pub fn split_name(&self) -> &'static str {
        self.split.name()
    }

    /// The preset's training plan, with the given options in place of its settings.
    ///
    /// # Errors
    /// For a setting out of range, and for `--split folds`, which is not one plan.
    pub fn plan(&self, seed: u64) -> anyhow::Result<TrainingPlan> {
        let SplitChoice::One(split) = self.split else {
            anyhow::bail!(
                "--split folds trains one adapter per fold, but this command trains a single one: use one of \
                 fold1 to fold5"
            );
        };
        self.plan_under(split, seed)
    }

    /// The training plan of each selected split.
    pub fn plans(&self, seed: u64) -> anyhow::Result<Vec<TrainingPlan>> {
        self.splits()
            .into_iter()
            .map(|split| self.plan_under(split, seed))
            .collect()
    }

    fn plan_under(&self, split: Split, seed: u64) -> anyhow::Result<TrainingPlan> {
        anyhow::ensure!(
            (1..=MAX_STRIDE).contains(&self.stride),
            "--stride must be 1 to {MAX_STRIDE}, got {}",
            self.stride
        );

        // The preset comes first; every option that was given replaces one of its settings.
        let mut plan = TrainingPlan::of(self.preset, split, self.stride, seed);
        let config = &mut plan.config;
        let put = |into: &mut usize, given: Option<usize>| given.map_or((), |given| *into = given);
        put(&mut config.epochs, self.epochs);
        if self.epochs.is_some() {
            plan.least_steps = 0;
        }
        let config = &mut plan.config;

        put(&mut config.batch, self.batch);
        put(&mut config.hidden, self.hidden);
        put(&mut config.latent, self.geo_dim);
        put(&mut config.charts, self.charts);

        config.learning_rate = self.lr.unwrap_or(config.learning_rate);
        config.weight_decay = self.weight_decay.unwrap_or(config.weight_decay);
        config.mixing = self.mixing.unwrap_or(config.mixing);
        config.loss = self.loss.unwrap_or(config.loss);

        plan.pairs = self.pair_plan(plan.pairs)?;
        Ok(plan)
    }

    fn pair_plan(&self, preset: PairPlan) -> anyhow::Result<PairPlan> {
        // --strides or --pairs turn a preset with a single stride into pairs drawn at random;
        // 30,000 is the number that paper-range draws.
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
                        .with_context(|| format!("--strides: '{text}' is not a number of frames"))
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
            "--strides: {low}-{high} is not a range within 1 to {MAX_STRIDE}"
        );

        let count = self.pairs.unwrap_or(count);
        anyhow::ensure!(
            (1..=MAX_PAIRS).contains(&count),
            "--pairs must be 1 to {MAX_PAIRS}, got {count}"
        );

        Ok(PairPlan::Range(StrideRange { low, high, count }))
    }
}

/// The largest stride that is accepted, in frames.
const MAX_STRIDE: u32 = 100_000;

/// The largest number of training pairs that is accepted.
const MAX_PAIRS: usize = 10_000_000;

/// Train/test split of a command that trains its own adapters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SplitChoice {
    One(Split),
    /// The five folds, each trained and tested separately.
    Folds,
}

impl SplitChoice {
    /// Name of the split; `folds` for the five folds.
    pub fn name(self) -> &'static str {
        match self {
            Self::One(split) => split.name(),
            Self::Folds => "folds",
        }
    }

    /// The splits, in order.
    pub fn splits(self) -> Vec<Split> {
        match self {
            Self::One(split) => vec![split],
            Self::Folds => Split::FOLDS.to_vec(),
        }
    }
}

/// The parser of a split, or `folds`.
pub fn split_choice() -> impl TypedValueParser<Value = SplitChoice> {
    let folds = PossibleValue::new("folds").help(
        "Five-fold cross-validation: each contiguous fifth of the frames is tested once, by adapters \
         trained on the other four; the test pairs of all five are scored together. Only for probe, \
         sweep layers and sweep formulations",
    );
    let possible = possible_values::<Split>().chain([folds]);

    PossibleValuesParser::new(possible).try_map(|name| match name.as_str() {
        "folds" => Ok(SplitChoice::Folds),
        split => split.parse().map(SplitChoice::One),
    })
}

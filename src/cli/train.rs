//! `seese3 train`: learn an adapter and publish it.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use rayon::prelude::*;

use super::progress::bar;
use super::{check_writable, say, write_json};
use crate::adapter::{Adapter, Preset, Reading};
use crate::cancel::Cancellation;
use crate::eval::{NavigatorKind, Protocol, evaluate};
use crate::features::Features;
use crate::navigation::{IndexKind, Navigator};
use crate::pairs::Split;
use crate::report::{TrainingRun, training_json, training_table};
use crate::store::{Published, Store, StoredRoom};
use crate::training::{Lesson, Recipe, learn};

/// The most seeds of one command.
const MAX_SEEDS: u64 = 1_000;

#[derive(Debug, Args)]
pub struct Train {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room to learn from
    #[arg(long)]
    room: String,
    /// Which of its features; may be left out when it has one
    #[arg(long)]
    features: Option<String>,
    /// The protocol of the paper
    #[arg(long, value_enum, default_value_t = PresetName::PaperBase)]
    preset: PresetName,
    /// Frames from source to target
    #[arg(long, default_value_t = 40)]
    stride: u32,
    /// Passes over the pairs, instead of the preset's
    #[arg(long)]
    epochs: Option<usize>,
    /// How frames are kept apart for testing; `pairs` leaks on purpose
    #[arg(long, value_enum, default_value_t = SplitName::Time)]
    split: SplitName,
    /// Of weights and order, as PyTorch takes it: 32 bits
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    /// Train this many, from --seed on, and report mean and deviation; the first is published
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// The adapter's name in the store
    #[arg(long)]
    name: Option<String>,
    /// Write the scores here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PresetName {
    /// All pairs at one stride, 10 epochs
    PaperBase,
    /// 30,000 pairs with strides 10 to 40, 200 epochs
    PaperRange,
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
}

impl From<PresetName> for Preset {
    fn from(name: PresetName) -> Self {
        match name {
            PresetName::PaperBase => Self::PaperBase,
            PresetName::PaperRange => Self::PaperRange,
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
        }
    }
}

impl Train {
    pub async fn run(self) -> anyhow::Result<()> {
        if self.seeds == 0 || self.seeds > MAX_SEEDS {
            bail!("--seeds must be 1 to {MAX_SEEDS}, got {}", self.seeds);
        }
        if let Some(path) = &self.json {
            check_writable(path)?;
        }
        let store = Store::open(&self.store)?;
        let (stored, features) = store.load_room_with(&self.room, self.features.as_deref()).await?;
        let recipe = Recipe {
            preset: self.preset.into(),
            split: self.split.into(),
            stride: self.stride,
            epochs: self.epochs,
            seed: self.seed,
        };
        let (adapter, runs) = train_seeds(&stored, &features, &recipe, self.seeds)?;
        let name = self.name.unwrap_or_else(|| default_name(&self.room, &features, &recipe));
        let record = &runs[0].record;
        let published = store.publish_adapter(&name, &adapter, record, features.rows()).await?;
        let (split, stride, preset) = (recipe.split, recipe.stride, recipe.preset.name());
        say(format_args!(
            "room '{}' revision {}, features '{}' ({} columns), preset {preset}, stride {stride}, split {split}",
            self.room,
            stored.revision,
            features.source().name,
            features.source().dim,
        ));
        say(format_args!(
            "{} training pairs, {} test pairs, {} epochs; test R², and Hit@0.1 of inverse Poincaré (affine):",
            record.pair_count, record.test.n, record.config.epochs
        ));
        say(training_table(&runs).trim_end());
        say_published(&store, &name, &published);
        if let Some(path) = &self.json {
            write_json(path, &training_json(&runs, &name, published.revision))?;
            say(format_args!("wrote {}", path.display()));
        }
        Ok(())
    }
}

/// Trains one adapter a seed, on all cores; the first seed's adapter and every seed's scores.
pub fn train_seeds(
    stored: &StoredRoom,
    features: &Features,
    recipe: &Recipe,
    seeds: u64,
) -> anyhow::Result<(Adapter, Vec<TrainingRun>)> {
    let epochs = recipe.epochs.unwrap_or(recipe.preset.config(0).epochs) as u64;
    let progress = bar(epochs.saturating_mul(seeds), "training");
    let lesson = Lesson { room: &stored.room, revision: stored.revision, features };
    let trained: Vec<(Adapter, TrainingRun)> = (0..seeds)
        .into_par_iter()
        .map(|offset| {
            let seed = recipe.seed + offset;
            if seed > u64::from(u32::MAX) {
                bail!("--seed and --seeds reach over 2³²");
            }
            let begun = Instant::now();
            let recipe = Recipe { seed, ..recipe.clone() };
            let (adapter, record) = learn(lesson, &recipe, &mut |epoch| {
                progress.set_message(format!("loss {:.4}", epoch.loss));
                progress.inc(1);
            })?;
            let seconds = begun.elapsed().as_secs_f64();
            let navigation = inverse_poincare(stored, features, &adapter, &recipe)?;
            Ok((adapter, TrainingRun { record, navigation, seconds }))
        })
        .collect::<anyhow::Result<_>>()?;
    progress.finish_and_clear();
    let (adapters, runs): (Vec<Adapter>, Vec<TrainingRun>) = trained.into_iter().unzip();
    let first = adapters.into_iter().next().context("no seed was given")?;
    Ok((first, runs))
}

fn inverse_poincare(
    stored: &StoredRoom,
    features: &Features,
    adapter: &Adapter,
    recipe: &Recipe,
) -> anyhow::Result<crate::eval::RetrievalScores> {
    let room = std::sync::Arc::new(stored.room.clone());
    let navigator = Navigator::new(room, features, std::sync::Arc::new(adapter.clone()), IndexKind::Exact)?;
    let navigators = vec![NavigatorKind::InversePoincare(Reading::Affine)];
    let protocol = Protocol { split: recipe.split, navigators, ..Protocol::paper(recipe.stride) };
    let mut report = evaluate(&navigator, &protocol, &Cancellation::default(), &mut |_, _| ())?;
    Ok(report.rows.swap_remove(0).retrieval)
}

/// The name of an adapter that was given none.
pub fn default_name(room: &str, features: &Features, recipe: &Recipe) -> String {
    let Recipe { preset, split, stride, .. } = recipe;
    format!("{room}.{}.{}.s{stride}.{split}", features.source().name, preset.name())
}

/// Says where an adapter lies.
pub fn say_published(store: &Store, name: &str, published: &Published) {
    let state = if published.is_new { "published" } else { "already there, unchanged:" };
    say(format_args!(
        "{state} adapter '{name}' revision {}: {}/{}",
        published.revision,
        store.location(),
        published.manifest
    ));
}

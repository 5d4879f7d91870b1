//! `seese3 train`: learn an adapter and publish it.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, bail};
use clap::Args;
use rayon::prelude::*;

use super::progress::bar;
use super::protocol::ProtocolOptions;
use super::rooms::{lesson, load_rooms, room_words};
use super::{check_writable, say, write_json};
use crate::adapter::{
    Adapter, Calibration, CorrectorKind, Measured, Reading, TrainConfig, TrainingRecord,
};
use crate::cancel::Cancellation;
use crate::eval::tracking::place_factor;
use crate::eval::{NavigatorKind, Protocol, evaluate};
use crate::features::Features;
use crate::navigation::{IndexKind, Metric, Navigator, StepKind};
use crate::pairs::Split;
use crate::report::{TrainingRun, training_json, training_table};
use crate::scores::Rate;
use crate::store::{Published, Store, StoredRoom};
use crate::training::{Lesson, Recipe, calibrate, check_unseen, error_covariance, learn};

/// The most seeds of one command.
const MAX_SEEDS: u64 = 1_000;

#[derive(Debug, Args)]
pub struct Train {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The rooms to learn from together: names, or patterns with *; may be given several times
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Which of their features; may be left out when the first room has one
    #[arg(long)]
    features: Option<String>,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// Train these after the adapter, as further navigators: linear, mlp-2, mlp-3, attention, or
    /// all
    #[arg(long, value_delimiter = ',')]
    correctors: Vec<String>,
    /// Rooms in which the adapter's errors are measured, for navigators with +calibrated, and with
    /// two or more for tracking and relocalisation: names or patterns, none of them learned from
    #[arg(long)]
    calibrate_on: Vec<String>,
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

impl Train {
    pub async fn run(self) -> anyhow::Result<()> {
        if self.seeds == 0 || self.seeds > MAX_SEEDS {
            bail!("--seeds must be 1 to {MAX_SEEDS}, got {}", self.seeds);
        }
        if let Some(path) = &self.json {
            check_writable(path)?;
        }

        let store = Store::open(&self.store)?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;

        let recipe = Recipe {
            correctors: correctors(&self.correctors)?,
            ..self.protocol.recipe(self.seed)?
        };

        let source = rooms[0].1.source().name.clone();
        let calibration = match self.calibrate_on.is_empty() {
            true => Vec::new(),
            false => load_rooms(&store, &self.calibrate_on, Some(&source)).await?,
        };

        for room in &calibration {
            check_unseen(
                &lesson(room),
                rooms.iter().map(|(stored, _)| stored.room.id()),
            )?;
        }

        let (mut adapter, mut runs) = train_seeds(&rooms, &recipe, self.seeds)?;
        if !calibration.is_empty() {
            adapter = calibrated(adapter, &mut runs[0].record, &calibration)?;
        }

        let features = &rooms[0].1;
        let name = self.name.unwrap_or_else(|| default_name(&rooms, &recipe));
        let record = &runs[0].record;
        let published = store
            .publish_adapter(&name, &adapter, record, features.rows())
            .await?;

        let split = recipe.split;
        let stride = recipe.stride;
        let preset = recipe.preset.name();

        say(format_args!(
            "{}, features '{}' ({} columns), preset {preset}, stride {stride}, split {split}",
            room_words(&rooms),
            features.source().name,
            features.source().dim,
        ));

        let judged = match split {
            Split::Whole => {
                "no test pairs; train R², and in-sample Hit@0.1 of inverse Poincaré (affine)"
                    .to_owned()
            }
            _ => format!(
                "{} test pairs; test R² by room, averaged, and Hit@0.1 of inverse Poincaré (affine)",
                record.test.n
            ),
        };

        say(format_args!(
            "{} training pairs, {} epochs, {judged}:",
            record.pair_count, record.config.epochs
        ));

        say(training_table(&runs).trim_end());
        let still = record.test.still_components();
        if record.test.n > 0 && still > 0 {
            say(format_args!(
                "{still} of the 6 components of the motion never vary and are left out of the means"
            ));
        }

        say_published(&store, &name, &published);
        if let Some(path) = &self.json {
            write_json(path, &training_json(&runs, &name, published.revision))?;
            say(format_args!("wrote {}", path.display()));
        }

        Ok(())
    }
}

/// The adapter with its errors measured in rooms, which the record then names.
fn calibrated(
    adapter: Adapter,
    record: &mut TrainingRecord,
    rooms: &[(StoredRoom, Features)],
) -> anyhow::Result<Adapter> {
    let lessons: Vec<Lesson<'_>> = rooms.iter().map(lesson).collect();
    let covariance = error_covariance(&adapter, record, &lessons)?;
    let mut adapter = adapter.with_error_covariance(covariance)?;
    if lessons.len() > 1 {
        adapter = tracking(adapter, record, &lessons)?;
    } else {
        say("one room is too few to tell rooms apart in: the adapter can navigate, not track");
    }

    record.calibrated_on = rooms
        .iter()
        .map(|(stored, _)| (stored.room.id().clone(), stored.revision))
        .collect();

    say(format_args!("errors measured in {}", room_words(rooms)));
    Ok(adapter)
}

/// The adapter with its errors as a tracker needs them: measured pair by pair, then along the ways
/// of the same rooms.
fn tracking(
    adapter: Adapter,
    record: &TrainingRecord,
    lessons: &[Lesson<'_>],
) -> anyhow::Result<Adapter> {
    let first = calibrate(&adapter, record, lessons)?;
    let adapter = Arc::new(adapter.with_calibration(first.clone())?);
    let place = place_factor(&adapter, lessons)?
        .context("no place was found in the rooms to calibrate on")?;
    let measured = Measured {
        place,
        ..first.measured().clone()
    };

    Ok(Arc::unwrap_or_clone(adapter).with_calibration(Calibration::new(measured)?)?)
}

fn correctors(names: &[String]) -> anyhow::Result<Vec<CorrectorKind>> {
    if names == ["all"] {
        return Ok(CorrectorKind::ALL.to_vec());
    }

    let kind = |name: &String| {
        let known = CorrectorKind::ALL.map(CorrectorKind::name).join(", ");
        CorrectorKind::from_name(name)
            .with_context(|| format!("--correctors: '{name}' is not one of {known}"))
    };

    names.iter().map(kind).collect()
}

/// Trains one adapter a seed, on all cores; the first seed's adapter and every seed's scores.
pub fn train_seeds(
    rooms: &[(StoredRoom, Features)],
    recipe: &Recipe,
    seeds: u64,
) -> anyhow::Result<(Adapter, Vec<TrainingRun>)> {
    let progress = bar(
        (recipe.config.epochs as u64).saturating_mul(seeds),
        "training",
    );

    let lessons: Vec<Lesson<'_>> = rooms.iter().map(lesson).collect();
    let trained: Vec<(Adapter, TrainingRun)> = (0..seeds)
        .into_par_iter()
        .map(|offset| {
            let seed = recipe.config.seed + offset;
            if seed > u64::from(u32::MAX) {
                bail!("--seed and --seeds reach over 2³²");
            }

            let begun = Instant::now();

            let recipe = Recipe {
                config: TrainConfig {
                    seed,
                    ..recipe.config.clone()
                },
                ..recipe.clone()
            };

            let (adapter, record) = learn(&lessons, &recipe, &mut |epoch| {
                progress.set_message(format!("loss {:.4}", epoch.loss));
                progress.inc(1);
            })?;

            let seconds = begun.elapsed().as_secs_f64();
            let hit_rate = hit_rate(rooms, &adapter, &recipe)?;

            Ok((
                adapter,
                TrainingRun {
                    record,
                    hit_rate,
                    seconds,
                },
            ))
        })
        .collect::<anyhow::Result<_>>()?;

    progress.finish_and_clear();
    let (adapters, runs): (Vec<Adapter>, Vec<TrainingRun>) = trained.into_iter().unzip();
    let first = adapters.into_iter().next().context("no seed was given")?;

    Ok((first, runs))
}

/// Hit@0.1 of inverse Poincaré in the affine reading on the rooms' test pairs together.
fn hit_rate(
    rooms: &[(StoredRoom, Features)],
    adapter: &Adapter,
    recipe: &Recipe,
) -> anyhow::Result<Rate> {
    let adapter = Arc::new(adapter.clone());
    let kind = NavigatorKind::Step(StepKind::InversePoincare(Reading::Affine), Metric::Full);
    let protocol = Protocol {
        split: recipe.split,
        navigators: vec![kind],
        ..Protocol::paper(recipe.stride)
    };

    let mut hits = 0;
    let mut n = 0;
    for (stored, features) in rooms {
        let navigator = Navigator::new(
            Arc::new(stored.room.clone()),
            features,
            adapter.clone(),
            IndexKind::Exact,
        )?;

        let report = evaluate(
            &navigator,
            &protocol,
            &Cancellation::default(),
            &mut |_, _| (),
        )?;
        let rate = report.rows[0].retrieval.hits[0].1;

        hits = hits + rate.successes();
        n = n + rate.n;
    }

    Ok(Rate::of(hits, n))
}

/// The name of an adapter that was given none.
pub fn default_name(rooms: &[(StoredRoom, Features)], recipe: &Recipe) -> String {
    let Recipe {
        preset,
        split,
        stride,
        config,
        ..
    } = recipe;

    let first = rooms[0].0.room.id();
    let features = &rooms[0].1.source().name;

    let others = if rooms.len() > 1 {
        format!("-and-{}-more", rooms.len() - 1)
    } else {
        String::new()
    };
    let mut name = format!(
        "{first}{others}.{features}.{}.s{stride}.{split}",
        preset.name()
    );

    let plain = preset.config(0);
    if config.charts > 1 {
        name.push_str(&format!(".{}{}", config.mixing.name(), config.charts));
    }
    if config.loss != plain.loss {
        name.push_str(&format!(".{}", config.loss.name()));
    }
    if config.latent != plain.latent {
        name.push_str(&format!(".g{}", config.latent));
    }

    name
}

/// Says where an adapter lies.
pub fn say_published(store: &Store, name: &str, published: &Published) {
    let state = if published.is_new {
        "published"
    } else {
        "already there, unchanged:"
    };

    say(format_args!(
        "{state} adapter '{name}' revision {}: {}/{}",
        published.revision,
        store.location(),
        published.manifest
    ));
}

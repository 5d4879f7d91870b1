//! `seese3 cross-room`: learn from some rooms, navigate in others.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, bail};
use clap::Args;

use super::ask::ModeName;
use super::evaluate::navigators_named;
use super::progress::bar;
use super::protocol::{ProtocolOptions, SplitName};
use super::rooms::{lesson, load_rooms, room_words};
use super::{check_writable, say, write_json};
use crate::adapter::{Adapter, Reading, TrainConfig, TrainingRecord};
use crate::eval::{NavigatorKind, Protocol, check_thresholds};
use crate::features::Features;
use crate::generalisation::{nested_choice, outcomes};
use crate::navigation::{Metric, Refit, StepKind};
use crate::pairs::Split;
use crate::report::{CrossRoomRun, cross_room_json, cross_room_table, rooms_table, scaling_table};
use crate::store::{Store, StoredRoom};
use crate::training::{Lesson, Recipe, error_covariance, learn};

#[derive(Debug, Args)]
pub struct CrossRoom {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// Rooms to learn from: names, or patterns with *
    #[arg(long, required = true)]
    train: Vec<String>,
    /// Rooms that are held out: names, or patterns with *
    #[arg(long, required = true)]
    test: Vec<String>,
    /// Which of their features; may be left out when the first room has one
    #[arg(long)]
    features: Option<String>,
    /// How many rooms to take, those kept aside among them, separated by commas: the scaling curve;
    /// all of them if nothing is given
    #[arg(long, value_delimiter = ',')]
    sizes: Vec<usize>,
    /// Of the rooms to learn from, so many are kept aside to measure the adapter's errors in, for
    /// +calibrated
    #[arg(long, default_value_t = 0)]
    aside: usize,
    /// Adapters of each size, from --seed on
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// Of weights, order and drawn pairs, and of which rooms a smaller size takes
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    seed: u64,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// Which frames of a held-out room are asked for and looked among
    #[arg(long, value_enum, default_value_t = SplitName::Whole)]
    test_split: SplitName,
    /// Navigators by name, separated by commas; identity, inverse Poincaré and ridge-refits if
    /// nothing is given
    #[arg(long, value_delimiter = ',')]
    navigators: Vec<String>,
    /// The navigator that others are compared with
    #[arg(long, default_value = "inverse-poincare-affine")]
    baseline: String,
    /// ε of Hit@ε
    #[arg(long, default_value_t = 0.1)]
    threshold: f64,
    /// The source frame may not be retrieved
    #[arg(long)]
    exclude_source: bool,
    /// Show every room
    #[arg(long)]
    rooms: bool,
    /// Write all of it here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

type Loaded = (StoredRoom, Features);

impl CrossRoom {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(file) = &self.json {
            check_writable(file)?;
        }

        let store = Store::open(&self.store)?;
        let train = load_rooms(&store, &self.train, self.features.as_deref()).await?;
        let source = train[0].1.source().name.clone();
        let test = load_rooms(&store, &self.test, Some(&source)).await?;
        let shared = |(room, _): &&Loaded| {
            test.iter()
                .any(|(other, _)| other.room.id() == room.room.id())
        };

        if let Some((room, _)) = train.iter().find(shared) {
            bail!(
                "room '{}' is both learned from and held out",
                room.room.id()
            );
        }

        let sizes = self.sizes(train.len())?;
        let protocol = self.test_protocol()?;
        check_thresholds(&protocol.thresholds)?;
        let recipe = self.protocol.recipe(self.seed)?;
        let progress = bar(
            (sizes.len() as u64) * self.seeds * (recipe.config.epochs + test.len()) as u64,
            "rooms",
        );

        let mut runs = Vec::new();
        for &size in &sizes {
            for seed in self.seed..self.seed + self.seeds {
                let chosen = nested_choice(size, train.len(), seed);
                let chosen: Vec<&Loaded> = chosen.into_iter().map(|room| &train[room]).collect();

                let recipe = Recipe {
                    config: TrainConfig {
                        seed,
                        ..recipe.config.clone()
                    },
                    ..recipe.clone()
                };

                let (adapter, record) = self.learned(&chosen, &recipe, &|| progress.inc(1))?;
                let lessons: Vec<Lesson<'_>> = test.iter().map(lesson).collect();
                let found = outcomes(&Arc::new(adapter), &lessons, &protocol, &|| progress.inc(1));
                runs.push(run_of(found, &record, seed));
            }
        }

        progress.finish_and_clear();

        if let Some((room, why)) = runs
            .iter()
            .find(|run| run.outcomes.is_empty())
            .and_then(|run| run.skipped.first())
        {
            bail!("no held-out room could be evaluated; room '{room}': {why}");
        }

        self.say(&train, &test, &recipe, &runs)?;

        if let Some(file) = &self.json {
            let mut record = cross_room_json(&runs, &self.baseline);
            record["features"] = source.into();
            record["stride"] = recipe.stride.into();
            record["preset"] = recipe.preset.name().into();

            record["epochs"] = recipe.config.epochs.into();
            record["learning_rate"] = recipe.config.learning_rate.into();
            record["split"] = recipe.split.name().into();
            record["source_excluded"] = self.exclude_source.into();

            record["test_split"] = protocol.split.name().into();
            record["threshold"] = self.threshold.into();
            write_json(file, &record)?;
            say(format_args!("wrote {}", file.display()));
        }

        Ok(())
    }

    fn sizes(&self, rooms: usize) -> anyhow::Result<Vec<usize>> {
        let sizes = if self.sizes.is_empty() {
            vec![rooms]
        } else {
            self.sizes.clone()
        };

        for &size in &sizes {
            if size <= self.aside || size > rooms {
                bail!(
                    "of {size} rooms (--sizes, or all) {} are kept aside: sizes must be over --aside and at most {rooms}",
                    self.aside
                );
            }
        }

        Ok(sizes)
    }

    fn test_protocol(&self) -> anyhow::Result<Protocol> {
        let full = |step: StepKind| NavigatorKind::Step(step, Metric::Full);
        let refit = |in_sample: bool| {
            full(StepKind::Refit(Refit {
                z_scored: false,
                intercept: false,
                in_sample,
            }))
        };

        let inverse = |reading: Reading, metric: Metric| {
            NavigatorKind::Step(StepKind::InversePoincare(reading), metric)
        };

        let mut navigators = navigators_named(&self.navigators)?;
        if navigators.is_empty() {
            navigators = vec![NavigatorKind::Identity];

            navigators.extend(
                [Reading::Affine, Reading::Homogeneous]
                    .map(|reading| inverse(reading, Metric::Full)),
            );

            if self.aside > 0 {
                navigators.push(inverse(Reading::Homogeneous, Metric::Calibrated));
            }
            if self.test_split != SplitName::Whole {
                navigators.push(refit(false));
            }

            navigators.push(refit(true));
        }

        for kind in &navigators {
            match kind {
                NavigatorKind::Step(StepKind::Corrector(_), _) => {
                    bail!("--navigators: no correctors are trained here")
                }
                NavigatorKind::Step(_, Metric::Calibrated) if self.aside == 0 => {
                    bail!(
                        "--navigators: '{}' needs rooms to measure errors in; give --aside",
                        kind.name()
                    );
                }
                NavigatorKind::Step(StepKind::Refit(refit), _)
                    if !refit.in_sample && self.test_split == SplitName::Whole =>
                {
                    bail!(
                        "--navigators: '{}' has nothing to be fitted on under --test-split whole",
                        kind.name()
                    );
                }
                _ => {}
            }
        }

        let baseline = NavigatorKind::from_name(&self.baseline).with_context(|| {
            format!(
                "--baseline: '{}' is not one of {}",
                self.baseline,
                NavigatorKind::known_names()
            )
        })?;

        for needed in [NavigatorKind::Identity, baseline] {
            if !navigators.contains(&needed) {
                navigators.push(needed);
            }
        }

        Ok(Protocol {
            split: self.test_split.into(),
            thresholds: vec![self.threshold],
            exclude_source: self.exclude_source.then_some(0),
            mode: ModeName::OpenLoop.into(),
            navigators,
            ..Protocol::paper(self.protocol.recipe(self.seed)?.stride)
        })
    }

    /// An adapter of all rooms but the last ones, which its errors are measured in.
    fn learned(
        &self,
        rooms: &[&Loaded],
        recipe: &Recipe,
        epoch: &dyn Fn(),
    ) -> anyhow::Result<(Adapter, TrainingRecord)> {
        let (learned, aside) = rooms.split_at(rooms.len() - self.aside);
        let learned: Vec<Lesson<'_>> = learned.iter().map(|room| lesson(room)).collect();
        let aside: Vec<Lesson<'_>> = aside.iter().map(|room| lesson(room)).collect();
        let (mut adapter, mut record) = learn(&learned, recipe, &mut |_| epoch())?;

        if !aside.is_empty() {
            adapter = adapter
                .clone()
                .with_error_covariance(error_covariance(&adapter, &record, &aside)?)?;

            record.calibrated_on = aside
                .iter()
                .map(|lesson| (lesson.room.id().clone(), lesson.revision))
                .collect();
        }

        Ok((adapter, record))
    }

    fn say(
        &self,
        train: &[Loaded],
        test: &[Loaded],
        recipe: &Recipe,
        runs: &[CrossRoomRun],
    ) -> anyhow::Result<()> {
        say(format_args!(
            "rooms to learn from: {}, features '{}', preset {} with {} epochs, split {}; held out: {}, stride {}, split \
             {}, source {}",
            room_words(train),
            train[0].1.source().name,
            recipe.preset.name(),
            recipe.config.epochs,
            recipe.split,
            room_words(test),
            recipe.stride,
            Split::from(self.test_split),
            if self.exclude_source {
                "excluded"
            } else {
                "included"
            },
        ));

        for run in runs {
            for (room, why) in &run.skipped {
                say(format_args!("room '{room}' was skipped: {why}"));
            }
        }

        if runs.len() > 1 {
            say(scaling_table(runs, &self.baseline, self.threshold).trim_end());
        }

        let last = runs.last().context("no run")?;
        say(format_args!(
            "the last run: {} rooms learned from, {} to measure errors in, seed {}:",
            last.learned.len(),
            last.aside.len(),
            last.seed
        ));

        say(cross_room_table(last, &self.baseline, self.threshold).trim_end());
        if self.rooms {
            say(rooms_table(last).trim_end());
        }

        Ok(())
    }
}

fn names(rooms: &[(crate::room::RoomId, u64)]) -> Vec<String> {
    rooms.iter().map(|(room, _)| room.to_string()).collect()
}

fn run_of(
    found: Vec<
        Result<
            crate::generalisation::RoomOutcome,
            (crate::room::RoomId, crate::generalisation::Error),
        >,
    >,
    record: &TrainingRecord,
    seed: u64,
) -> CrossRoomRun {
    let mut evaluated = Vec::new();
    let mut skipped = Vec::new();
    for outcome in found {
        match outcome {
            Ok(outcome) => evaluated.push(outcome),
            Err((room, why)) => skipped.push((room.to_string(), why.to_string())),
        }
    }

    CrossRoomRun {
        learned: names(&record.rooms),
        aside: names(&record.calibrated_on),
        seed,
        outcomes: evaluated,
        skipped,
    }
}

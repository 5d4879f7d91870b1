//! `seese3 evaluate`: the paper's navigation table on a room's held-out motions, and the errors of
//! paths.

mod odometry;
mod trajectory;

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, bail};
use clap::{Args, Subcommand};
use serde_json::json;

use super::ask::ModeName;
use super::progress::bar;
use super::protocol::SplitName;
use super::{check_writable, say, write_json};
use crate::adapter::TrainingRecord;
use crate::cancel::Cancellation;
use crate::eval::{NavigatorKind, Protocol, evaluate};
use crate::navigation::{IndexKind, Navigator};
use crate::pairs::Split;
use crate::report::{evaluation_json, evaluation_table};
use crate::store::{Store, StoredAdapter};

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Evaluate {
    #[command(subcommand)]
    what: Option<What>,
    #[command(flatten)]
    navigation: Option<Navigation>,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Follow held-out frames: paths, covariances, what is lost, and which room it is
    Odometry(odometry::Odometry),
    /// APE and RPE of a path against the true one, as evo takes them
    Trajectory(trajectory::Trajectory),
}

impl Evaluate {
    pub async fn run(self) -> anyhow::Result<()> {
        match (self.what, self.navigation) {
            (Some(What::Odometry(odometry)), _) => odometry.run().await,
            (Some(What::Trajectory(trajectory)), _) => trajectory.run(),
            (None, Some(navigation)) => navigation.run().await,
            (None, None) => {
                bail!("name a room with --room, or what to evaluate: see `seese3 evaluate --help`")
            }
        }
    }
}

/// The navigation table.
#[derive(Debug, Args)]
struct Navigation {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// Which of its features; may be left out when it has one
    #[arg(long)]
    features: Option<String>,
    /// Which adapter; the newest that was trained on the room with this split, if none is named
    #[arg(long)]
    adapter: Option<String>,
    /// Frames from source to target; the adapter's own, if none is given
    #[arg(long)]
    stride: Option<u32>,
    /// How frames are kept apart; the adapter's own, if none is given
    #[arg(long, value_enum)]
    split: Option<SplitName>,
    /// The source frame may not be retrieved
    #[arg(long)]
    exclude_source: bool,
    /// ε of Hit@ε, separated by commas
    #[arg(long, value_delimiter = ',', default_values_t = crate::navigation::HIT_THRESHOLDS)]
    thresholds: Vec<f64>,
    /// Rows of the table by name, separated by commas; a way to step may have +row-space, +whitened
    /// or +motion, inverse-poincare-homogeneous also +calibrated
    #[arg(long, value_delimiter = ',')]
    navigators: Vec<String>,
    /// Equal parts of each motion
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    steps: u32,
    /// How the parts hang together
    #[arg(long, value_enum, default_value_t = ModeName::OpenLoop)]
    mode: ModeName,
    /// Of the random navigator
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Write the table here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Navigation {
    async fn run(self) -> anyhow::Result<()> {
        if let Some(path) = &self.json {
            check_writable(path)?;
        }

        let store = Store::open(&self.store)?;
        let chosen = choose(&store, &self, self.split.map(Into::into)).await?;
        let features_name = self
            .features
            .clone()
            .unwrap_or_else(|| chosen.adapter.source().name.clone());
        let (stored, features) = store
            .load_room_with(&self.room, Some(&features_name))
            .await?;

        let record = chosen.record.clone();
        let protocol = self.protocol(&record)?;
        let room = Arc::new(stored.room);
        let navigator =
            Navigator::new(room, &features, Arc::new(chosen.adapter), IndexKind::Exact)?;
        let rows = protocol.rows(&navigator)?.len();
        let progress = bar(rows as u64, "evaluating");

        let report = evaluate(
            &navigator,
            &protocol,
            &Cancellation::default(),
            &mut |done, kind| {
                progress.set_position(done as u64);
                progress.set_message(kind.name());
            },
        )?;

        progress.finish_and_clear();

        let in_room = record
            .rooms
            .iter()
            .any(|(room, _)| room.as_str() == self.room);

        let trained = record
            .rooms
            .iter()
            .find(|(room, _)| room.as_str() == self.room)
            .map(|(_, revision)| *revision);

        let other_frames = match trained {
            Some(revision) => {
                !store
                    .same_frames(&self.room, revision, stored.revision)
                    .await?
            }
            None => false,
        };

        let leaky = [Split::Whole, Split::Pairs].contains(&record.split);
        let leaks = in_room && (record.split != protocol.split || leaky || other_frames);

        say(format_args!(
            "room '{}' revision {}, features '{features_name}', adapter '{}' revision {} ({})",
            self.room,
            stored.revision,
            chosen.name,
            chosen.revision,
            if in_room {
                "trained in this room"
            } else {
                "never saw this room"
            },
        ));

        let side = if self.exclude_source {
            "excluded"
        } else {
            "included"
        };
        say(format_args!(
            "split {}, stride {}: {} test pairs, {} candidate frames, source {side}",
            protocol.split, protocol.stride, report.n, report.candidate_count
        ));

        self.say_caveats(&protocol, &record, leaks, other_frames);
        say(evaluation_table(&report).trim_end());

        if let Some(path) = &self.json {
            let adapter = json!({ "name": chosen.name, "revision": chosen.revision, "preset": record.preset,
                "trained_split": record.split.name(), "trained_stride": record.stride, "seed": record.config.seed });

            let context = [
                (
                    "room",
                    json!({ "name": self.room, "revision": stored.revision }),
                ),
                ("features", json!(features_name)),
                ("adapter", adapter),
                ("in_room", json!(in_room)),
                ("leaks", json!(leaks)),
            ];

            let context = context
                .map(|(key, value)| (key.to_owned(), value))
                .into_iter()
                .collect();
            write_json(path, &evaluation_json(&report, context))?;

            say(format_args!("wrote {}", path.display()));
        }

        Ok(())
    }

    /// What the table must not be read without.
    fn say_caveats(
        &self,
        protocol: &Protocol,
        record: &TrainingRecord,
        leaks: bool,
        other_frames: bool,
    ) {
        if protocol.steps > 1 {
            say(format_args!(
                "{} equal parts of each motion, {}",
                protocol.steps,
                protocol.mode.name()
            ));
        }

        if record
            .calibrated_on
            .iter()
            .any(|(room, _)| room.as_str() == self.room)
        {
            say(
                "LEAK: the adapter's errors were measured in this room; +calibrated has seen its poses",
            );
        }

        if leaks {
            let why = if other_frames {
                "on other frames of this room".to_owned()
            } else {
                format!("under the split '{}'", record.split)
            };
            say(format_args!(
                "LEAK: the adapter was trained {why}; test pairs may have been trained on"
            ));
        }
    }

    /// What is asked for, the adapter's own split and stride where nothing is.
    fn protocol(&self, record: &TrainingRecord) -> anyhow::Result<Protocol> {
        Ok(Protocol {
            split: self.split.map_or(record.split, Into::into),
            stride: self.stride.unwrap_or(record.stride),
            exclude_source: self.exclude_source.then_some(0),
            thresholds: self.thresholds.clone(),
            seed: self.seed,
            steps: self.steps,
            mode: self.mode.into(),
            navigators: navigators_named(&self.navigators)?,
        })
    }
}

/// Navigators by name.
pub fn navigators_named(names: &[String]) -> anyhow::Result<Vec<NavigatorKind>> {
    let named = |name: &String| {
        let unknown = || {
            format!(
                "--navigators: '{name}' is not one of {}",
                NavigatorKind::known_names()
            )
        };
        NavigatorKind::from_name(name).with_context(unknown)
    };

    names.iter().map(named).collect()
}

/// The adapter that was named, or the newest that fits the room, its features, the split and, if
/// one does, the stride.
async fn choose(
    store: &Store,
    wanted: &Navigation,
    split: Option<Split>,
) -> anyhow::Result<StoredAdapter> {
    if let Some(name) = &wanted.adapter {
        return Ok(store.load_adapter(name, None).await?);
    }

    let names = store.adapter_names().await?;
    let mut fitting = Vec::new();
    for name in &names {
        let stored = match store.load_adapter(name, None).await {
            Ok(stored) => stored,
            Err(error) => {
                say(format_args!("passed over adapter '{name}': {error}"));
                continue;
            }
        };

        let fits = wanted
            .features
            .as_ref()
            .is_none_or(|name| *name == stored.adapter.source().name)
            && stored
                .record
                .rooms
                .iter()
                .any(|(room, _)| room.as_str() == wanted.room)
            && split.is_none_or(|split| split == stored.record.split);

        if fits {
            fitting.push(stored);
        }
    }

    let same_stride = |stored: &StoredAdapter| {
        wanted
            .stride
            .is_none_or(|stride| stride == stored.record.stride)
    };
    let best = |a: &StoredAdapter| (same_stride(a), a.created.clone(), a.name.clone());

    match fitting.into_iter().max_by(|a, b| best(a).cmp(&best(b))) {
        Some(stored) => Ok(stored),
        None => bail!(
            "no adapter was trained on room '{}' with these features and this split; the store has {}; \
             train one with `seese3 train --store {} --room {}`, or name one with --adapter",
            wanted.room,
            if names.is_empty() {
                "none".to_owned()
            } else {
                names.join(", ")
            },
            wanted.store,
            wanted.room,
        ),
    }
}

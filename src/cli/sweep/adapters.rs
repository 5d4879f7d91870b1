//! `seese3 sweep adapters`.

use std::collections::{BTreeMap, HashSet};
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::Args;
use rayon::prelude::*;

use super::super::progress::bar;
use super::super::protocol::{LossName, ProtocolOptions};
use super::super::rooms::load_rooms;
use super::super::{say, write_file};
use super::journal::{self, Journal};
use super::one::{content, done, row};
use crate::adapter::{Loss, TrainConfig};
use crate::features::Features;
use crate::generalisation::nested_choice;
use crate::report::{
    SweepRow, aligned, configurations_rows, difficulty_rows, parts_rows, success_rows,
    sweep_parquet,
};
use crate::store::{Store, StoredRoom};
use crate::training::Recipe;

/// Configurations that are shown.
const SHOWN: usize = 10;

#[derive(Debug, Args)]
pub struct Adapters {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The rooms, each learned by itself: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Features by name, separated by commas; may be left out when the first room has one
    #[arg(long, value_delimiter = ',')]
    features: Vec<String>,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// Latent sizes, separated by commas
    #[arg(long, value_delimiter = ',', default_values_t = [10, 20, 40, 80, 160, 320])]
    geo_dims: Vec<usize>,
    /// Counts of charts
    #[arg(long, value_delimiter = ',', default_values_t = [1, 2, 4])]
    chart_counts: Vec<usize>,
    /// Learning rates
    #[arg(long, value_delimiter = ',', default_values_t = [3e-4, 1e-3, 3e-3, 1e-2, 3e-2])]
    lrs: Vec<f64>,
    /// Losses
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [LossName::Mse, LossName::Cosine, LossName::Rotation])]
    losses: Vec<LossName>,
    /// Runs of each configuration, from seed 0 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// Only so many configurations, drawn from the grid by --sample-seed; all if nothing is given
    #[arg(long)]
    sample: Option<usize>,
    /// Of --sample
    #[arg(long, default_value_t = 0)]
    sample_seed: u64,
    /// Only part I of N of the runs, for a scheduler that spreads them: 1/4 to 4/4
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: String,
    /// Where the runs go: a folder; what it holds already is not done again
    #[arg(long)]
    out: PathBuf,
}

/// A run that is to be done.
struct Task<'a> {
    room: &'a (StoredRoom, Features),
    recipe: Recipe,
    row: SweepRow,
}

impl Adapters {
    pub async fn run(self) -> anyhow::Result<()> {
        let (part, parts) = self.shard()?;
        self.protocol.needs_test_pairs()?;
        self.protocol.leaves_to_the_grid()?;
        ensure!(self.sample != Some(0), "--sample must be at least 1");

        let store = Store::open(&self.store)?;
        let mut rooms = Vec::new();
        match self.features.as_slice() {
            [] => rooms.extend(load_rooms(&store, &self.rooms, None).await?),
            names => {
                for name in names {
                    rooms.extend(load_rooms(&store, &self.rooms, Some(name)).await?);
                }
            }
        }

        let journal = Journal::open(&self.out, &format!("shard-{part}-of-{parts}"))?;
        let known: HashSet<String> = journal::rows(&self.out)?
            .into_iter()
            .map(|row| row.key)
            .collect();

        let tasks = self.tasks(&rooms)?;
        let keys: HashSet<String> = tasks.iter().map(|task| task.row.key.clone()).collect();
        let all = tasks.len();

        let ours: Vec<Task<'_>> = tasks
            .into_iter()
            .skip(part - 1)
            .step_by(parts)
            .filter(|task| !known.contains(&task.row.key))
            .collect();
        say(format_args!(
            "{} rooms and features; {all} runs, {} of them to be done here (shard {part} of {parts})",
            rooms.len(),
            ours.len()
        ));

        let progress = bar(ours.len() as u64, "sweep");
        ours.into_par_iter().try_for_each(|task| {
            let row = done(task.room, &task.recipe, task.row);
            progress.inc(1);
            journal.add(&row)
        })?;

        progress.finish_and_clear();
        let in_folder = journal::rows(&self.out)?;
        let file = self.out.join("runs.parquet");
        write_file(
            &file,
            &sweep_parquet(&in_folder).map_err(anyhow::Error::msg)?,
        )?;

        let rows: Vec<SweepRow> = in_folder
            .iter()
            .filter(|row| keys.contains(&row.key))
            .cloned()
            .collect();
        self.say_summary(&rows)?;

        say(format_args!(
            "wrote {} ({} rows, every run of the folder)",
            file.display(),
            in_folder.len()
        ));

        ensure!(
            rows.iter().any(|row| row.failure.is_empty()),
            "no run of this grid has scores"
        );

        Ok(())
    }

    /// The tables of this grid, and which rooms have no scores.
    fn say_summary(&self, rows: &[SweepRow]) -> anyhow::Result<()> {
        let base = self.protocol.recipe(0)?;
        say(format_args!(
            "preset {} with {} epochs, split {}, stride {}; of each room the best run counts, chosen by its test score:",
            base.preset.name(),
            base.config.epochs,
            base.split,
            base.stride
        ));

        say(aligned(&success_rows(rows)).trim_end());
        say("\nhow hard the rooms are:");
        say(aligned(&difficulty_rows(rows)).trim_end());

        say(format_args!(
            "\nby part of the motion, over {} runs:",
            rows.len()
        ));

        say(aligned(&parts_rows(rows)).trim_end());
        say("\nthe best configurations by mean R²:");
        say(aligned(&configurations_rows(rows, SHOWN)).trim_end());
        let mut failures: BTreeMap<(&str, &str), usize> = BTreeMap::new();

        for row in rows.iter().filter(|row| !row.failure.is_empty()) {
            *failures.entry((&row.room, &row.failure)).or_default() += 1;
        }

        for ((room, why), count) in &failures {
            say(format_args!(
                "room '{room}': {count} runs have no scores: {why}"
            ));
        }

        Ok(())
    }

    fn shard(&self) -> anyhow::Result<(usize, usize)> {
        let parts = self
            .shard
            .split_once('/')
            .and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));

        match parts {
            Some((part, parts)) if (1..=parts).contains(&part) => Ok((part, parts)),
            _ => bail!("--shard is I/N with I from 1 to N, got '{}'", self.shard),
        }
    }

    /// Every run of the grid, in an order that depends on nothing but the arguments.
    fn tasks<'a>(&self, rooms: &'a [(StoredRoom, Features)]) -> anyhow::Result<Vec<Task<'a>>> {
        let mut grid: Vec<(usize, usize, f64, Loss)> = Vec::new();
        for &geo_dim in &self.geo_dims {
            for &charts in &self.chart_counts {
                for &lr in &self.lrs {
                    grid.extend(
                        self.losses
                            .iter()
                            .map(|&loss| (geo_dim, charts, lr, Loss::from(loss))),
                    );
                }
            }
        }

        ensure!(
            !grid.is_empty(),
            "the grid is empty: give at least one of --geo-dims, --chart-counts, --lrs, --losses"
        );

        if let Some(count) = self.sample {
            let chosen = nested_choice(count, grid.len(), self.sample_seed);
            grid = chosen.into_iter().map(|place| grid[place]).collect();
        }

        let base = self.protocol.recipe(0)?;
        let mut tasks = Vec::new();
        for room in rooms {
            let content = content(room);
            for &(latent, charts, learning_rate, loss) in &grid {
                for seed in 0..self.seeds {
                    let config = TrainConfig {
                        latent,
                        charts,
                        learning_rate,
                        loss,
                        seed,
                        ..base.config.clone()
                    };

                    let recipe = Recipe {
                        config,
                        ..base.clone()
                    };
                    recipe.check().context("the grid")?;

                    let row = row(room, &content, &recipe);
                    tasks.push(Task { room, recipe, row });
                }
            }
        }

        Ok(tasks)
    }
}

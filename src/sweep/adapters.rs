//! `seese3 sweep adapters`: one adapter per room and grid point, resumable and sharded.

use std::collections::{BTreeMap, HashSet};
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use rayon::prelude::*;
use serde_json::json;

use super::super::named::one_of;
use super::super::output::{JsonOutput, say, write_file};
use super::super::progress::bar;
use super::super::protocol::ProtocolOptions;
use super::super::rooms::{data, load_rooms};
use super::super::shard::Shard;
use super::journal::{self, SweepJournal};
use crate::table_files::TableFiles;
use seese3_core::adapter::{Loss, TrainConfig};
use seese3_core::features::Features;
use seese3_core::training::TrainingPlan;
use seese3_lab::experiments::adapter_sweep::{SweepRow, content, row, run};
use seese3_lab::experiments::cross_room::nested_choice;
use seese3_lab::report::{
    configurations_table, difficulty_table, parts_table, success_table, sweep_parquet,
};
use seese3_store::{Store, StoredRoom};

/// Number of best configurations that are printed.
const SHOWN: usize = 10;

#[derive(Debug, Args)]
pub struct Adapters {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms, each trained on separately: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Feature sets by name, separated by commas; may be omitted when the first room has only one
    #[arg(long, value_delimiter = ',')]
    features: Vec<String>,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// Latent sizes, separated by commas
    #[arg(long, value_delimiter = ',', default_values_t = [10, 20, 40, 80, 160, 320])]
    geo_dims: Vec<usize>,
    /// Numbers of charts K, separated by commas
    #[arg(long, value_delimiter = ',', default_values_t = [1, 2, 4])]
    chart_counts: Vec<usize>,
    /// Learning rates, separated by commas
    #[arg(long, value_delimiter = ',', default_values_t = [3e-4, 1e-3, 3e-3, 1e-2, 3e-2])]
    lrs: Vec<f64>,
    /// Losses, separated by commas
    #[arg(long, value_parser = one_of::<Loss>(), value_delimiter = ',', default_values = ["mse", "cosine", "rotation"])]
    losses: Vec<Loss>,
    /// Number of runs of each configuration, with seeds from 0 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// Run only this many configurations, drawn from the grid by --sample-seed; all if omitted
    #[arg(long)]
    sample: Option<usize>,
    /// Seed of --sample
    #[arg(long, default_value_t = 0)]
    sample_seed: u64,
    /// Run only shard I of N, to distribute a sweep over jobs: 1/4 to 4/4
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: Shard,
    /// Folder of the results; runs that it already holds are not repeated
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

/// A pending run, with its row without scores.
struct Task<'a> {
    room: &'a (StoredRoom, Features),
    plan: TrainingPlan,
    row: SweepRow,
}

impl Adapters {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        let Shard { part, parts } = self.shard;
        self.protocol.needs_test_pairs()?;
        self.protocol.leaves_to_the_grid()?;
        ensure!(
            self.protocol.splits().len() == 1,
            "--split folds: this sweep reports the best run of each room, which would favor its easiest fold; use one \
             of fold1 to fold5, or `seese3 probe --split folds`"
        );
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

        let journal = SweepJournal::open(&self.out, &format!("shard-{part}-of-{parts}"))?;

        // Skip the runs that any shard has finished, now or before a restart.
        let known: HashSet<String> = journal::rows(&self.out)?
            .into_iter()
            .map(|row| row.key)
            .collect();

        let tasks = self.tasks(&rooms)?;
        let keys: HashSet<String> = tasks.iter().map(|task| task.row.key.clone()).collect();
        let all = tasks.len();

        // The full list is cut into shards before finished runs are dropped: shards never overlap,
        // whatever has been done already.
        let mut ours = self.shard.tasks(tasks);
        ours.retain(|task| !known.contains(&task.row.key));
        say(format_args!(
            "{} combinations of room and features; {all} runs, {} of them to be done here (shard {part} of {parts})",
            rooms.len(),
            ours.len()
        ));

        let progress = bar(ours.len() as u64, "sweep");

        // Each row is written when its run ends, so a killed sweep loses only the runs in progress.
        ours.into_par_iter().try_for_each(|task| {
            let row = run(&data(task.room), &task.plan, task.row);
            progress.inc(1);
            journal.add(&row)
        })?;

        progress.finish_and_clear();

        // The Parquet file has every run of the folder; the printed tables cover only this grid.
        let in_folder = journal::rows(&self.out)?;
        let file = self.out.join("runs.parquet");
        write_file(&file, &sweep_parquet(&in_folder)?)?;

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

        self.json.write(&json!({ "runs": rows }))?;

        // Failed runs also have rows, but a sweep without any score has failed.
        ensure!(
            rows.iter().any(|row| row.failure.is_empty()),
            "no run of this grid has scores"
        );

        Ok(())
    }

    /// Prints the tables of this grid, and the rooms without scores.
    fn say_summary(&self, rows: &[SweepRow]) -> anyhow::Result<()> {
        let base = self.protocol.plan(0)?;
        say(format_args!(
            "preset {} with {} epochs, split {}, stride {}; best run of each room, selected by test score:",
            base.preset.name(),
            base.config.epochs,
            base.split,
            base.stride
        ));

        self.files
            .say(&success_table(rows), "best run of each room")?;
        say("\nroom difficulty:");
        say(difficulty_table(rows));

        say(format_args!(
            "\nby part of the motion, over {} runs:",
            rows.len()
        ));

        say(parts_table(rows));
        say("\nthe best configurations by mean R²:");
        say(configurations_table(rows, SHOWN));

        // One line per room and reason, however many runs failed for it.
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

    /// Every run of the grid. The order depends only on the rooms and the arguments, so that all
    /// shards divide the same list.
    fn tasks<'a>(&self, rooms: &'a [(StoredRoom, Features)]) -> anyhow::Result<Vec<Task<'a>>> {
        let mut grid: Vec<(usize, usize, f64, Loss)> = Vec::new();
        for &geo_dim in &self.geo_dims {
            for &charts in &self.chart_counts {
                for &lr in &self.lrs {
                    grid.extend(self.losses.iter().map(|&loss| (geo_dim, charts, lr, loss)));
                }
            }
        }

        ensure!(
            !grid.is_empty(),
            "the grid is empty: give at least one of --geo-dims, --chart-counts, --lrs, --losses"
        );

        // A smaller sample with the same seed is a subset of a larger one, so a sweep can be
        // extended.
        if let Some(count) = self.sample {
            let chosen = nested_choice(count, grid.len(), self.sample_seed);
            grid = chosen.into_iter().map(|place| grid[place]).collect();
        }

        let plans = self.plans(&grid)?;
        let mut tasks = Vec::new();
        for room in rooms {
            let content = content(&data(room));
            for plan in &plans {
                let plan = plan.clone();
                let row = row(&data(room), &content, &plan);
                tasks.push(Task { room, plan, row });
            }
        }

        Ok(tasks)
    }

    /// The plans of every point of the grid with every seed.
    fn plans(&self, grid: &[(usize, usize, f64, Loss)]) -> anyhow::Result<Vec<TrainingPlan>> {
        let base = self.protocol.plan(0)?;
        let mut plans = Vec::new();
        for &(latent, charts, learning_rate, loss) in grid {
            for seed in 0..self.seeds {
                let config = TrainConfig {
                    latent,
                    charts,
                    learning_rate,
                    loss,
                    seed,
                    ..base.config.clone()
                };
                let plan = TrainingPlan {
                    config,
                    ..base.clone()
                };

                // All settings are checked before the first run starts, not hours into the
                // sweep.
                plan.check().context("the grid")?;
                plans.push(plan);
            }
        }

        Ok(plans)
    }
}

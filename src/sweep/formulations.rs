//! `seese3 sweep formulations`: the adapter and the paper's alternatives A to D.

use clap::Args;
use strum::VariantArray;

use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::super::protocol::ProtocolOptions;
use super::super::rooms::{data, load_rooms, room_words};
use crate::table_files::TableFiles;
use seese3_core::training::RoomData;
use seese3_lab::experiments::formulations::{
    FormulationPlan, RoomPooling, compare, run_formulation,
};
use seese3_lab::formulations::Formulation;
use seese3_lab::report::formulations_table;
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Formulations {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Name of the feature set; may be omitted when the first room has only one
    #[arg(long)]
    features: Option<String>,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// Train one network on all rooms together, instead of one per room
    #[arg(long)]
    pooled: bool,
    /// Number of seeds of each formulation, from 0 on; the paper uses 15
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl Formulations {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;

        self.protocol.needs_test_pairs()?;
        let store = Store::open(&self.store)?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;
        // The plans of several folds differ only in their split.
        let plans = self.protocol.plans(0)?;
        let plan = &plans[0];

        // Reject a setting out of range before any task starts.
        plan.check()?;

        let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();

        // A task is one formulation with one seed; tasks run in parallel.
        let pooling = if self.pooled {
            RoomPooling::Together
        } else {
            RoomPooling::RoomByRoom
        };

        let count = Formulation::VARIANTS.len() as u64 * self.seeds;
        let progress = bar(count, "formulations");
        let formulation_plan = FormulationPlan {
            training: plan,
            splits: &self.protocol.splits(),
            room_pooling: pooling,
        };
        let comparison = compare(self.seeds, &|which, seed| {
            let run = run_formulation(which, seed, &room_data, &formulation_plan);
            progress.inc(1);
            run
        })?;
        progress.finish_and_clear();

        say(format_args!(
            "{}, features '{}', preset {} with {} epochs, stride {}, split {}; means over rooms ± sd over {} seeds{}; {} \
             test pairs",
            room_words(&rooms),
            rooms[0].1.source().name,
            plan.preset.name(),
            plan.config.epochs,
            plan.stride,
            self.protocol.split_name(),
            self.seeds,
            if self.pooled { ", rooms together" } else { "" },
            comparison.formulations[0]
                .runs
                .first()
                .map_or(0, |run| run.n),
        ));

        self.files
            .say(&formulations_table(&comparison), "formulations")?;
        self.json.write(&comparison)?;

        Ok(())
    }
}

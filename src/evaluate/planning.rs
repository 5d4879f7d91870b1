//! `seese3 evaluate planning`: plans paths from unmapped views to mapped goals, and compares them
//! with those of simple planners.

use clap::Args;

use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_lab::experiments::planning::{PlanningProtocol, evaluate};
use seese3_lab::report::{planning_json, planning_table};

use super::super::named::one_of;
use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::super::rooms::{data, load_rooms};
use super::say_leaks;
use crate::table_files::TableFiles;
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Planning {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// The adapter; only a calibrated one (`train --calibrate-on`) detects views of other rooms
    #[arg(long)]
    adapter: String,
    /// Which frames are mapped; views of the others are the start views
    #[arg(long, value_parser = one_of::<HoldOut>(), default_value = "interleaved")]
    hold_out: HoldOut,
    /// Number of queries in each room, 1 to 100000
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    queries: u32,
    /// Maximum hop length, meters and radians mixed; if omitted, the root mean square of the
    /// motions that the adapter was trained on
    #[arg(long, value_parser = positive)]
    max_hop_length: Option<f64>,
    /// Fit an adapter to each room's mapped frames, initialized from --adapter, and localize the
    /// views with it
    #[arg(long)]
    fit: bool,
    /// Seed of the queries
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl Planning {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;

        let store = Store::open(&self.store)?;
        let stored = store.load_adapter(&self.adapter, None).await?;
        let source = stored.adapter.source().name.clone();
        let rooms = load_rooms(&store, &self.rooms, Some(&source)).await?;
        say_leaks(&rooms, &stored.record);

        let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
        let protocol = PlanningProtocol {
            hold_out: self.hold_out,
            questions: self.queries as usize,
            longest_hop: self.max_hop_length,
            seed: self.seed,
            is_fitted: self.fit,
        };

        let progress = bar(room_data.len() as u64, "planning");
        let found = evaluate(&room_data, &stored.adapter, &protocol, &|| progress.inc(1))?;
        progress.finish_and_clear();

        say(format_args!(
            "{} rooms, {} queries in each, adapter '{}' revision {}, hold-out {}",
            found.len(),
            self.queries,
            stored.name,
            stored.revision,
            self.hold_out.name(),
        ));
        self.files.say(&planning_table(&found), "routes")?;

        self.json
            .write(&planning_json(&found, &protocol, &stored.name))?;

        Ok(())
    }
}

/// A number above 0.
fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("must be a number above 0".to_owned()),
    }
}

//! `seese3 evaluate localization`: maps a part of a room and localizes the views of the other part.

use anyhow::bail;
use clap::Args;

use seese3_core::eval::has_seen;
use seese3_lab::experiments::localization::{LocalizationProtocol, RuleScores, evaluate};
use seese3_lab::report::{LocalizationContext, LocalizationJson, localization_table};

use super::super::fit::fitting_bar;
use super::super::output::{JsonOutput, say};
use seese3_core::training::RoomData;
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Localization {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// Pre-trained adapter of other rooms: evaluated zero-shot and, with --fit, the initial weights
    /// of the fitted adapter
    #[arg(long)]
    adapter: Option<String>,
    /// Name of the feature set; by default that of the adapter, or the room's only one
    #[arg(long)]
    features: Option<String>,
    /// Also fit an adapter to the mapped frames only, with rules that are measured on them
    #[arg(long)]
    fit: bool,
    /// Map one frame in this many; the views of the others are localized
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    map_every: u32,
    /// Divide the recording into 20 blocks, leave every fifth block unmapped, and localize only the
    /// views of these blocks
    #[arg(long)]
    map_blocks: bool,
    /// Seed of the fitted adapter
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    #[command(flatten)]
    json: JsonOutput,
}

impl Localization {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        if self.adapter.is_none() && !self.fit {
            bail!("give --adapter, or --fit to fit one to the mapped frames");
        }

        let store = Store::open(&self.store)?;
        let stored_adapter = match &self.adapter {
            Some(name) => Some(store.load_adapter(name, None).await?),
            None => None,
        };
        let of_adapter = stored_adapter
            .as_ref()
            .map(|stored| stored.adapter.source().name.clone());
        let wanted = self.features.clone().or(of_adapter);
        let (stored, features) = store.load_room_with(&self.room, wanted.as_deref()).await?;

        let is_leak = stored_adapter
            .as_ref()
            .is_some_and(|adapter| has_seen(&adapter.record, stored.room.id()));
        if is_leak {
            say(format_args!(
                "LEAK: the adapter has seen room '{}'",
                self.room
            ));
        }

        let data = RoomData {
            room: &stored.room,
            revision: stored.revision,
            features: &features,
        };
        let protocol = LocalizationProtocol {
            map_every: self.map_every as usize,
            withhold_blocks: self.map_blocks,
            seed: self.seed,
        };

        let progress = fitting_bar(self.fit);
        let adapter = stored_adapter.as_ref().map(|stored| &stored.adapter);
        let found = evaluate(&data, adapter, self.fit, &protocol, &|_| progress.inc(1))?;
        progress.finish_and_clear();

        say(format_args!(
            "room '{}' revision {}, features '{}': {} frames mapped, {} views localized",
            self.room,
            stored.revision,
            features.source().name,
            found.mapped,
            found.asked
        ));
        say(localization_table(&found));

        if let Some(rules) = &found.rules {
            say_rules(rules);
        }

        if self.json.is_wanted() {
            let protocol = LocalizationContext {
                room: self.room.clone(),
                features: features.source().name.clone(),
                adapter: self.adapter.clone(),
                map_every: protocol.map_every,
                map_blocks: self.map_blocks,
                seed: self.seed,
            };
            let found = &found;
            self.json.write(&LocalizationJson { found, protocol })?;
        }

        Ok(())
    }
}

/// Prints how often the rules used the nearest frame's pose, and the coverage of their covariances.
fn say_rules(rules: &RuleScores) {
    say(format_args!(
        "ours used the nearest frame's translation for {:.0} % of the views and its rotation for {:.0} %; coverage \
         of its covariances: {:.3} at 68 % and {:.3} at 95 %",
        100.0 * rules.translation_unread,
        100.0 * rules.rotation_unread,
        rules.coverage.within_68,
        rules.coverage.within_95
    ));
}

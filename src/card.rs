//! `seese3 card`: statistics of recordings, to compare drawn rooms with real ones.

use clap::Args;
use rayon::prelude::*;
use serde_json::json;

use super::output::say;
use super::rooms::{data, load_rooms};
use super::store_option::StoreAndJson;
use crate::table_files::TableFiles;
use seese3_lab::experiments::room_card::RoomCard;
use seese3_lab::report::{medians_of_cards, room_card_table};

#[derive(Debug, Args)]
pub struct Card {
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Name of the feature set; needed if the first room has several
    #[arg(long)]
    features: Option<String>,
    /// Print only the medians over the rooms
    #[arg(long)]
    medians: bool,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    common: StoreAndJson,
}

impl Card {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        self.files.begin()?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;
        let cards: Vec<RoomCard> = rooms
            .par_iter()
            .map(|room| RoomCard::of(&data(room)))
            .collect();

        let features = &rooms[0].1.source().name;
        say(format_args!("{} rooms, features '{features}'", cards.len()));
        let shown = match self.medians {
            true => vec![medians_of_cards(&cards)],
            false => cards.clone(),
        };
        self.files.say(&room_card_table(&shown), features)?;
        self.common.json.write(&json!({
            "features": features,
            "rooms": cards,
            "medians": medians_of_cards(&cards),
        }))
    }
}

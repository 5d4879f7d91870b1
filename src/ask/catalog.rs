//! `seese3 catalog`: the rooms and adapters of a server.

use clap::Args;

use super::{Server, revision_text, value_text, wire_json};
use crate::output::{JsonOutput, say};
use seese3_client::proto::v1 as pb;
use serde_json::json;

#[derive(Debug, Args)]
pub struct Catalog {
    #[command(flatten)]
    server: Server,
    #[command(flatten)]
    json: JsonOutput,
}

impl Catalog {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let client = self.server.connect().await?;
        let rooms = client.rooms().await?;
        let adapters = client.adapters().await?;

        for room in &rooms {
            let features: Vec<String> = room
                .feature_sources
                .iter()
                .map(|source| format!("{} ({})", source.name, source.dim))
                .collect();

            say(format_args!(
                "room {}: {} frames{}, features {}; adapters {}",
                revision_text(&room.name, room.revision),
                room.frame_count,
                extent_text(room),
                features.join(", "),
                room.adapters.join(", ")
            ));
        }

        for adapter in &adapters {
            // An adapter trained with --split whole has no test pairs, so its test R² is
            // undefined.
            let r2 = adapter
                .test
                .and_then(|test| test.overall)
                .map_or("undefined".to_owned(), |r2| format!("{r2:.3}"));

            let has_reader = adapter.navigators.iter().any(|name| name == "relational");
            let reader = if has_reader {
                ", relational reader"
            } else {
                ""
            };
            say(format_args!(
                "adapter {}: preset {}, split {}, stride {}, test R² {r2}{reader}",
                revision_text(&adapter.name, adapter.revision),
                adapter.preset,
                value_text(adapter.split().as_str_name(), "SPLIT_"),
                adapter.stride
            ));
        }

        let rooms = rooms.iter().map(|room| wire_json("Room", room));
        let adapters = adapters.iter().map(|adapter| wire_json("Adapter", adapter));
        self.json.write(&json!({
            "rooms": rooms.collect::<anyhow::Result<Vec<_>>>()?,
            "adapters": adapters.collect::<anyhow::Result<Vec<_>>>()?,
        }))
    }
}

/// The extent, duration and frame rate of a room's recording, each with a comma before it.
fn extent_text(room: &pb::Room) -> String {
    let mut text = String::new();
    if let Some(pb::Extent {
        min: Some(min),
        max: Some(max),
    }) = &room.extent
    {
        let [x, y, z] = [max.x - min.x, max.y - min.y, max.z - min.z];
        text += &format!(", {x:.1} × {y:.1} × {z:.1} m");
    }
    if let Some(duration) = room.duration_s {
        text += &format!(", {duration:.1} s");
    }
    if let Some(rate) = room.frame_rate_hz {
        text += &format!(", {rate:.1} Hz");
    }
    text
}

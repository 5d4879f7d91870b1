//! `seese3 evaluate motion`: how well an adapter reads the motion between two views of a room.

use std::path::PathBuf;

use clap::Args;

use seese3_core::eval::has_seen;
use seese3_core::training::RoomData;
use seese3_lab::experiments::motion::evaluate;
use seese3_lab::report::{motion_evaluation_json, motion_table};

use super::super::{check_writable, say, write_json};
use crate::store::Store;

#[derive(Debug, Args)]
pub struct Motion {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// The adapter
    #[arg(long)]
    adapter: String,
    /// Frames from the first view to the second
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    /// Write the errors to this file as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Motion {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(path) = &self.json {
            check_writable(path)?;
        }

        let store = Store::open(&self.store)?;
        let stored_adapter = store.load_adapter(&self.adapter, None).await?;
        let source = stored_adapter.adapter.source().name.clone();
        let (stored, features) = store.load_room_with(&self.room, Some(&source)).await?;
        let data = RoomData {
            room: &stored.room,
            revision: stored.revision,
            features: &features,
        };

        let found = evaluate(&data, &stored_adapter.adapter, self.stride)?;
        let in_room = has_seen(&stored_adapter.record, stored.room.id());
        say(format_args!(
            "room '{}' revision {}, adapter '{}' revision {} ({}), stride {}: {} pairs",
            self.room,
            stored.revision,
            self.adapter,
            stored_adapter.revision,
            if in_room {
                "LEAK: it has seen this room"
            } else {
                "never saw this room"
            },
            self.stride,
            found.n
        ));
        say(motion_table(&found).trim_end());

        if let Some(path) = &self.json {
            let record =
                motion_evaluation_json(&found, &self.room, &self.adapter, self.stride, in_room);
            write_json(path, &record)?;
            say(format_args!("wrote {}", path.display()));
        }

        Ok(())
    }
}

//! `seese3 check`: checks stored data for mistakes.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use super::encode::images_root;
use super::output::say;
use super::pose_report::{PosesFrom, check_with_images, report_json, say_report};
use super::store_option::StoreAndJson;
use seese3_data::pose_check::check_room;

#[derive(Debug, Args)]
pub struct Check {
    #[command(flatten)]
    common: StoreAndJson,
    /// Name of the room
    #[arg(long)]
    room: String,
    /// Folder of the images, if they were moved since the import
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
}

impl Check {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        let room = store.load_room(&self.room, None).await?.room;

        let from = PosesFrom::Store;
        let report = if room.images().is_empty() {
            check_room(&room, None)
        } else {
            let root = images_root(&room, self.images.as_deref())?;
            check_with_images(&room, &root, room.poses(), from)
        };

        self.common.json.write(&report_json(&report, &room, from))?;
        say(format_args!(
            "room '{}': {} frames",
            room.id(),
            room.frame_count()
        ));
        say_report(&report, from);

        if report.is_wrong() {
            bail!(
                "the poses of room '{}' are wrong: see the warnings",
                room.id()
            );
        }
        Ok(())
    }
}

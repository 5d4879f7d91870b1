//! `seese3 evaluate motion`: accuracy of motion estimation between two views of a room.

use clap::Args;

use seese3_core::eval::has_seen;
use seese3_core::features::Features;
use seese3_core::splits::Split;
use seese3_lab::experiments::motion::{FrameKeypoints, MotionEvaluation, evaluate};
use seese3_lab::report::{MotionEvaluationJson, estimate_errors_file, motion_table};

use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::keypoint_views::KeypointViews;
use crate::errors_file::ErrorsFile;
use crate::table_files::TableFiles;
use seese3_store::{Store, StoredAdapter};

#[derive(Debug, Args)]
pub struct Motion {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// The adapter
    #[arg(long, required_unless_present = "keypoints")]
    adapter: Option<String>,
    /// Also estimate each motion by the matched keypoints of both views, without a map and an
    /// adapter. The room needs keypoints
    #[arg(long)]
    keypoints: bool,
    /// Frames from the first view to the second, at least 1
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    #[command(flatten)]
    views: KeypointViews,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    errors: ErrorsFile,
    #[command(flatten)]
    json: JsonOutput,
}

impl Motion {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        self.errors.begin()?;

        let store = Store::open(&self.store)?;
        let stored = store.load_room(&self.room, None).await?;
        let features = async |name: &str| -> anyhow::Result<Features> {
            let (other, features) = store.load_room_with(&self.room, Some(name)).await?;
            anyhow::ensure!(
                other.revision == stored.revision,
                "room '{}' got a new revision during loading; try again",
                self.room
            );

            Ok(features)
        };

        let adapter = match &self.adapter {
            Some(name) => {
                let adapter = store.load_adapter(name, None).await?;
                let features = features(&adapter.adapter.source().name).await?;
                Some((adapter, features))
            }
            None => None,
        };
        let matchable = if self.keypoints {
            Some(self.views.encode_matchable(&stored)?)
        } else {
            self.views.refuse_images()?;
            None
        };
        let views = matchable
            .as_ref()
            .map(|(keypoints, encoded)| FrameKeypoints {
                keypoints: &encoded.keypoints,
                camera: keypoints.map.camera,
            });

        let pairs = Split::Whole.test_pairs(stored.room.timeline(), self.stride)?;
        let progress = bar(pairs.len() as u64, "reading");
        let found = evaluate(
            &stored.room,
            adapter
                .as_ref()
                .map(|(stored, features)| (stored.adapter.as_ref(), features)),
            views,
            &pairs,
            &|| progress.inc(1),
        )?;
        progress.finish_and_clear();

        let in_room = adapter
            .as_ref()
            .map(|(adapter, _)| has_seen(&adapter.record, stored.room.id()));
        say(format_args!(
            "room '{}' revision {}, stride {}: {} pairs",
            self.room, stored.revision, self.stride, found.n
        ));
        if let Some((adapter, _)) = &adapter {
            say_adapter(adapter, in_room == Some(true));
        }
        self.say_table(&found)?;
        self.errors
            .write(|| estimate_errors_file(&self.room, &found.pairs))?;
        self.json.write(&MotionEvaluationJson {
            found: &found,
            room: &self.room,
            adapter: self.adapter.as_deref(),
            stride: self.stride,
            in_room,
        })
    }
}

impl Motion {
    fn say_table(&self, found: &MotionEvaluation) -> anyhow::Result<()> {
        let (room, stride) = (&self.room, self.stride);
        let title = format!("{room}: {} motions over {stride} frames", found.n);
        let (table, notes) = motion_table(found);
        self.files.say(&table, &title)?;
        if !notes.is_empty() {
            say(notes);
        }
        Ok(())
    }
}

fn say_adapter(adapter: &StoredAdapter, in_room: bool) {
    let seen = if in_room {
        "LEAK: it has seen this room"
    } else {
        "never saw this room"
    };
    say(format_args!(
        "adapter '{}' revision {} ({seen})",
        adapter.name, adapter.revision
    ));
}

//! `seese3 evaluate motion`: accuracy of motion estimation between two views of a room.

use anyhow::Context;
use clap::Args;

use seese3_core::eval::has_seen;
use seese3_core::features::Features;
use seese3_core::room::Room;
use seese3_core::splits::Split;
use seese3_lab::experiments::motion::{Maps, evaluate};
use seese3_lab::report::{MotionEvaluationJson, motion_table};

use super::super::camera::{CAMERA_FORM, CameraOption};
use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use seese3_encoder::{Pooling, Preparation};
use seese3_store::{Store, StoredAdapter};

#[derive(Debug, Args)]
pub struct Motion {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// The adapter
    #[arg(long, required_unless_present = "two_view")]
    adapter: Option<String>,
    /// Also estimate each motion by matching these features between the views: a feature map pooled
    /// at its full resolution, for example xfeat-fusion-grid40x30
    #[arg(long, value_name = "FEATURES")]
    two_view: Option<String>,
    /// Camera of the images, as --camera of `seese3 import`, for --two-view; the room's own if
    /// omitted
    #[arg(long, value_name = CAMERA_FORM, requires = "two_view")]
    camera: Option<CameraOption>,
    /// Frames from the first view to the second
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    #[command(flatten)]
    json: JsonOutput,
}

impl Motion {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

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
        let dense = match &self.two_view {
            Some(name) => Some(features(name).await?),
            None => None,
        };

        let maps = dense
            .as_ref()
            .map(|dense| self.maps(&stored.room, dense))
            .transpose()?;
        let pairs = Split::Whole.test_pairs(stored.room.timeline(), self.stride)?;
        let progress = bar(pairs.len() as u64, "reading");
        let found = evaluate(
            &stored.room,
            adapter
                .as_ref()
                .map(|(stored, features)| (stored.adapter.as_ref(), features)),
            maps,
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
        say(motion_table(&found));

        self.json.write(&MotionEvaluationJson {
            found: &found,
            room: &self.room,
            adapter: self.adapter.as_deref(),
            stride: self.stride,
            in_room,
        })
    }

    /// The feature maps of the room's frames, and their camera.
    fn maps<'a>(&self, room: &Room, dense: &'a Features) -> anyhow::Result<Maps<'a>> {
        let source = dense.source();
        let shape = source
            .pooling
            .parse::<Pooling>()
            .ok()
            .and_then(|pooling| pooling.map_shape(source.dim))
            .with_context(|| {
                format!(
                    "--two-view {}: the pooling is '{}', but the full feature map is needed: encode \
                     the room with --pool gridCxR, where C and R are the columns and rows of the \
                     layer's map",
                    source.name, source.pooling
                )
            })?;

        // A crop would change the principal point and the field of view.
        if let Ok((Preparation { crop: Some(_), .. }, _)) = Preparation::parse(&source.preprocess) {
            anyhow::bail!(
                "--two-view {}: its images were cropped, so the camera's focal length is not valid \
                 for them; encode the images without a crop",
                source.name
            );
        }

        let camera = match (self.camera, room.provenance().camera) {
            (Some(CameraOption(camera)), _) => camera,
            (None, Some(camera)) => camera,
            (None, None) => anyhow::bail!(
                "room '{}' has no camera: give --camera, or import the room with --camera",
                self.room
            ),
        };

        Ok(Maps {
            features: dense,
            shape,
            camera,
        })
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

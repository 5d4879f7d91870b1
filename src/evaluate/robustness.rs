//! `seese3 evaluate robustness`: tracks rooms with disturbed images.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use ndarray::Array2;
use rayon::prelude::*;

use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_core::room::FrameId;
use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_lab::experiments::odometry::{OdometryProtocol, TrackedRoom, trackers};
use seese3_lab::experiments::robustness::{
    Disturbance, DisturbedTracking, DisturbedViews, changed_images, evaluate,
};
use seese3_lab::report::{robustness_json, robustness_table};
use seese3_robot::tracking::TrackerSettings;

use super::super::encode::images_root;
use super::super::encoder::RuntimeOptions;
use super::super::named::one_of;
use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::super::rooms::{data, load_rooms};
use super::say_leaks;
use seese3_encoder::{Encoder, read_image};
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Robustness {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The rooms, imported with images: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// The adapter; it must be calibrated (`train --calibrate-on`), but in none of these rooms
    #[arg(long)]
    adapter: String,
    /// The encoder that the adapter was trained on: an ONNX file, `pixels` or `builtin`
    #[arg(long)]
    encoder: String,
    /// Folder of the images; the original folder of the room if omitted
    #[arg(long)]
    images: Option<PathBuf>,
    /// Which frames are mapped and which are replayed
    #[arg(long, value_parser = one_of::<HoldOut>(), default_value = "interleaved")]
    hold_out: HoldOut,
    /// Only disturbances with this text in their names, for example roll; may be repeated
    #[arg(long = "only", value_name = "TEXT")]
    only: Vec<String>,
    #[command(flatten)]
    runtime: RuntimeOptions,
    #[command(flatten)]
    json: JsonOutput,
}

/// Number of images that are encoded together.
const BATCH: usize = 16;

impl Robustness {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;

        let store = Store::open(&self.store)?;
        let stored = store.load_adapter(&self.adapter, None).await?;
        let source = stored.adapter.source().clone();
        let rooms = load_rooms(&store, &self.rooms, Some(&source.name)).await?;
        say_leaks(&rooms, &stored.record);

        let encoder = self.encoder_of(&source)?;
        let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
        let protocol = OdometryProtocol {
            hold_out: self.hold_out,
            settings: TrackerSettings::of(&stored.adapter),
            is_fitted: false,
        };
        let trackers = trackers(&room_data, &stored.adapter, &protocol)?;

        let disturbances = self.disturbances()?;
        let steps = trackers.len() * disturbances.len();
        let progress = bar(steps as u64, "disturbing");
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(self.runtime.threads())
            .build()?;

        let mut found: Vec<DisturbedTracking> = Vec::with_capacity(steps);
        for room in &trackers {
            let root = images_root(room.room(), self.images.as_deref())?;
            for &disturbance in &disturbances {
                let camera = DisturbedCamera {
                    encoder: &encoder,
                    root: &root,
                    disturbance,
                };
                let one = pool.install(|| camera.track(room, self.hold_out));
                found.push(one.with_context(|| {
                    format!(
                        "room '{}', disturbance {}",
                        room.room().id(),
                        disturbance.name()
                    )
                })?);
                progress.inc(1);
            }
        }
        progress.finish_and_clear();

        say(format_args!(
            "{} rooms, adapter '{}' revision {}, hold-out {}; blank and frozen cameras are scored only while blank or frozen",
            trackers.len(),
            stored.name,
            stored.revision,
            self.hold_out.name(),
        ));
        say(robustness_table(&found));

        self.json
            .write(&robustness_json(&found, &stored.name, self.hold_out))?;

        Ok(())
    }

    /// The disturbances selected by `--only`.
    fn disturbances(&self) -> anyhow::Result<Vec<Disturbance>> {
        let is_asked = |disturbance: &Disturbance| {
            let name = disturbance.name();
            self.only.is_empty() || self.only.iter().any(|text| name.contains(text.as_str()))
        };
        let asked: Vec<Disturbance> = Disturbance::ALL.into_iter().filter(is_asked).collect();
        if asked.is_empty() {
            let names: Vec<String> = Disturbance::ALL
                .into_iter()
                .map(Disturbance::name)
                .collect();
            bail!(
                "no disturbance matches --only; known names: {}",
                names.join(", ")
            );
        }

        Ok(asked)
    }

    fn encoder_of(&self, source: &FeatureSource) -> anyhow::Result<Encoder> {
        let models = [self.encoder.clone()];
        let encoder = Encoder::of_source(source, &models, &self.runtime.runtime())?;
        let Some(encoder) = encoder else {
            bail!(
                "adapter '{}' was trained on features of encoder '{}', but {} is another encoder",
                self.adapter,
                source.encoder,
                self.encoder
            );
        };

        if encoder.window() > 1 {
            bail!(
                "the encoder takes clips of {} images, but disturbances apply to single images",
                encoder.window()
            );
        }
        Ok(encoder)
    }
}

/// A camera with disturbed images.
struct DisturbedCamera<'a> {
    encoder: &'a Encoder,
    root: &'a Path,
    disturbance: Disturbance,
}

impl DisturbedCamera<'_> {
    fn track(
        &self,
        room: &TrackedRoom<'_>,
        hold_out: HoldOut,
    ) -> anyhow::Result<DisturbedTracking> {
        let tracked = hold_out.tracked(room.room().timeline());
        let rows: Vec<usize> = tracked.iter().map(|frame| frame.row()).collect();
        let mut features = room.features().select(ndarray::Axis(0), &rows);
        let mut is_blank = vec![false; rows.len()];

        let changed = changed_images(room, hold_out, self.disturbance);
        for batch in changed.chunks(BATCH) {
            let images: Vec<(RgbImage, bool)> = batch
                .par_iter()
                .map(|&(row, number)| self.image(room, tracked[row], number))
                .collect::<anyhow::Result<_>>()?;
            let clips: Vec<Vec<&RgbImage>> = images.iter().map(|(image, _)| vec![image]).collect();
            let encoded: Array2<f32> = self.encoder.encode(&clips)?;

            for ((&(row, _), encoded), (_, blank)) in
                batch.iter().zip(encoded.outer_iter()).zip(&images)
            {
                features.row_mut(row).assign(&encoded);
                is_blank[row] = *blank;
            }
        }

        let views = DisturbedViews {
            features: features.view(),
            is_blank: &is_blank,
        };
        Ok(evaluate(room, hold_out, self.disturbance, views)?)
    }

    /// A frame's disturbed image, prepared for the encoder, and whether it is blank.
    fn image(
        &self,
        room: &TrackedRoom<'_>,
        frame: FrameId,
        number: usize,
    ) -> anyhow::Result<(RgbImage, bool)> {
        let image = read_image(self.root, &room.room().images()[frame.row()])?;
        let disturbed = self.disturbance.disturbed(&image, number);
        let is_blank = disturbed.is_blank();

        Ok((self.encoder.prepare(disturbed)?, is_blank))
    }
}

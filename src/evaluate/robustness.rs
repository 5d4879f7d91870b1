//! `seese3 evaluate robustness`: tracks rooms with disturbed images.

use anyhow::{Context, bail};
use clap::Args;
use rayon::prelude::*;

use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_core::keypoints::Keypoints;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_lab::experiments::robustness::{Disturbance, DisturbedTracking, changed_images};
use seese3_lab::experiments::tracked_room::{
    DisturbedViews, KeypointRecording, TrackedRoom, TrackingProtocol,
};
use seese3_lab::report::{robustness_json, robustness_table};
use seese3_robot::pose_filter::FilterParameters;

use super::super::encode::images_root;
use super::super::named::one_of;
use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::super::rooms::{data, load_rooms, room_names};
use super::keypoint_views::KeypointViews;
use super::room_images::RoomImages;
use super::say_leaks;
use crate::table_files::TableFiles;
use seese3_encoder::{EncodedFrame, Encoder};
use seese3_store::Store;

#[derive(Debug, Args)]
pub struct Robustness {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms, imported with images: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// The adapter; it must be calibrated (`train --calibrate-on`), but in none of these rooms.
    /// Without one, matched keypoints alone track the camera, in rooms with keypoints
    #[arg(long, requires = "encoder")]
    adapter: Option<String>,
    /// The encoder that the adapter was trained on: an ONNX file, `pixels` or `builtin`
    #[arg(long, requires = "adapter")]
    encoder: Option<String>,
    /// Which frames are mapped and which are replayed
    #[arg(long, value_parser = one_of::<HoldOut>(), default_value = "interleaved")]
    hold_out: HoldOut,
    /// Only disturbances with this text in their names, for example roll; may be repeated
    #[arg(long = "only", value_name = "TEXT")]
    only: Vec<String>,
    #[command(flatten)]
    views: KeypointViews,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

/// Number of images that are encoded together.
const BATCH: usize = 16;

impl Robustness {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        let store = Store::open(&self.store)?;
        match (&self.adapter, &self.encoder) {
            (Some(adapter), Some(encoder)) => self.by_adapter(&store, adapter, encoder).await,
            _ => self.by_keypoints(&store).await,
        }
    }

    async fn by_adapter(&self, store: &Store, adapter: &str, encoder: &str) -> anyhow::Result<()> {
        let stored = store.load_adapter(adapter, None).await?;
        let source = stored.adapter.source().clone();
        let rooms = load_rooms(store, &self.rooms, Some(&source.name)).await?;
        say_leaks(&rooms, &stored.record);

        let encoder = self.encoder_of(&source, encoder, adapter)?;
        let trackers: Vec<TrackedRoom<'_>> = rooms
            .iter()
            .map(|room| TrackedRoom::by_adapter(&data(room), &stored.adapter, &self.protocol()))
            .collect::<Result<_, _>>()?;

        let disturbances = self.disturbances()?;
        let steps = trackers.len() * disturbances.len();
        let progress = bar(steps as u64, "disturbing");
        let pool = self.views.runtime.pool()?;

        let mut found: Vec<DisturbedTracking> = Vec::with_capacity(steps);
        for tracker in &trackers {
            let room = tracker.room();
            let images = RoomImages::Folder {
                root: images_root(room, self.views.images.as_deref())?,
                images: room.images(),
            };
            let tracked = self.hold_out.tracked(room.timeline());
            let rows: Vec<usize> = tracked.iter().map(|frame| frame.row()).collect();
            let features = tracker.features().select(ndarray::Axis(0), &rows);
            for &disturbance in &disturbances {
                let camera = DisturbedCamera {
                    encoder: &encoder,
                    images: &images,
                    disturbance,
                };
                let mut features = features.clone();
                let mut is_blank = vec![false; rows.len()];
                let one = pool.install(|| {
                    camera.each_changed(room, self.hold_out, |row, frame, blank| {
                        let feature = ndarray::Array1::from(frame.feature);
                        features.row_mut(row).assign(&feature);
                        is_blank[row] = blank;
                    })?;
                    let views = DisturbedViews {
                        features: features.view(),
                        is_blank: &is_blank,
                        keypoints: &[],
                    };
                    Ok(tracker.track_disturbed(disturbance, views)?)
                });
                found.push(named(one, room, disturbance)?);
                progress.inc(1);
            }
        }
        progress.finish_and_clear();

        let what = format!("adapter '{}' revision {}", stored.name, stored.revision);
        self.report(&found, trackers.len(), &what, Some(&stored.name))
    }

    /// Tracks by matched keypoints alone.
    async fn by_keypoints(&self, store: &Store) -> anyhow::Result<()> {
        let disturbances = self.disturbances()?;
        let names = room_names(store, &self.rooms).await?;
        let pool = self.views.runtime.pool()?;

        let mut found: Vec<DisturbedTracking> = Vec::new();
        for name in &names {
            let stored = store.load_room(name, None).await?;
            let (keypoints, encoded) = self.views.encode_matchable(&stored)?;
            let encoder = self.views.encoder(&stored, keypoints)?;
            let room = &stored.room;
            let size = encoder.render_size();
            let images = RoomImages::of(room, self.views.images.as_deref(), size)?;

            let recording = KeypointRecording {
                room,
                features: encoded.rows.view(),
                keypoints: &encoded.keypoints,
                camera: keypoints.map.camera,
            };
            let protocol = self.protocol();
            let mapped = pool.install(|| TrackedRoom::by_keypoints(&recording, &protocol))?;
            let tracked = self.hold_out.tracked(room.timeline());
            let rows: Vec<usize> = tracked.iter().map(|frame| frame.row()).collect();
            let progress = bar(disturbances.len() as u64, "disturbing");
            for &disturbance in &disturbances {
                let camera = DisturbedCamera {
                    encoder: &encoder,
                    images: &images,
                    disturbance,
                };
                let mut features = encoded.rows.select(ndarray::Axis(0), &rows);
                let of_row = |&row: &usize| encoded.keypoints[row].clone();
                let mut keypoints: Vec<Keypoints> = rows.iter().map(of_row).collect();
                let one = pool.install(|| {
                    camera.each_changed(room, self.hold_out, |row, frame, blank| {
                        let feature = ndarray::Array1::from(frame.feature);
                        features.row_mut(row).assign(&feature);
                        let detected = frame.keypoints.filter(|_| !blank);
                        keypoints[row] = detected.unwrap_or_default();
                    })?;
                    let views = DisturbedViews {
                        features: features.view(),
                        is_blank: &[],
                        keypoints: &keypoints,
                    };
                    Ok(mapped.track_disturbed(disturbance, views)?)
                });
                found.push(named(one, room, disturbance)?);
                progress.inc(1);
            }
            progress.finish_and_clear();
        }
        self.report(&found, names.len(), "matched keypoints, no adapter", None)
    }

    fn report(
        &self,
        found: &[DisturbedTracking],
        rooms: usize,
        what: &str,
        adapter: Option<&str>,
    ) -> anyhow::Result<()> {
        say(format_args!(
            "{rooms} rooms, {what}, hold-out {}; blank and frozen cameras are scored only while blank or frozen",
            self.hold_out.name(),
        ));
        self.files.say(&robustness_table(found), what)?;
        self.json
            .write(&robustness_json(found, adapter, self.hold_out))
    }

    fn protocol(&self) -> TrackingProtocol {
        TrackingProtocol {
            hold_out: self.hold_out,
            parameters: FilterParameters::default(),
            is_fitted: false,
        }
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

    fn encoder_of(
        &self,
        source: &FeatureSource,
        model: &str,
        adapter: &str,
    ) -> anyhow::Result<Encoder> {
        let models = [model.to_owned()];
        let encoder = Encoder::of_source(source, &models, &self.views.runtime.runtime())?;
        let Some(encoder) = encoder else {
            bail!(
                "adapter '{adapter}' was trained on features of encoder '{}', but {model} is another encoder",
                source.encoder,
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

/// Names the room and the disturbance of an error.
fn named(
    found: anyhow::Result<DisturbedTracking>,
    room: &Room,
    disturbance: Disturbance,
) -> anyhow::Result<DisturbedTracking> {
    found.with_context(|| format!("room '{}', disturbance {}", room.id(), disturbance.name()))
}

/// A camera with disturbed images.
struct DisturbedCamera<'a> {
    encoder: &'a Encoder,
    images: &'a RoomImages<'a>,
    disturbance: Disturbance,
}

impl DisturbedCamera<'_> {
    /// Encodes the images that the disturbance changes. `take` gets the row of a frame among the
    /// tracked ones, its encoding, and whether the image is blank.
    fn each_changed(
        &self,
        room: &Room,
        hold_out: HoldOut,
        mut take: impl FnMut(usize, EncodedFrame, bool),
    ) -> anyhow::Result<()> {
        let tracked = hold_out.tracked(room.timeline());
        let changed = changed_images(room, hold_out, self.disturbance);
        for batch in changed.chunks(BATCH) {
            let images: Vec<(RgbImage, bool)> = batch
                .par_iter()
                .map(|&(row, number)| self.image(tracked[row], number))
                .collect::<anyhow::Result<_>>()?;
            let clips: Vec<Vec<&RgbImage>> = images.iter().map(|(image, _)| vec![image]).collect();
            let encoded = self.encoder.encode_frames(&clips)?;

            for ((&(row, _), encoded), (_, blank)) in batch.iter().zip(encoded).zip(&images) {
                take(row, encoded, *blank);
            }
        }
        Ok(())
    }

    /// A frame's disturbed image, prepared for the encoder, and whether it is blank.
    fn image(&self, frame: FrameId, number: usize) -> anyhow::Result<(RgbImage, bool)> {
        let image = self.images.image(frame.row())?;
        let disturbed = self.disturbance.disturbed(&image, number);
        let is_blank = disturbed.is_blank();

        Ok((self.encoder.prepare(disturbed)?, is_blank))
    }
}

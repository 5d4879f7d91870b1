//! `seese3 studio`: a suite of synthetic rooms, encoded while they are rendered.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::Args;
use rayon::prelude::*;
use serde_json::json;
use strum::VariantArray;

use super::encode::{by_layer, check_names, has, has_keypoints, same_poses};
use super::encoder::{EncoderOptions, RuntimeOptions, feature_prefix, say_features};
use super::keypoints::{map_keypoints, mapping_inputs, room_keypoints};
use super::named::one_of;
use super::output::{JsonOutput, begin_output, say, write_file};
use super::progress::bar;
use seese3_core::cancel::Cancellation;
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_encoder::{
    Encoded, Encoder, Error, OnBadImage, Task, encode_png, encode_room, read_image,
};
use seese3_store::{RoomContents, RoomKeypoints, Store, StoredRoom};
use seese3_studio::{Film, Suite, Variation};

/// Maximum number of rooms on a contact sheet.
const SHEET_ROOMS: u32 = 48;
/// Number of columns of a contact sheet.
const SHEET_COLUMNS: usize = 8;
/// Width and height of a tile on a contact sheet, pixels.
const SHEET_SIZE: (usize, usize) = (160, 120);

#[derive(Debug, Args)]
pub struct Studio {
    /// The store to publish the rooms in: a folder, created if it does not exist, or a URL of a
    /// bucket (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// Kind of rooms and of their recordings
    #[arg(long, default_value = "visits", value_parser = one_of::<Suite>())]
    suite: Suite,
    /// Variations that are turned off in all suites but `walks`, separated by commas,
    /// for ablations; the poses stay the same
    #[arg(long, value_delimiter = ',', value_name = "VARIATIONS", value_parser = one_of::<Variation>())]
    without: Vec<Variation>,
    /// Number of rooms, 1 to 100000
    #[arg(long, default_value_t = 131, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    rooms: u32,
    /// Number of frames per room, 2 to 100000; if omitted, 1000, and 400 for walks
    #[arg(long, value_parser = clap::value_parser!(u32).range(2..=100_000))]
    frames: Option<u32>,
    /// Seed of the suite; the same seed gives the same rooms
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Encoder of the images: an ONNX file, `pixels` or `builtin`
    #[arg(long = "encoder", value_name = "MODEL", default_value = "builtin")]
    model: String,
    #[command(flatten)]
    encoder: EncoderOptions,
    #[command(flatten)]
    runtime: RuntimeOptions,
    /// Frames per run of the model, 1 to 4096
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=4_096))]
    batch: u32,
    /// Prefix of the feature names, PREFIX-LAYER-POOLING; the model's file name without extension
    /// if omitted
    #[arg(long = "prefix", value_name = "PREFIX")]
    prefix: Option<String>,
    /// Also keep the images, as PNG files in the folder `images` of the store
    #[arg(long)]
    keep_images: bool,
    /// Instead of publishing rooms, render a contact sheet of up to 48 rooms, one image each, to
    /// this PNG file
    #[arg(long, value_name = "FILE")]
    sheet: Option<PathBuf>,
    #[command(flatten)]
    json: JsonOutput,
}

/// Time spent: rendering time summed over threads, microseconds, and wall time of the rendered
/// rooms.
#[derive(Default)]
struct Spent {
    drawing_us: AtomicU64,
    wall: Duration,
}

impl Studio {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        if self.suite == Suite::Walks && !self.without.is_empty() {
            bail!("--without needs --suite visits, returns or scans: walks have no variations");
        }
        if let Some(file) = &self.sheet {
            return self.sheet(file);
        }

        let out = self.store.as_str();

        // Images are kept as plain files, which only a folder can hold.
        if self.keep_images && out.contains("://") {
            bail!("--keep-images needs a store that is a folder");
        }

        let encoder = self.encoder.open(&self.model, &self.runtime.runtime())?;
        if encoder.window() > 1 && self.keep_images {
            bail!("--keep-images draws single images; leave it out for an encoder of clips");
        }

        let store = Store::create(out)?;
        let sources = encoder.sources(&feature_prefix(self.prefix.as_deref(), &self.model));
        check_names(&sources)?;

        // Rooms are rendered at the encoder's own input size, so that no image has to be resized.
        let (width, height) = encoder.render_size();

        say(format_args!(
            "{} rooms of {} frames at {width}x{height}, encoder {} by {}",
            self.rooms,
            self.frame_count(),
            encoder.id(),
            encoder.runtime()
        ));

        let (drawn, there, spent) = self.draw(&store, &encoder, &sources).await?;
        say(format_args!(
            "{drawn} rooms drawn, {there} were there already"
        ));

        if drawn > 0 {
            // Wall time per room, and rendering time summed over threads, which may be the larger
            // one.
            let threads = self.runtime.threads();
            let rooms = f64::from(drawn);
            let drawing = spent.drawing_us.load(Ordering::Relaxed) as f64 / 1e6;
            say(format_args!(
                "{:.1} s per room on {threads} threads; rendering alone {:.1} thread-seconds",
                spent.wall.as_secs_f64() / rooms,
                drawing / rooms
            ));
        }

        say_features(&sources);

        let features: Vec<&str> = sources.iter().map(|source| source.name.as_str()).collect();
        self.json.write(&json!({
            "store": out,
            "drawn": drawn,
            "there_before": there,
            "frames": self.frame_count(),
            "features": features,
        }))
    }

    /// Renders, encodes and publishes the rooms that the store does not have yet. Returns how many
    /// were rendered, how many were there, and the time spent.
    async fn draw(
        &self,
        store: &Store,
        encoder: &Encoder,
        sources: &[FeatureSource],
    ) -> anyhow::Result<(u32, u32, Spent)> {
        let pool = self.runtime.pool()?;

        let progress = bar(u64::from(self.rooms) * self.frame_count() as u64, "drawing");
        let mut spent = Spent::default();
        let mut drawn = 0;
        let mut there = 0;

        // Render one room at a time, its frames on all threads, so that memory holds only one room.
        for number in 0..self.rooms {
            let name = self.room_name(number);
            progress.set_message(name.clone());
            let begun = Instant::now();

            // A room depends only on seed and number. An interrupted command therefore continues by
            // skipping the rooms that are complete in the store.
            let film = self.film(number);
            let mut room = self.room(&name, &film, encoder.render_size())?;
            let before = stored(store, &room).await?;
            let images_kept = before
                .as_ref()
                .is_some_and(|before| before.room.images() == room.images());

            // A room is complete if it has every feature set with the same source and, with
            // --keep-images, its images.
            let is_encoded = |before: &StoredRoom| {
                sources.iter().all(|source| has(before, source))
                    && (encoder.keypoint_outputs().is_none() || has_keypoints(before, &sources[0]))
            };
            if before.as_ref().is_some_and(is_encoded) && (images_kept || !self.keep_images) {
                there += 1;
            } else {
                // Keep the images of an earlier run.
                if let Some(before) = before.filter(|_| !self.keep_images) {
                    room = before.room;
                }

                let told = |done: usize| {
                    progress
                        .set_position(u64::from(number) * self.frame_count() as u64 + done as u64);
                };
                let encoded =
                    pool.install(|| self.encode_room(&room, &film, encoder, &spent, &told))?;
                let keypoints = pool.install(|| self.map(&room, encoder, &sources[0], &encoded))?;
                let contents = RoomContents {
                    room: &room,
                    features: &by_layer(sources, &encoded.rows)?,
                    keypoints: keypoints.as_ref(),
                };
                store.publish_contents(contents).await?;

                drawn += 1;
                spent.wall += begun.elapsed();
            }

            progress.set_position(u64::from(number + 1) * self.frame_count() as u64);
        }

        progress.finish_and_clear();
        Ok((drawn, there, spent))
    }

    fn frame_count(&self) -> usize {
        let default = match self.suite {
            Suite::Visits | Suite::Returns | Suite::Scans => 1_000,
            Suite::Walks => 400,
        };
        self.frames.unwrap_or(default) as usize
    }

    fn film(&self, number: u32) -> Film {
        let film = self.suite.film(self.seed, number, self.frame_count());
        self.without
            .iter()
            .fold(film, |film, &variation| film.without(variation))
    }

    fn room_name(&self, number: u32) -> String {
        format!("studio{}-{number:04}", self.seed)
    }

    /// The room with its camera path and, with --keep-images, the paths of its images; without
    /// features.
    fn room(
        &self,
        name: &str,
        film: &Film,
        (width, height): (usize, usize),
    ) -> anyhow::Result<Room> {
        let without: String = Variation::VARIANTS
            .iter()
            .filter(|variation| self.without.contains(variation))
            .map(|variation| format!(" without {variation}"))
            .collect();
        let mut provenance = Provenance {
            format: format!("studio {}{without}", film.kind),
            license: "CC0-1.0".to_owned(),
            camera: Some(film.camera(width, height)?),
            ..Provenance::default()
        };

        let mut frames = Frames {
            poses: film.poses.clone(),
            timestamps_ns: film.timestamps_ns(),
            sequences: film.sequences(),
            ..Frames::default()
        };

        // The root is absolute, so that `seese3 encode` finds the images from any working
        // directory.
        if self.keep_images {
            let out = self.store.as_str();
            let root = Path::new(out)
                .canonicalize()
                .with_context(|| out.to_owned())?
                .join("images");
            provenance.images_root = root
                .to_str()
                .context("the store's path is not UTF-8")?
                .to_owned();

            frames.images = (0..self.frame_count())
                .map(|frame| format!("{name}/frame-{frame:06}.png"))
                .collect();
        }

        Ok(Room::new(RoomId::new(name)?, frames, provenance)?)
    }

    fn encode_room(
        &self,
        room: &Room,
        film: &Film,
        encoder: &Encoder,
        spent: &Spent,
        told: &(dyn Fn(usize) + Sync),
    ) -> anyhow::Result<Encoded> {
        let (width, height) = encoder.render_size();

        let image = |row: usize| -> Result<RgbImage, Error> {
            let begun = Instant::now();

            // An image kept by an earlier run is read back instead of being rendered again.
            let drawn = match drawn_before(room, row, (width, height))? {
                Some(kept) => kept,
                None => film.image(row, width, height),
            };

            spent
                .drawing_us
                .fetch_add(begun.elapsed().as_micros() as u64, Ordering::Relaxed);

            self.keep(room, row, &drawn)?;
            Ok(drawn)
        };

        let cancel = Cancellation::default();
        let batch = self.batch as usize;

        let task = Task {
            // Clips do not span visits.
            timeline: room.timeline(),
            image: &image,
            batch,
            on_bad: OnBadImage::Stop,
            cancel: &cancel,
        };

        Ok(encode_room(&task, encoder, None, told)?)
    }

    /// Triangulates the keypoints of a room, if the encoder detects them.
    fn map(
        &self,
        room: &Room,
        encoder: &Encoder,
        feature: &FeatureSource,
        encoded: &Encoded,
    ) -> anyhow::Result<Option<RoomKeypoints>> {
        let camera = room.provenance().camera;
        let Some((outputs, camera)) = mapping_inputs(encoder, camera, room.id().as_str())? else {
            return Ok(None);
        };
        let map = map_keypoints(room.poses(), &encoded.keypoints, camera)?;
        room_keypoints(map, feature.clone(), outputs, &self.model).map(Some)
    }

    fn keep(&self, room: &Room, row: usize, drawn: &RgbImage) -> Result<(), Error> {
        let Some(image) = room.images().get(row).filter(|_| self.keep_images) else {
            return Ok(());
        };
        let file = Path::new(&room.provenance().images_root).join(image);

        if file.is_file() {
            return Ok(());
        }

        let io = |cause| Error::Io {
            file: file.clone(),
            cause,
        };

        if let Some(folder) = file.parent() {
            std::fs::create_dir_all(folder).map_err(io)?;
        }

        let bytes = encode_png(drawn)?;
        write_file(&file, &bytes).map_err(|error| io(std::io::Error::other(format!("{error:#}"))))
    }

    fn sheet(&self, file: &Path) -> anyhow::Result<()> {
        begin_output(file)?;
        let count = self.rooms.min(SHEET_ROOMS);

        // Images are rendered at twice the tile's size; `tiled` averages 2×2 pixels against
        // aliasing.
        let (width, height) = (SHEET_SIZE.0 * 2, SHEET_SIZE.1 * 2);
        let frame = self.frame_count() / 2;

        let images: Vec<RgbImage> = (0..count)
            .into_par_iter()
            .map(|number| self.film(number).image(frame, width, height))
            .collect();

        write_file(file, &encode_png(&tiled(&images, SHEET_COLUMNS))?)?;

        say(format_args!(
            "wrote {}: rooms 0 to {} of seed {}, frame {frame} each",
            file.display(),
            count - 1,
            self.seed
        ));

        Ok(())
    }
}

/// The image kept by an earlier run; `None` if it is missing or unreadable. An image of another
/// size is an error: its features would differ from those of a fresh rendering.
fn drawn_before(
    room: &Room,
    row: usize,
    (width, height): (usize, usize),
) -> Result<Option<RgbImage>, Error> {
    let Some(image) = room.images().get(row) else {
        return Ok(None);
    };
    match read_image(Path::new(&room.provenance().images_root), image) {
        Ok(kept) if (kept.width, kept.height) == (width, height) => Ok(Some(kept)),
        Ok(kept) => Err(Error::BadImage {
            image: image.clone(),
            problem: format!(
                "was kept at {}×{}, but this encoder takes {}×{}; render into another store",
                kept.width, kept.height, width, height
            )
            .into(),
        }),
        Err(_) => Ok(None),
    }
}

/// The stored room; `None` if the store does not have it. An error if the store has other frames
/// under its name.
async fn stored(store: &Store, room: &Room) -> anyhow::Result<Option<StoredRoom>> {
    let name = room.id().as_str();
    let stored = match store.load_room(name, None).await {
        Ok(stored) => stored,
        Err(seese3_store::Error::Unknown { .. }) => return Ok(None),
        Err(error) => return Err(error.into()),
    };

    // The name contains the seed but not the number of frames, so equal names do not imply equal
    // poses.
    if !same_poses(&stored.room, room) {
        bail!(
            "room '{name}' is in the store with other frames ({}, this suite has {}); \
            choose another store",
            stored.room.frame_count(),
            room.frame_count()
        );
    }

    let [before, now] = [&stored.room, room].map(|room| &room.provenance().format);
    if before != now {
        bail!("room '{name}' is in the store as '{before}', not '{now}'; choose another store");
    }

    Ok(Some(stored))
}

/// A contact sheet: images of one size, each reduced to half its size, row by row in `columns`
/// columns.
fn tiled(images: &[RgbImage], columns: usize) -> RgbImage {
    let (width, height) = images
        .first()
        .map_or((0, 0), |image| (image.width / 2, image.height / 2));

    let across = columns.min(images.len());
    let down = images.len().div_ceil(columns);
    let mut sheet = RgbImage {
        width: across * width,
        height: down * height,
        bytes: Vec::new(),
    };

    // White, which stays visible where the last row of tiles is not full.
    sheet.bytes = vec![255; sheet.width * sheet.height * 3];

    for (place, image) in images.iter().enumerate() {
        let left = place % columns * width;
        let top = place / columns * height;
        for y in 0..height {
            for x in 0..width {
                // A pixel of the sheet is the mean of 2×2 pixels of the image.
                let four = [(0, 0), (1, 0), (0, 1), (1, 1)]
                    .map(|(dx, dy)| image.pixel(2 * x + dx, 2 * y + dy));
                let at = ((top + y) * sheet.width + left + x) * 3;
                for c in 0..3 {
                    sheet.bytes[at + c] =
                        (four.iter().map(|pixel| u32::from(pixel[c])).sum::<u32>() / 4) as u8;
                }
            }
        }
    }

    sheet
}

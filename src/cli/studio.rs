//! `seese3 studio`: a suite of drawn rooms, encoded as they are drawn.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::Args;
use rayon::prelude::*;

use super::encode::{by_layer, check_names, has, same_poses};
use super::encoder::{EncoderOptions, RuntimeOptions};
use super::progress::bar;
use super::{check_writable, say, write_file};
use crate::cancel::Cancellation;
use crate::encoder::{Encoder, Error, OnBadImage, Task, encode_png, encode_room, read_image};
use crate::features::FeatureSource;
use crate::image::RgbImage;
use crate::room::{Frames, Provenance, Room, RoomId, Timeline};
use crate::store::{Store, StoredRoom};
use crate::studio::{Camera, SuiteRoom, render};

/// Rooms of a contact sheet, and its columns.
const SHEET_ROOMS: u32 = 48;
const SHEET_COLUMNS: usize = 8;
const SHEET_SIZE: (usize, usize) = (160, 120);

#[derive(Debug, Args)]
pub struct Studio {
    /// Where the rooms go; made if it is not there
    #[arg(
        long,
        env = "SEESE3_STORE",
        visible_alias = "store",
        required_unless_present = "sheet"
    )]
    out: Option<String>,
    /// How many rooms
    #[arg(long, default_value_t = 231, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    rooms: u32,
    /// Images a room
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u32).range(2..=100_000))]
    frames: u32,
    /// Of the suite; the same seed draws the same rooms
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// What encodes the images: an ONNX file, `pixels` or `builtin`
    #[arg(long, value_name = "MODEL", default_value = "builtin")]
    encode: String,
    #[command(flatten)]
    encoder: EncoderOptions,
    #[command(flatten)]
    runtime: RuntimeOptions,
    /// Images a run of the model
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=4_096))]
    batch: u32,
    /// What the features' names begin with; the model's name if nothing is given
    #[arg(long = "as", value_name = "PREFIX")]
    prefix: Option<String>,
    /// Keep the images as PNG files, in the store's folder `images`
    #[arg(long)]
    keep_images: bool,
    /// Only draw one picture of up to 48 rooms, one image each, into this PNG file
    #[arg(long, value_name = "FILE")]
    sheet: Option<PathBuf>,
}

/// What drawing and encoding took, summed over threads.
#[derive(Default)]
struct Spent {
    drawing_us: AtomicU64,
    wall: Duration,
}

impl Studio {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(file) = &self.sheet {
            return self.sheet(file);
        }

        let out = self.out()?;
        if self.keep_images && out.contains("://") {
            bail!("--keep-images needs a store that is a folder");
        }

        let encoder = self.encoder.open(&self.encode, &self.runtime.runtime())?;
        if encoder.window() > 1 && self.keep_images {
            bail!("--keep-images draws single images; leave it out for an encoder of clips");
        }

        let store = Store::create(out)?;
        let sources = encoder.sources(&self.prefix());
        check_names(&sources)?;
        let (width, height) = encoder.render_size();

        say(format_args!(
            "{} rooms of {} frames at {width}x{height}, encoder {} by {}",
            self.rooms,
            self.frames,
            encoder.id(),
            encoder.runtime()
        ));

        let (drawn, there, spent) = self.draw(&store, &encoder, &sources).await?;
        say(format_args!(
            "{drawn} rooms drawn, {there} were there already"
        ));

        if drawn > 0 {
            let threads = self.runtime.threads();
            let rooms = f64::from(drawn);
            let drawing = spent.drawing_us.load(Ordering::Relaxed) as f64 / 1e6;
            say(format_args!(
                "a room took {:.1} s on {threads} threads; drawing alone {:.1} thread-seconds",
                spent.wall.as_secs_f64() / rooms,
                drawing / rooms
            ));
        }

        for source in &sources {
            say(format_args!(
                "features '{}': {} columns",
                source.name, source.dim
            ));
        }

        Ok(())
    }

    /// Draws and publishes the rooms that are missing: how many were, how many were there, and what
    /// it took.
    async fn draw(
        &self,
        store: &Store,
        encoder: &Encoder,
        sources: &[FeatureSource],
    ) -> anyhow::Result<(u32, u32, Spent)> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(self.runtime.threads())
            .build()?;

        let progress = bar(u64::from(self.rooms) * u64::from(self.frames), "drawing");
        let mut spent = Spent::default();
        let mut drawn = 0;
        let mut there = 0;

        for number in 0..self.rooms {
            let name = self.room_name(number);
            progress.set_message(name.clone());
            let begun = Instant::now();
            let suite = SuiteRoom::new(self.seed, number);
            let mut room = self.room(&name, &suite)?;
            let before = stored(store, &room).await?;
            let images_kept = before
                .as_ref()
                .is_some_and(|before| before.room.images() == room.images());

            if before
                .as_ref()
                .is_some_and(|before| sources.iter().all(|source| has(before, source)))
                && (images_kept || !self.keep_images)
            {
                there += 1;
            } else {
                // What an earlier run kept stays with the room.
                if let Some(before) = before.filter(|_| !self.keep_images) {
                    room = before.room;
                }

                let told = |done: usize| {
                    progress.set_position(u64::from(number) * u64::from(self.frames) + done as u64);
                };
                let rows =
                    pool.install(|| self.encode_room(&room, &suite, encoder, &spent, &told))?;
                store
                    .publish_room(&room, &by_layer(sources, &rows)?)
                    .await?;

                drawn += 1;
                spent.wall += begun.elapsed();
            }

            progress.set_position(u64::from(number + 1) * u64::from(self.frames));
        }

        progress.finish_and_clear();
        Ok((drawn, there, spent))
    }

    fn out(&self) -> anyhow::Result<&str> {
        self.out.as_deref().context("--out DIR is required")
    }

    fn prefix(&self) -> String {
        let stem = || {
            Path::new(&self.encode)
                .file_stem()
                .map(|stem| stem.to_string_lossy().into_owned())
        };
        self.prefix.clone().or_else(stem).unwrap_or_default()
    }

    fn room_name(&self, number: u32) -> String {
        format!("studio{}-{number:04}", self.seed)
    }

    /// The room without its features.
    fn room(&self, name: &str, suite: &SuiteRoom) -> anyhow::Result<Room> {
        let poses = suite.path(self.frames as usize);

        let mut provenance = Provenance {
            format: format!("studio {}", suite.walk.name()),
            licence: "CC0-1.0".to_owned(),
            ..Provenance::default()
        };

        let mut frames = Frames {
            poses,
            ..Frames::default()
        };

        if self.keep_images {
            let out = self.out()?;
            let root = Path::new(out)
                .canonicalize()
                .with_context(|| out.to_owned())?
                .join("images");
            provenance.images_root = root
                .to_str()
                .context("the store's path is not UTF-8")?
                .to_owned();

            frames.images = (0..self.frames)
                .map(|frame| format!("{name}/frame-{frame:06}.png"))
                .collect();
        }

        Ok(Room::new(RoomId::new(name)?, frames, provenance)?)
    }

    fn encode_room(
        &self,
        room: &Room,
        suite: &SuiteRoom,
        encoder: &Encoder,
        spent: &Spent,
        told: &(dyn Fn(usize) + Sync),
    ) -> anyhow::Result<ndarray::Array2<f32>> {
        let (width, height) = encoder.render_size();
        let camera = Camera::sized(width, height);

        let image = |row: usize| -> Result<RgbImage, Error> {
            let begun = Instant::now();

            let drawn = match drawn_before(room, row, camera)? {
                Some(kept) => kept,
                None => render(&suite.scene, camera, &room.poses()[row]),
            };

            spent
                .drawing_us
                .fetch_add(begun.elapsed().as_micros() as u64, Ordering::Relaxed);

            self.keep(room, row, &drawn)?;
            Ok(drawn)
        };

        let timeline = Timeline::unbroken(room.frame_count());
        let cancel = Cancellation::default();
        let batch = self.batch as usize;

        let task = Task {
            timeline: &timeline,
            image: &image,
            batch,
            on_bad: OnBadImage::Stop,
            cancel: &cancel,
        };

        Ok(encode_room(&task, encoder, None, told)?.rows)
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
        check_writable(file)?;
        let count = self.rooms.min(SHEET_ROOMS);
        let camera = Camera::sized(SHEET_SIZE.0 * 2, SHEET_SIZE.1 * 2);
        let frame = self.frames as usize / 2;

        let images: Vec<RgbImage> = (0..count)
            .into_par_iter()
            .map(|number| {
                let suite = SuiteRoom::new(self.seed, number);
                render(
                    &suite.scene,
                    camera,
                    &suite.path(self.frames as usize)[frame],
                )
            })
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

/// The kept image of an earlier run, if it is whole. One of another size would not give the same
/// features again.
fn drawn_before(room: &Room, row: usize, camera: Camera) -> Result<Option<RgbImage>, Error> {
    let Some(image) = room.images().get(row) else {
        return Ok(None);
    };
    match read_image(Path::new(&room.provenance().images_root), image) {
        Ok(kept) if (kept.width, kept.height) == (camera.width, camera.height) => Ok(Some(kept)),
        Ok(kept) => Err(Error::BadImage {
            image: image.clone(),
            problem: format!(
                "was kept at {}×{}, this encoder sees {}×{}; draw into another store",
                kept.width, kept.height, camera.width, camera.height
            ),
        }),
        Err(_) => Ok(None),
    }
}

/// The room as it is in the store, if it is; refused if it has other frames there.
async fn stored(store: &Store, room: &Room) -> anyhow::Result<Option<StoredRoom>> {
    let name = room.id().as_str();
    let stored = match store.load_room(name, None).await {
        Ok(stored) => stored,
        Err(crate::store::Error::Unknown { .. }) => return Ok(None),
        Err(error) => return Err(error.into()),
    };

    if !same_poses(&stored.room, room) {
        bail!(
            "room '{name}' is in the store with other frames ({}, this suite has {}); name another store",
            stored.room.frame_count(),
            room.frame_count()
        );
    }

    Ok(Some(stored))
}

/// Images of one size at half their size, row by row.
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

    sheet.bytes = vec![255; sheet.width * sheet.height * 3];

    for (place, image) in images.iter().enumerate() {
        let left = place % columns * width;
        let top = place / columns * height;
        for y in 0..height {
            for x in 0..width {
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

//! `seese3 encode`: the images of a stored room to features.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail};
use clap::Args;

use super::encoder::{EncoderOptions, RuntimeOptions};
use super::progress::bar;
use super::say;
use crate::cancel::Cancellation;
use crate::encoder::{Encoded, Encoder, Journal, Kept, OnBadImage, Task, encode_room, read_image};
use crate::features::{FeatureSource, Features};
use crate::geometry::Pose;
use crate::room::{Room, is_plain_name};
use crate::store::{Store, StoredRoom};

/// Bad images that are named one by one; the rest are counted.
const NAMED: usize = 20;

#[derive(Debug, Args)]
pub struct Encode {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room, imported from a recording with images
    #[arg(long)]
    room: String,
    /// An ONNX file, or `pixels` or `builtin`, which need none
    #[arg(long)]
    model: String,
    #[command(flatten)]
    encoder: EncoderOptions,
    #[command(flatten)]
    runtime: RuntimeOptions,
    /// Images a run of the model
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=4_096))]
    batch: u32,
    /// Where the images are now, instead of where they were when the room was imported
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// What the features' names begin with; the model's name if nothing is given
    #[arg(long = "as", value_name = "PREFIX")]
    prefix: Option<String>,
    /// Leave out frames whose image cannot be read, instead of stopping: the room loses them, with
    /// all their features
    #[arg(long)]
    skip_bad: bool,
    /// Encode again what the room has already
    #[arg(long)]
    again: bool,
    /// Where rows are kept until the room is whole; a folder of the store if none is given
    #[arg(long, value_name = "DIR")]
    journal: Option<PathBuf>,
}

impl Encode {
    pub async fn run(self) -> anyhow::Result<()> {
        let runtime = self.runtime.runtime();
        let encoder = self.encoder.open(&self.model, &runtime)?;
        let store = Store::open(&self.store)?;
        let stored = store.load_room(&self.room, None).await?;

        let sources = encoder.sources(&self.prefix());
        check_names(&sources)?;
        let root = images_root(&stored.room, self.images.as_deref())?;

        if !self.again && sources.iter().all(|source| has(&stored, source)) {
            let names: Vec<&str> = sources.iter().map(|source| source.name.as_str()).collect();
            let room = &self.room;
            let revision = stored.revision;
            say(format_args!(
                "already there in room '{room}' revision {revision}: {}",
                names.join(", ")
            ));

            return Ok(());
        }

        for source in sources
            .iter()
            .filter(|source| stored.features(&source.name).is_some() && !has(&stored, source))
        {
            say(format_args!(
                "replaces features '{}', which were made otherwise",
                source.name
            ));
        }

        say(format_args!(
            "encoder {} by {}, {}",
            encoder.id(),
            encoder.runtime(),
            sources[0].preprocess
        ));

        let key = key(&stored, &encoder, &root);
        let path = self.journal_path(&key)?;
        if self.again && path.exists() {
            std::fs::remove_file(&path).with_context(|| path.display().to_string())?;
        }

        let (mut journal, before) = Journal::open(&path, &key, encoder.dims().iter().sum())?;
        let begun = Instant::now();

        let encoded = self.encode(
            &stored.room,
            &root,
            &encoder,
            Kept {
                journal: &mut journal,
                before,
            },
        )?;

        let seconds = begun.elapsed().as_secs_f64();
        say_bad(&stored.room, &encoded);

        if encoded.good.is_empty() {
            bail!(crate::encoder::Error::AllBad {
                room: self.room.clone()
            });
        }

        let newest = store.load_room(&self.room, None).await?;
        if !same_poses(&newest.room, &stored.room) {
            bail!(
                "room '{}' got other frames while it was encoded (revision {}, was {}); run the command again",
                self.room,
                newest.revision,
                stored.revision
            );
        }

        let (room, features) = whole(newest, &sources, &encoded)?;
        let published = store.publish_room(&room, &features).await?;
        journal.finish()?;
        let fresh = encoded.good.len() - encoded.resumed.min(encoded.good.len());
        let rate = fresh as f64 / seconds;
        say(format_args!(
            "encoded {fresh} frames in {seconds:.1} s ({rate:.0} a second), {} were done before",
            encoded.resumed
        ));

        for source in &sources {
            say(format_args!(
                "features '{}': {} columns",
                source.name, source.dim
            ));
        }

        let revision = published.revision;
        let location = store.location();
        say(format_args!(
            "published room '{}' revision {revision}: {location}/{}",
            self.room, published.manifest
        ));

        Ok(())
    }

    fn prefix(&self) -> String {
        let stem = || {
            Path::new(&self.model)
                .file_stem()
                .map(|stem| stem.to_string_lossy().into_owned())
        };
        self.prefix.clone().or_else(stem).unwrap_or_default()
    }

    fn journal_path(&self, key: &str) -> anyhow::Result<PathBuf> {
        let folder = match &self.journal {
            Some(folder) => folder.clone(),
            None if self.store.contains("://") => {
                bail!("--journal DIR is required for a store that is no folder")
            }
            None => Path::new(&self.store).join("unfinished"),
        };

        Ok(folder.join(format!(
            "{}-{}.rows",
            self.room,
            crate::store::short_digest(key)
        )))
    }

    fn encode(
        &self,
        room: &Room,
        root: &Path,
        encoder: &Encoder,
        kept: Kept<'_>,
    ) -> anyhow::Result<Encoded> {
        let images = room.images();
        let image = |row: usize| read_image(root, &images[row]);
        let cancel = Cancellation::default();

        let on_bad = if self.skip_bad {
            OnBadImage::Skip
        } else {
            OnBadImage::Stop
        };

        let task = Task {
            timeline: room.timeline(),
            image: &image,
            batch: self.batch as usize,
            on_bad,
            cancel: &cancel,
        };

        let progress = bar(room.frame_count() as u64, "encoding");
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(self.runtime.threads())
            .build()?;

        let told = |done: usize| progress.set_position(done as u64);
        let encoded = pool.install(|| encode_room(&task, encoder, Some(kept), &told));
        progress.finish_and_clear();

        encoded.context("what was encoded is kept; the same command goes on from there")
    }
}

/// Where a room's images are.
fn images_root(room: &Room, given: Option<&Path>) -> anyhow::Result<PathBuf> {
    if room.images().is_empty() {
        bail!(crate::encoder::Error::NoImages {
            room: room.id().to_string()
        });
    }

    let root = given.map_or_else(
        || PathBuf::from(&room.provenance().images_root),
        Path::to_owned,
    );

    if !root.is_dir() {
        bail!(
            "{} is no folder; say with --images DIR where the images are now",
            root.display()
        );
    }

    Ok(root)
}

/// Whether a room has features of that name, made like that.
pub fn has(stored: &StoredRoom, source: &FeatureSource) -> bool {
    stored
        .features(&source.name)
        .is_some_and(|set| set.source() == source)
}

/// All that decides the rows of a run.
fn key(stored: &StoredRoom, encoder: &Encoder, root: &Path) -> String {
    let room = &stored.room;
    let sources = encoder.sources("");

    // A file that was written anew has another time or size.
    let state = |image: &String| {
        let file = image
            .rsplit_once('@')
            .map_or(image.as_str(), |(file, _)| file);
        let metadata = std::fs::metadata(root.join(file)).ok()?;

        Some((metadata.len(), metadata.modified().ok()))
    };

    let states: Vec<_> = room.images().iter().map(state).collect();
    format!(
        "{}\n{}\n{}\n{}\n{:?}\n{:?}\n{:?}\n{:?}",
        room.id(),
        stored.revision,
        root.display(),
        encoder.runtime(),
        room.images(),
        states,
        room.timeline().sequences,
        sources
    )
}

/// Refuses names that features cannot have, before anything is encoded.
pub fn check_names(sources: &[FeatureSource]) -> anyhow::Result<()> {
    for (position, FeatureSource { name, layer, .. }) in sources.iter().enumerate() {
        if !is_plain_name(name) {
            bail!(
                "layer '{layer}' would give features of the name '{name}', which is over 100 characters or empty; give --as PREFIX"
            );
        }

        if sources[..position].iter().any(|other| other.name == *name) {
            bail!(
                "two layers would give features of the name '{name}'; encode them apart, with --as PREFIX"
            );
        }
    }

    Ok(())
}

/// Whether two rooms have the same frames.
pub fn same_poses(a: &Room, b: &Room) -> bool {
    let near = |(a, b): (&Pose, &Pose)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-9;
    a.frame_count() == b.frame_count() && a.poses().iter().zip(b.poses()).all(near)
}

fn say_bad(room: &Room, encoded: &Encoded) {
    for (row, problem) in encoded.bad.iter().take(NAMED) {
        say(format_args!(
            "left out frame {row} ({}): {problem}",
            room.images()[*row]
        ));
    }

    if !encoded.bad.is_empty() {
        say(format_args!(
            "left out {} frames in all; the room's new revision is without them",
            encoded.bad.len()
        ));
    }
}

/// The columns of each layer.
pub fn by_layer(
    sources: &[FeatureSource],
    rows: &ndarray::Array2<f32>,
) -> anyhow::Result<Vec<Features>> {
    let mut from = 0;
    let mut features = Vec::with_capacity(sources.len());
    for source in sources {
        let columns = rows
            .slice(ndarray::s![.., from..from + source.dim])
            .to_owned();
        features.push(Features::new(source.clone(), columns)?);

        from += source.dim;
    }

    Ok(features)
}

/// The room with its new features; without the bad frames, if there were any.
fn whole(
    stored: StoredRoom,
    sources: &[FeatureSource],
    encoded: &Encoded,
) -> anyhow::Result<(Room, Vec<Features>)> {
    let mut features = by_layer(sources, &encoded.rows)?;
    if encoded.bad.is_empty() {
        return Ok((stored.room, features));
    }

    let frames = stored.room.frames().select(&encoded.good);
    let provenance = stored.room.provenance().clone();
    let room = Room::new(stored.room.id().clone(), frames, provenance)?;

    let others = stored.features.iter().filter(|set| {
        sources
            .iter()
            .all(|source| source.name != set.source().name)
    });
    features.extend(others.map(|set| set.select(&encoded.good)));

    Ok((room, features))
}

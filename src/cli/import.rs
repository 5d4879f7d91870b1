//! `seese3 import`: a recording on disk into a store.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::{Args, Subcommand};

use super::say;
use crate::datasets::{self, Recording};
use crate::features::{FeatureSource, Features};
use crate::room::{Frames, Provenance, Room, RoomId};
use crate::store::{Store, check_features};

#[derive(Debug, Args)]
pub struct Import {
    #[command(subcommand)]
    format: Format,
}

#[derive(Debug, Subcommand)]
enum Format {
    /// NumPy files: poses (n, 4, 4) world_from_camera in metres, features (n, d)
    Numpy(Numpy),
    /// 7-Scenes: SCENE/seq-XX/frame-XXXXXX.pose.txt
    #[command(name = "7scenes")]
    SevenScenes(SevenScenes),
}

#[derive(Debug, Args)]
struct Destination {
    /// The room's name in the store
    #[arg(long)]
    room: Option<String>,
    /// Features of the frames, NAME=FILE.npy, shape (n, d); may be given several times
    #[arg(long = "features", value_name = "NAME=FILE")]
    features: Vec<String>,
    /// The store: a folder, made if it is not there
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The terms under which the recording may be used, kept with the room
    #[arg(long, default_value = "")]
    licence: String,
}

#[derive(Debug, Args)]
struct Numpy {
    /// Poses, world_from_camera, (n, 4, 4) f64 or f32, metres
    #[arg(long)]
    poses: PathBuf,
    /// Timestamps (n,), int64 nanoseconds or float seconds
    #[arg(long)]
    timestamps: Option<PathBuf>,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct SevenScenes {
    /// The scene's folder, or one sequence's
    path: PathBuf,
    /// Which sequence, for instance seq-01; needed when there are several
    #[arg(long)]
    sequence: Option<String>,
    /// Refuse the recording if a frame is unusable, instead of dropping that frame
    #[arg(long)]
    strict: bool,
    #[command(flatten)]
    to: Destination,
}

impl Import {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.format {
            Format::Numpy(numpy) => {
                let Some(room) = numpy.to.room.clone() else { bail!("--room NAME is required") };
                let mut recording = datasets::read_poses(&numpy.poses)?;
                if let Some(file) = &numpy.timestamps {
                    recording.frames.timestamps_ns = datasets::read_timestamps(file)?;
                }
                publish(&room, "numpy", recording, &numpy.to).await
            }
            Format::SevenScenes(scene) => {
                let recording = datasets::read_seven_scenes(&scene.path, scene.sequence.as_deref(), scene.strict)?;
                let folder = scene.path.canonicalize().unwrap_or_else(|_| scene.path.clone());
                let name = folder.file_name().map(|name| name.to_string_lossy().into_owned());
                let room = scene.to.room.clone().or(name).context("--room NAME is required")?;
                publish(&room, "7scenes", recording, &scene.to).await
            }
        }
    }
}

async fn publish(room: &str, format: &str, recording: Recording, to: &Destination) -> anyhow::Result<()> {
    let Recording { frames, dropped, worst_rotation_deviation } = recording;
    let provenance = Provenance { format: format.to_owned(), licence: to.licence.clone(), worst_rotation_deviation };
    let has_times = !frames.timestamps_ns.is_empty();
    let room = Room::new(RoomId::new(room)?, Frames { ..frames }, provenance)?;
    let features = to.features.iter().map(|given| read_features(given)).collect::<anyhow::Result<Vec<_>>>()?;
    for set in &features {
        let (rows, frames) = (set.rows().nrows(), room.frame_count());
        if rows != frames {
            let unusable = dropped.len();
            let name = &set.source().name;
            bail!("features '{name}' have {rows} rows, the recording has {frames} usable frames ({unusable} dropped)");
        }
    }
    check_features(&room, &features)?;
    let store = Store::create(&to.store)?;
    let published = store.publish_room(&room, &features).await?;
    let times = if has_times { "with timestamps" } else { "without timestamps" };
    say(format_args!("room '{}': {} frames {times}", room.id(), room.frame_count()));
    say(format_args!("rotations: at most {worst_rotation_deviation:.1e} off SO(3), projected"));
    for set in &features {
        say(format_args!("features '{}': {} columns", set.source().name, set.source().dim));
    }
    for frame in dropped.iter().take(20) {
        say(format_args!("dropped {}: {}", frame.name, frame.reason));
    }
    if !dropped.is_empty() {
        say(format_args!("dropped {} frames in all", dropped.len()));
    }
    let state = if published.is_new { "published" } else { "already there, unchanged:" };
    say(format_args!("{state} revision {}: {}/{}", published.revision, store.location(), published.manifest));
    Ok(())
}

fn read_features(given: &str) -> anyhow::Result<Features> {
    let Some((name, file)) = given.split_once('=') else {
        bail!("--features '{given}' is not NAME=FILE.npy");
    };
    let rows = datasets::read_features(&PathBuf::from(file))?;
    let dim = rows.ncols();
    Features::new(FeatureSource::imported(name, dim), rows).with_context(|| file.to_owned())
}

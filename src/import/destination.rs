//! Options and steps that all import formats share.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde_json::json;

use super::frame_summary::{say_dropped, say_frames};
use crate::camera::{CAMERA_FORM, CameraOption};
use crate::encode::same_poses;
use crate::encoder::say_features;
use crate::output::{JsonOutput, say};
use crate::pose_options::{DirectionName, PoseOptions};
use crate::pose_report::{PosesFrom, check_with_images, contradiction, report_json, say_report};
use crate::progress::bar;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::room::{Frames, Provenance, Room, RoomId};
use seese3_data::datasets::{self, Reader, Recording, Unusable};
use seese3_data::pose_check::{PoseReport, check_room};
use seese3_store::{OtherFeatures, RoomContents, Store, check_features};

#[derive(Debug, Args)]
pub struct Destination {
    /// The store: a folder, created if it does not exist, or a URL of a bucket
    /// (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// Name of the room in the store; if omitted, the name in an exported bundle, else derived from
    /// the path
    #[arg(long)]
    pub name: Option<String>,
    /// Keep every K-th usable frame of each sequence, at least 1
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Fail and publish nothing, instead of warning. Reasons: an unusable frame; an unreadable
    /// image; implausible poses (all identical, identities from lost tracking, steps too long for
    /// meters, timestamps that do not increase)
    #[arg(long)]
    strict: bool,
    /// Publish a new revision even if the store has a room of this name with other frames; the
    /// features of the old frames are not carried over
    #[arg(long, conflicts_with = "extend")]
    replace: bool,
    /// Append the frames to the room of this name; their poses must be in its world frame, and
    /// --features must give every feature set that it has
    #[arg(long)]
    extend: bool,
    /// Publish the room although its images contradict its poses
    #[arg(long, conflicts_with = "strict")]
    allow_contradicted: bool,
    /// Features, NAME=FILE.npy, shape (n, d): one row for each usable frame, also for those that
    /// --every leaves out; may be given several times
    #[arg(long = "features", value_name = "NAME=FILE")]
    features: Vec<String>,
    /// License of the recording, stored with the room
    #[arg(long, default_value = "", hide_default_value = true)]
    license: String,
    /// Camera of the images, in pixels; needed for motion estimation between two images. FOCAL may
    /// be FX,FY if CX,CY follow. LENS is k1=N,k2=N,p1=N,p2=N,k3=N (Brown–Conrady; coefficients of 0
    /// may be omitted) or fisheye=K1:K2:K3:K4 (Kannala–Brandt)
    #[arg(long, value_name = CAMERA_FORM)]
    camera: Option<CameraOption>,
    #[command(flatten)]
    read_as: PoseOptions,
    /// Do not compare the poses with the images
    #[arg(long)]
    skip_pose_check: bool,
    #[command(flatten)]
    json: JsonOutput,
}

impl Destination {
    /// Rejects replacing a room of the same name that has other frames, unless --replace was given.
    async fn refuse_other_frames(&self, store: &Store, room: &Room) -> anyhow::Result<()> {
        let before = match store.load_room(room.id().as_str(), None).await {
            Ok(before) => before.room,
            Err(seese3_store::Error::Unknown { .. }) => return Ok(()),
            Err(error) => return Err(error.into()),
        };

        // Features belong to frames: a room with new frames would silently lose the features of the
        // old ones.
        if self.replace || same_poses(&before, room) {
            return Ok(());
        }

        bail!(
            "room '{}' is in the store with other frames ({} from {}, these are {}); give another --name, or \
             --replace, which drops its features, or --extend, which appends these frames",
            room.id(),
            before.frame_count(),
            before.provenance().format,
            room.frame_count()
        );
    }

    /// Rejects poses that the images contradict, unless --allow-contradicted was given. `advice`
    /// says what to do about them.
    async fn refuse_contradicted(
        &self,
        store: &Store,
        room: &Room,
        advice: Option<String>,
    ) -> anyhow::Result<()> {
        let Some(advice) = advice.filter(|_| !self.allow_contradicted) else {
            return Ok(());
        };

        // A corrected import has other poses: a room that is there already has to be replaced.
        let is_stored = store.load_room(room.id().as_str(), None).await.is_ok();
        let replace = if is_stored {
            "; the room is in the store, so add --replace"
        } else {
            ""
        };
        bail!(
            "the images contradict the poses of room '{}'; nothing was published. Remedy: {advice}{replace}. \
             If the poses are right, give --allow-contradicted",
            room.id()
        );
    }

    /// Rejects unreadable images and implausible poses, with --strict.
    fn refuse_if_strict(&self, room: &Room, report: &PoseReport) -> anyhow::Result<()> {
        if self.strict && report.has_unreadable_images() {
            bail!(
                "images of room '{}' cannot be read, see the warnings; nothing was published (--strict)",
                room.id()
            );
        }
        if self.strict && report.is_wrong() {
            bail!(
                "the poses of room '{}' are wrong, see the warnings; nothing was published (--strict)",
                room.id()
            );
        }
        Ok(())
    }

    /// Checks, before the work, that the results can be written.
    pub fn begin(&self) -> anyhow::Result<()> {
        self.json.begin()
    }

    /// Reads a recording with a progress bar. Drops unusable frames, or fails on one with --strict.
    pub fn read<T>(
        &self,
        read: impl FnOnce(&mut Reader<'_>) -> Result<T, datasets::Error>,
    ) -> anyhow::Result<T> {
        self.begin()?;

        let progress = bar(0, "reading");

        let unusable = if self.strict {
            Unusable::Refuse
        } else {
            Unusable::Drop
        };

        // The reader determines the number of frames, so the bar gets its length from it.
        let mut tell = |done: usize, total: usize| {
            progress.set_length(total as u64);
            progress.set_position(done as u64);
        };
        let recording = read(&mut Reader {
            unusable,
            progress: &mut tell,
        })?;

        progress.finish_and_clear();
        Ok(recording)
    }

    /// The room of a recording. An exported bundle states its name, format and license: the
    /// original format is kept, and --license and --name override the stated values.
    fn room(
        &self,
        format: &str,
        path: &Path,
        recording: &Recording,
        frames: Frames,
    ) -> anyhow::Result<Room> {
        let stated = &recording.stated;
        let either = |given: &str, stated: &str| {
            if given.is_empty() {
                stated.to_owned()
            } else {
                given.to_owned()
            }
        };
        let provenance = Provenance {
            format: either(&stated.format, format),
            license: either(&self.license, &stated.license),
            images_root: recording.images_root.clone(),
            worst_rotation_deviation: recording.worst_rotation_deviation,
            camera: self
                .camera
                .map(|CameraOption(camera)| camera)
                .or(stated.camera),
        };

        // Name: --name, else the bundle's, else derived from the path.
        let name = match &self.name {
            Some(name) => name.clone(),
            None if !stated.name.is_empty() => stated.name.clone(),
            None => name_from(format, path).context("--name NAME is required")?,
        };
        let id = RoomId::new(&name).context("give another name with --name")?;
        Ok(Room::new(id, frames, provenance)?)
    }

    /// Prints a summary of the recording.
    fn say_read(
        &self,
        room: &Room,
        features: &[Features],
        recording: &Recording,
        read_count: usize,
    ) {
        let times = if room.timestamps_ns().is_empty() {
            "without timestamps"
        } else {
            "with timestamps"
        };

        let thinned = if self.every > 1 {
            format!(", every {} of {read_count}", self.every)
        } else {
            String::new()
        };
        say(format_args!(
            "room '{}': {} frames {times}{thinned}",
            room.id(),
            room.frame_count()
        ));

        say_frames(room);
        let deviation = recording.worst_rotation_deviation;
        say(format_args!(
            "rotations: R Rᵀ differs from the identity by at most {deviation:.1e}; projected onto SO(3)"
        ));

        say_features(features.iter().map(Features::source));

        say_dropped(&recording.dropped);
    }

    /// Reads the feature files of the options. They have one row per usable frame; the count is
    /// checked before --every thins both.
    fn read_features(&self, recording: &mut Recording) -> anyhow::Result<()> {
        for given in &self.features {
            recording.features.push(read_features(given)?);
        }

        let read_count = recording.frames.poses.len();
        for set in &recording.features {
            let rows = set.rows().nrows();
            let unusable = recording.dropped.len();
            if rows != read_count {
                let name = &set.source().name;
                bail!(
                    "features '{name}' have {rows} rows, the recording has {read_count} usable frames \
                     ({unusable} dropped)"
                );
            }
        }

        Ok(())
    }

    pub async fn publish(
        &self,
        format: &str,
        path: &Path,
        mut recording: Recording,
        direction: DirectionName,
    ) -> anyhow::Result<()> {
        let read_count = recording.frames.poses.len();

        self.read_features(&mut recording)?;

        // Frames and features keep the same rows; counting restarts in each sequence.
        let kept = recording.every(self.every as usize);
        let features = recording
            .features
            .iter()
            .map(|set| set.select(&kept))
            .collect::<Vec<_>>();

        // Compare the images with the poses before their conversion, so that warnings can suggest
        // the options that correct a mistake.
        let mut frames = recording.frames.select(&kept);
        let read_as = self.read_as.convention(direction);
        let stated = self.read_as.scaled(&frames.poses);
        let read = stated.iter().map(|pose| read_as.to_world_from_camera(pose));
        frames.poses = read.collect();
        let room = self.room(format, path, &recording, frames)?;

        // The last checks come before the first write: a failed import publishes nothing.
        check_features(&room, &features)?;
        let store = Store::create(&self.store)?;
        store.check_writable().await?;
        if !self.extend {
            self.refuse_other_frames(&store, &room).await?;
        }

        self.say_read(&room, &features, &recording, read_count);
        let from = PosesFrom::Recording(read_as);
        let report = if self.skip_pose_check || room.images().is_empty() {
            check_room(&room, None)
        } else {
            let root = Path::new(&recording.images_root);
            check_with_images(&room, root, &stated, from)
        };
        say_report(&report, from);
        if format == "colmap" && self.read_as.has_no_scale() {
            eprintln!(
                "warning: the scale of a COLMAP model is arbitrary, and rooms are in meters: give --scale \
                 FACTOR, or --scale 1 if the model was aligned with known positions"
            );
        }

        self.refuse_contradicted(&store, &room, contradiction(&report, from))
            .await?;
        self.refuse_if_strict(&room, &report)?;
        let published = if self.extend {
            let added = RoomContents::of(&room, &features);
            store.extend_room(added, OtherFeatures::Required).await?
        } else if self.replace {
            store.publish_room(&room, &features).await?
        } else {
            store.publish_same_frames(&room, &features).await?
        };

        // Publishing the same content again creates no new revision, so an import can safely be
        // repeated.
        let state = if published.is_new {
            "published"
        } else {
            "already there, unchanged:"
        };

        say(format_args!(
            "{state} revision {}: {}/{}",
            published.revision,
            store.location(),
            published.manifest
        ));

        let mut record = report_json(&report, &room, from);
        record["revision"] = json!(published.revision);
        record["created"] = json!(published.is_new);
        record["dropped_count"] = json!(recording.dropped.len());
        self.json.write(&record)
    }
}

/// A room name from its path. Folder names of 12-Scenes rooms and 7-Scenes sequences repeat, so the
/// parent folder's name is prepended.
fn name_from(format: &str, path: &Path) -> Option<String> {
    // A path such as `.` only has a name once it is resolved.
    let path = path.canonicalize().ok()?;
    let stem = if path.is_file() {
        path.file_stem()
    } else {
        path.file_name()
    };
    let own = stem?.to_string_lossy().into_owned();

    let above = path
        .parent()
        .and_then(Path::file_name)
        .map(|name| name.to_string_lossy().into_owned());

    match (format, above) {
        ("12scenes", Some(house)) => Some(format!("{house}-{own}")),
        ("7scenes", Some(scene)) if own.starts_with("seq-") => Some(format!("{scene}-{own}")),
        _ => Some(own),
    }
}

fn read_features(given: &str) -> anyhow::Result<Features> {
    let Some((name, file)) = given.split_once('=') else {
        bail!("--features '{given}' is not NAME=FILE.npy");
    };
    let rows = datasets::read_features(&PathBuf::from(file))?;
    let dim = rows.ncols();

    Features::new(FeatureSource::imported(name, dim), rows).with_context(|| file.to_owned())
}

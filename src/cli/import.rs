//! `seese3 import`: reads a recording from disk and publishes it as a room in a store.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, Subcommand};
use serde_json::json;

use super::camera::CameraOption;
use super::encode::same_poses;
use super::output::{JsonOutput, say};
use super::pose_options::{DirectionName, DirectionOption, PoseOptions};
use super::pose_report::PoseReport;
use super::progress::bar;
use crate::datasets::{self, Bag, Dropped, Kitti, Reader, Recording, SevenScenes, Unusable};
use crate::store::{Store, check_features};
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::Pose;
use seese3_core::room::{Frames, Provenance, Room, RoomId};

/// The number of dropped frames that are listed one by one; beyond that they are only counted.
const NAMED: usize = 20;

#[derive(Debug, Args)]
pub struct Import {
    #[command(subcommand)]
    format: Format,
}

#[derive(Debug, Subcommand)]
enum Format {
    /// ScanNet: an exported scene's folder (color/, pose/), or a .sens file
    Scannet(Plain),
    /// ARKitScenes: a video's folder (lowres_wide/, lowres_wide.traj)
    Arkitscenes(Plain),
    /// TUM RGB-D: a sequence's folder (rgb.txt, groundtruth.txt)
    Tum(Plain),
    /// 12-Scenes: a room's folder (data/, split.txt)
    #[command(name = "12scenes")]
    TwelveScenes(Plain),
    /// 7-Scenes: a scene's folder (seq-XX/frame-XXXXXX.pose.txt), or one sequence's
    #[command(name = "7scenes")]
    SevenScenes(Seven),
    /// A folder of your own: images/, and poses.npy (n, 4, 4) in the order of the images' names
    Folder(Plain),
    /// COLMAP: a model (cameras and images, .bin or .txt), or a project's folder with sparse/0
    Colmap(Colmap),
    /// NeRF, instant-ngp and nerfstudio: a transforms.json, or its folder
    Transforms(Plain),
    /// KITTI odometry: a file of poses, with the folder of its images
    Kitti(KittiFiles),
    /// EuRoC MAV: a sequence's folder (mav0/cam0, mav0/state_groundtruth_estimate0)
    Euroc(Euroc),
    /// MCAP: a bag of ROS 2 or a recording of Foxglove, with images and poses or /tf
    Mcap(McapFile),
    /// NumPy files: poses (n, 4, 4) world_from_camera in metres, features (n, d)
    Numpy(Numpy),
    /// A folder that `seese3 export numpy` wrote
    Bundle(Plain),
}

#[derive(Debug, Args)]
struct Plain {
    /// The folder or file to read
    path: PathBuf,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct Seven {
    /// The scene's folder, or one sequence's
    path: PathBuf,
    /// One sequence, for instance seq-01; if omitted, all sequences of the scene make one room
    #[arg(long)]
    sequence: Option<String>,
    /// A text file with a 4x4 matrix, rgb_from_depth in metres: poses of the depth camera are
    /// converted to those of the colour camera
    #[arg(long, value_name = "FILE")]
    rgb_from_depth: Option<PathBuf>,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct Numpy {
    /// A folder of poses.npy and, optionally, timestamps.npy, frame_ids.npy and features_NAME.npy
    #[arg(required_unless_present = "poses", conflicts_with = "timestamps")]
    path: Option<PathBuf>,
    /// Two things, and may be given for each: world_from_camera or camera_from_world, which transform
    /// the poses are; or, instead of a folder, the NumPy file of poses, shape (n, 4, 4), f64 or f32
    #[arg(long, value_name = "TRANSFORM|FILE", action = clap::ArgAction::Append)]
    poses: Vec<PosesOption>,
    /// NumPy file of timestamps, shape (n,), int64 nanoseconds or float seconds; only with --poses
    #[arg(long)]
    timestamps: Option<PathBuf>,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct Colmap {
    /// The model's folder, or the project's
    path: PathBuf,
    /// The folder that the names of images start from; looked for beside the model if omitted
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct KittiFiles {
    /// The file of poses, twelve numbers a line
    path: PathBuf,
    /// The folder of the images, in the order of their numbers, such as sequences/00/image_2
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// The file of times, seconds, one a line, such as sequences/00/times.txt
    #[arg(long, value_name = "FILE")]
    times: Option<PathBuf>,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct Euroc {
    /// The sequence's folder
    path: PathBuf,
    /// Which of its cameras
    #[arg(long = "device", value_name = "NAME", default_value = "cam0")]
    device: String,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
struct McapFile {
    /// The .mcap file
    path: PathBuf,
    /// The topic of the images; may be omitted if there is only one
    #[arg(long, value_name = "TOPIC")]
    image_topic: Option<String>,
    /// The topic of the poses: PoseStamped, PoseWithCovarianceStamped or Odometry; may be omitted if
    /// there is only one
    #[arg(long, value_name = "TOPIC", conflicts_with = "world_frame")]
    pose_topic: Option<String>,
    /// Take the poses from /tf instead: those of the images' frame in this one, such as map
    #[arg(long, value_name = "FRAME")]
    world_frame: Option<String>,
    /// The camera on what the poses are of, x,y,z,qx,qy,qz,qw in metres, where the transforms do not
    /// tell it
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true, num_args = 1)]
    base_from_camera: Option<Vec<f64>>,
    /// The folder for the images, which the room refers to; FILE-images beside the file if omitted
    #[arg(long, value_name = "DIR")]
    images_to: Option<PathBuf>,
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
}

/// A value of `import numpy --poses`.
#[derive(Debug, Clone)]
enum PosesOption {
    Direction(DirectionName),
    File(PathBuf),
}

impl std::str::FromStr for PosesOption {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let direction = <DirectionName as clap::ValueEnum>::from_str(text, false);
        Ok(direction.map_or_else(|_| Self::File(PathBuf::from(text)), Self::Direction))
    }
}

#[derive(Debug, Args)]
struct Destination {
    /// The store: a folder, created if it does not exist, or a bucket by its URL
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// Name of the room in the store; derived from the path if omitted
    #[arg(long, visible_alias = "room")]
    name: Option<String>,
    /// Keep every K-th usable frame of each sequence
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Fail and publish nothing if a frame is unusable, instead of dropping it, and if the poses are
    /// wrong for certain (contradicted by the images, all the same, identities where tracking was
    /// lost, in another unit), instead of warning
    #[arg(long)]
    strict: bool,
    /// Publish a new revision even if the store has a room of this name with other frames; the
    /// features of those frames are not carried over
    #[arg(long)]
    replace: bool,
    /// Features of all usable frames, NAME=FILE.npy, shape (n, d), one row per frame before
    /// --every; may be given several times
    #[arg(long = "features", value_name = "NAME=FILE")]
    features: Vec<String>,
    /// Licence of the recording, stored with the room
    #[arg(long, default_value = "")]
    licence: String,
    /// The camera of the images, in pixels; motions between two images are read with it
    #[arg(long, value_name = "WIDTHxHEIGHT,FOCAL[,CX,CY]")]
    camera: Option<CameraOption>,
    #[command(flatten)]
    read_as: PoseOptions,
    /// Do not compare the poses with the images
    #[arg(long)]
    skip_pose_check: bool,
    #[command(flatten)]
    json: JsonOutput,
}

impl Import {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.format {
            Format::Scannet(plain) => plain.import("scannet", scannet).await,
            Format::Arkitscenes(plain) => {
                plain
                    .import("arkitscenes", datasets::read_arkitscenes)
                    .await
            }
            Format::Tum(plain) => plain.import("tum", datasets::read_tum).await,
            Format::TwelveScenes(plain) => {
                plain.import("12scenes", datasets::read_twelve_scenes).await
            }
            Format::SevenScenes(seven) => seven.import().await,
            Format::Folder(plain) => {
                plain
                    .import("folder", |path, _| datasets::read_folder(path))
                    .await
            }
            Format::Colmap(colmap) => colmap.import().await,
            Format::Transforms(plain) => {
                plain.import("transforms", datasets::read_transforms).await
            }
            Format::Kitti(kitti) => kitti.import().await,
            Format::Euroc(euroc) => euroc.import().await,
            Format::Mcap(file) => file.import().await,
            Format::Numpy(numpy) => numpy.import().await,
            Format::Bundle(plain) => {
                plain
                    .import("bundle", |path, _| datasets::read_bundle(path))
                    .await
            }
        }
    }
}

/// A `.sens` file holds a whole scan; otherwise an exporter has unpacked it into a folder.
fn scannet(path: &Path, reader: &mut Reader<'_>) -> Result<Recording, datasets::Error> {
    if path.is_file() {
        datasets::read_sens(path, reader)
    } else {
        datasets::read_scannet(path, reader)
    }
}

impl Seven {
    async fn import(self) -> anyhow::Result<()> {
        let choice = SevenScenes {
            sequence: self.sequence,
            rgb_from_depth: self.rgb_from_depth,
        };
        let read =
            |reader: &mut Reader<'_>| datasets::read_seven_scenes(&self.path, &choice, reader);
        let recording = self.to.read(read)?;

        self.to
            .publish("7scenes", &self.path, recording, self.poses.direction)
            .await
    }
}

impl Colmap {
    async fn import(self) -> anyhow::Result<()> {
        let read = |reader: &mut Reader<'_>| {
            datasets::read_colmap(&self.path, self.images.as_deref(), reader)
        };
        let recording = self.to.read(read)?;

        self.to
            .publish("colmap", &self.path, recording, self.poses.direction)
            .await
    }
}

impl KittiFiles {
    async fn import(self) -> anyhow::Result<()> {
        let beside = Kitti {
            images: self.images,
            times: self.times,
        };
        let read = |reader: &mut Reader<'_>| datasets::read_kitti(&self.path, &beside, reader);
        let recording = self.to.read(read)?;

        self.to
            .publish("kitti", &self.path, recording, self.poses.direction)
            .await
    }
}

impl McapFile {
    async fn import(self) -> anyhow::Result<()> {
        let base_from_camera = self.base_from_camera.as_deref().map(mounting).transpose()?;
        let beside = || {
            let mut name = self.path.file_stem().unwrap_or_default().to_owned();
            name.push("-images");
            self.path.with_file_name(name)
        };
        let bag = Bag {
            image_topic: self.image_topic.clone(),
            pose_topic: self.pose_topic.clone(),
            world: self.world_frame.clone(),
            base_from_camera,
            images: self.images_to.clone().unwrap_or_else(beside),
        };

        let read = |reader: &mut Reader<'_>| datasets::read_bag(&self.path, &bag, reader);
        let recording = self.to.read(read)?;
        self.to
            .publish("mcap", &self.path, recording, self.poses.direction)
            .await
    }
}

/// The pose of a camera on a robot.
fn mounting(numbers: &[f64]) -> anyhow::Result<Pose> {
    let &[x, y, z, qx, qy, qz, qw] = numbers else {
        bail!(
            "--base-from-camera needs seven numbers, x,y,z,qx,qy,qz,qw, got {}",
            numbers.len()
        );
    };
    let quaternion = nalgebra::Quaternion::new(qw, qx, qy, qz);
    let is_unit = (quaternion.norm() - 1.0).abs() < 1e-2;
    if !(is_unit && [x, y, z].iter().all(|number| number.is_finite())) {
        bail!(
            "--base-from-camera: the last four numbers are no unit quaternion, or a number is not finite"
        );
    }

    let rotation = nalgebra::UnitQuaternion::from_quaternion(quaternion);
    Ok(Pose::from_parts(
        nalgebra::Translation3::new(x, y, z),
        rotation,
    ))
}

impl Euroc {
    async fn import(self) -> anyhow::Result<()> {
        let read = |reader: &mut Reader<'_>| datasets::read_euroc(&self.path, &self.device, reader);
        let recording = self.to.read(read)?;

        self.to
            .publish("euroc", &self.path, recording, self.poses.direction)
            .await
    }
}

impl Plain {
    /// Reads a recording of one format and publishes it.
    async fn import(
        self,
        format: &str,
        read: impl FnOnce(&Path, &mut Reader<'_>) -> Result<Recording, datasets::Error>,
    ) -> anyhow::Result<()> {
        let recording = self.to.read(|reader| read(&self.path, reader))?;
        self.to
            .publish(format, &self.path, recording, self.poses.direction)
            .await
    }
}

impl Numpy {
    async fn import(self) -> anyhow::Result<()> {
        let mut file = None;
        let mut direction = DirectionName::WorldFromCamera;
        for given in self.poses {
            match given {
                PosesOption::Direction(given) => direction = given,
                PosesOption::File(given) if file.is_none() => file = Some(given),
                PosesOption::File(given) => bail!(
                    "--poses: {} is a second file, and neither world_from_camera nor camera_from_world",
                    given.display()
                ),
            }
        }

        // Arrays come either as a folder with fixed file names or as single files.
        let recording = match (&self.path, &file) {
            (Some(folder), Some(file)) => bail!(
                "--poses: {} is neither world_from_camera nor camera_from_world; as the file of \
                 poses it is read instead of the folder {}: give one of them",
                file.display(),
                folder.display()
            ),
            (Some(folder), None) => {
                if folder.join("images").is_dir() {
                    eprintln!(
                        "warning: {} is not read; `import folder` reads the images too",
                        folder.join("images").display()
                    );
                }
                datasets::read_numpy(folder)?
            }
            (None, Some(file)) => {
                let recording = datasets::read_poses(file)?;
                match &self.timestamps {
                    Some(file) => recording.with_timestamps(file)?,
                    None => recording,
                }
            }
            (None, None) => bail!("a folder or --poses FILE is required"),
        };

        // Single files have no folder that the room could be named after.
        if self.path.is_none() && self.to.name.is_none() {
            bail!("--name NAME is required");
        }

        let path = self.path.as_deref().unwrap_or(Path::new(""));
        self.to.publish("numpy", path, recording, direction).await
    }
}

impl Destination {
    /// Refuses to replace a room of the same name by one with other frames, unless --replace was
    /// given.
    async fn check_same(&self, store: &Store, room: Room) -> anyhow::Result<Room> {
        let before = match store.load_room(room.id().as_str(), None).await {
            Ok(before) => before.room,
            Err(crate::store::Error::Unknown { .. }) => return Ok(room),
            Err(error) => return Err(error.into()),
        };

        // Features belong to frames: new frames would silently lose the features that were
        // computed for the old ones.
        if self.replace || same_poses(&before, &room) {
            return Ok(with_known_camera(room, &before)?);
        }

        bail!(
            "room '{}' is in the store with other frames ({} from {}, these are {}); give another --name, or --replace, \
             which leaves its features behind",
            room.id(),
            before.frame_count(),
            before.provenance().format,
            room.frame_count()
        );
    }

    /// Reads a recording with a progress bar, dropping or refusing unusable frames as --strict
    /// says.
    fn read(
        &self,
        read: impl FnOnce(&mut Reader<'_>) -> Result<Recording, datasets::Error>,
    ) -> anyhow::Result<Recording> {
        let progress = bar(0, "reading");

        let unusable = if self.strict {
            Unusable::Refuse
        } else {
            Unusable::Drop
        };

        // Only the reader knows how many frames there are, so the bar gets its length from it.
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

    /// The room of a recording. An exported bundle states its name, format and licence: the
    /// original format is kept, and --licence and --name win over the stated ones.
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
            licence: either(&self.licence, &stated.licence),
            images_root: recording.images_root.clone(),
            worst_rotation_deviation: recording.worst_rotation_deviation,
            camera: self
                .camera
                .map(CameraOption::pinhole)
                .transpose()?
                .or(stated.camera),
        };

        // The name given wins, then the bundle's own, then one derived from the path.
        let name = match &self.name {
            Some(name) => name.clone(),
            None if !stated.name.is_empty() => stated.name.clone(),
            None => name_from(format, path).context("--name NAME is required")?,
        };
        let id = RoomId::new(&name).context("give another name with --name")?;
        Ok(Room::new(id, frames, provenance)?)
    }

    /// Prints what was read.
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
            "rotations: at most {deviation:.1e} off SO(3), projected"
        ));

        for set in features {
            say(format_args!(
                "features '{}': {} columns",
                set.source().name,
                set.source().dim
            ));
        }

        say_dropped(&recording.dropped);
    }

    /// Reads the feature files that options name. They have one row per usable frame, and are checked
    /// against that count before --every thins both.
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

    async fn publish(
        &self,
        format: &str,
        path: &Path,
        mut recording: Recording,
        direction: DirectionName,
    ) -> anyhow::Result<()> {
        self.json.begin()?;
        let read_count = recording.frames.poses.len();

        self.read_features(&mut recording)?;

        // Frames and features keep the same rows; counting starts anew in each sequence.
        let kept = recording.every(self.every as usize);
        let features = recording
            .features
            .iter()
            .map(|set| set.select(&kept))
            .collect::<Vec<_>>();

        // The images are compared with the poses as they are stated, so that a mistake can be named
        // by the options that mend it.
        let mut frames = recording.frames.select(&kept);
        let read_as = self.read_as.convention(direction);
        let stated = self.read_as.scaled(&frames.poses);
        let read = stated.iter().map(|pose| read_as.to_world_from_camera(pose));
        frames.poses = read.collect();
        let room = self.room(format, path, &recording, frames)?;

        // The last checks come before the first write: a refused import leaves the store as it
        // was.
        check_features(&room, &features)?;
        let store = Store::create(&self.store)?;
        let room = self.check_same(&store, room).await?;

        self.say_read(&room, &features, &recording, read_count);
        let mut report = PoseReport::of_path(&room);
        if !self.skip_pose_check && !room.images().is_empty() {
            report.look_at_images(&room, Path::new(&recording.images_root), &stated, read_as);
        }
        report.say();
        if format == "colmap" && self.read_as.has_no_scale() {
            eprintln!(
                "warning: COLMAP's unit of length is arbitrary, and everything here is in metres: give --scale \
                 FACTOR, or --scale 1 if the model was aligned with known positions"
            );
        }

        if self.strict && report.is_wrong() {
            bail!(
                "the poses of room '{}' are wrong, see the warnings; nothing was published (--strict)",
                room.id()
            );
        }
        let published = match self.replace {
            true => store.publish_room(&room, &features).await?,
            false => store.publish_same_frames(&room, &features).await?,
        };

        // Publishing the same content again makes no new revision, so an import can safely be
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

        let mut record = report.json(&room);
        record["revision"] = json!(published.revision);
        record["created"] = json!(published.is_new);
        record["dropped"] = json!(recording.dropped.len());
        self.json.write(&record)
    }
}

/// A room's name from its path. Folder names of 12-Scenes rooms and 7-Scenes sequences repeat, so
/// the name of the parent folder is put before them.
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

/// Prints the facts about the frames that limit their use: sequences, the recording's own split,
/// gaps in the numbering, and images.
fn say_frames(room: &Room) {
    let timeline = room.timeline();
    if let Some(most) = timeline.sequences.iter().max() {
        say(format_args!(
            "sequences: up to number {most}; a pair of frames never spans two of them"
        ));
    }

    let held_out = timeline
        .held_out
        .iter()
        .filter(|held_out| **held_out)
        .count();

    if !timeline.held_out.is_empty() {
        let train = room.frame_count() - held_out;
        say(format_args!(
            "the recording's own split (--split dataset): {train} training, {held_out} test frames"
        ));
    }

    // Where the recording skipped frames, a stride of k rows spans more time than elsewhere.
    let gaps = room
        .frame_numbers()
        .windows(2)
        .filter(|pair| pair[1] > pair[0] + 1)
        .count();

    if gaps > 0 {
        say(format_args!(
            "frame numbers have {gaps} gaps: a stride counts frames of the room, not of the recording"
        ));
    }

    let root = &room.provenance().images_root;
    if !room.images().is_empty() {
        say(format_args!("images: {} below {root}", room.images().len()));
    }
}

fn say_dropped(dropped: &[Dropped]) {
    for frame in dropped.iter().take(NAMED) {
        say(format_args!("dropped {}: {}", frame.name, frame.reason));
    }

    // A long list is cut after the first NAMED frames; the counts by reason cover all of them.
    let mut counts = BTreeMap::new();
    for frame in dropped {
        *counts.entry(frame.reason).or_insert(0) += 1;
    }

    if !dropped.is_empty() {
        let counts: Vec<String> = counts
            .iter()
            .map(|(reason, count)| format!("{count} {reason}"))
            .collect();
        say(format_args!(
            "dropped {} frames in all: {}",
            dropped.len(),
            counts.join(", ")
        ));
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
/// A room with the camera that an earlier import stated, if this one states none.
fn with_known_camera(room: Room, before: &Room) -> Result<Room, seese3_core::room::Error> {
    let stated = room.provenance().camera;
    let provenance = Provenance {
        camera: stated.or(before.provenance().camera),
        ..room.provenance().clone()
    };

    Room::new(room.id().clone(), room.frames().clone(), provenance)
}

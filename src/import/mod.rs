//! `seese3 import`: reads a recording from disk and publishes it as a room in a store.
//!
//! | file | what |
//! | --- | --- |
//! | here | the formats and their options |
//! | `adapter` | adapters that another program trained |
//! | `bag`, `numpy` | formats with more options |
//! | `destination` | options and steps that all formats share |
//! | `frame_summary` | the printed summary of the frames |

#[cfg_attr(not(feature = "bags"), path = "bag_not_built.rs")]
mod bag;
mod adapter;
mod destination;
mod numpy;
mod frame_summary;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};

use super::pose_options::DirectionOption;
use bag::BagPath;
use destination::Destination;
use numpy::Numpy;
use seese3_data::datasets::{self, ImageTimes, Kitti, Reader, Recording, SevenScenes};

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
    /// Your own folder: images/, and poses.npy (n, 4, 4) or (n, 3, 4) in the order of the image
    /// names
    Folder(Plain),
    /// COLMAP: a model (cameras and images, .bin or .txt), or a project's folder with sparse/0
    Colmap(Colmap),
    /// NeRF, instant-ngp and nerfstudio: a transforms.json, or its folder
    Transforms(Plain),
    /// KITTI odometry: a file of poses, with the folder of its images
    Kitti(KittiFiles),
    /// EuRoC MAV: a sequence's folder (mav0/cam0, mav0/state_groundtruth_estimate0)
    Euroc(Euroc),
    /// ROS 2 bag (.mcap, .db3) or Foxglove recording, with images and poses or /tf
    Bag(BagPath),
    /// NumPy files: poses (n, 4, 4) or (n, 3, 4), world_from_camera in meters; features (n, d)
    Numpy(Numpy),
    /// A folder that `seese3 export numpy` wrote
    Bundle(Plain),
    /// Not a room: an adapter that another program trained, for instance PyTorch
    Adapter(adapter::ImportAdapter),
}

#[derive(Debug, Args)]
struct Plain {
    /// The folder or file to read
    path: PathBuf,
    #[command(flatten)]
    room: NewRoom,
}

#[derive(Debug, Args)]
struct Seven {
    /// The scene's folder, or one sequence's
    path: PathBuf,
    /// One sequence, for instance seq-01; if omitted, all sequences of the scene make one room
    #[arg(long)]
    sequence: Option<String>,
    /// A text file with a 4x4 matrix, rgb_from_depth in meters: converts poses of the depth camera
    /// to those of the color camera
    #[arg(long, value_name = "FILE")]
    rgb_from_depth: Option<PathBuf>,
    #[command(flatten)]
    room: NewRoom,
}

#[derive(Debug, Args)]
struct Colmap {
    /// The model's folder, or the project's
    path: PathBuf,
    /// Folder that the image names are relative to; searched next to the model if omitted
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Images per second of the video: the last number in the name of an image is its place in it.
    /// A room without times counts as one of 30 images per second
    #[arg(long, value_name = "HZ", value_parser = above_zero)]
    rate: Option<f64>,
    /// Times of the images: a file with the lines SECONDS NAME
    #[arg(long, value_name = "FILE", conflicts_with = "rate")]
    times: Option<PathBuf>,
    #[command(flatten)]
    room: NewRoom,
}

#[derive(Debug, Args)]
struct KittiFiles {
    /// Pose file, twelve numbers per line
    path: PathBuf,
    /// Folder of the images, in the order of their numbers, for example sequences/00/image_2
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// File of timestamps, seconds, one per line, for example sequences/00/times.txt
    #[arg(long, value_name = "FILE")]
    times: Option<PathBuf>,
    #[command(flatten)]
    room: NewRoom,
}

#[derive(Debug, Args)]
struct Euroc {
    /// The sequence's folder
    path: PathBuf,
    /// Name of the camera
    #[arg(long = "device", value_name = "NAME", default_value = "cam0")]
    device: String,
    #[command(flatten)]
    room: NewRoom,
}

fn above_zero(text: &str) -> Result<f64, String> {
    let number: Option<f64> = text.parse().ok();
    let is_valid = |number: &f64| number.is_finite() && *number > 0.0;
    number
        .filter(is_valid)
        .ok_or_else(|| "must be a number above 0".to_owned())
}

/// How the poses are read, and where the room is published.
#[derive(Debug, Args)]
struct NewRoom {
    #[command(flatten)]
    poses: DirectionOption,
    #[command(flatten)]
    to: Destination,
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
            Format::SevenScenes(seven) => {
                let choice = SevenScenes {
                    sequence: seven.sequence,
                    rgb_from_depth: seven.rgb_from_depth,
                };
                seven
                    .room
                    .import("7scenes", &seven.path, |path, reader| {
                        datasets::read_seven_scenes(path, &choice, reader)
                    })
                    .await
            }
            Format::Folder(plain) => {
                plain
                    .import("folder", |path, _| datasets::read_folder(path))
                    .await
            }
            Format::Colmap(colmap) => colmap.import().await,
            Format::Transforms(plain) => {
                plain.import("transforms", datasets::read_transforms).await
            }
            Format::Kitti(kitti) => {
                let beside = Kitti {
                    images: kitti.images,
                    times: kitti.times,
                };
                kitti
                    .room
                    .import("kitti", &kitti.path, |path, reader| {
                        datasets::read_kitti(path, &beside, reader)
                    })
                    .await
            }
            Format::Euroc(euroc) => {
                euroc
                    .room
                    .import("euroc", &euroc.path, |path, reader| {
                        datasets::read_euroc(path, &euroc.device, reader)
                    })
                    .await
            }
            Format::Bag(bag) => bag.import().await,
            Format::Numpy(numpy) => numpy.import().await,
            Format::Adapter(adapter) => adapter.run().await,
            Format::Bundle(plain) => {
                plain
                    .import("bundle", |path, _| datasets::read_bundle(path))
                    .await
            }
        }
    }
}

/// A `.sens` file holds a whole scan; a folder holds an unpacked scan.
fn scannet(path: &Path, reader: &mut Reader<'_>) -> Result<Recording, datasets::Error> {
    if path.is_file() {
        datasets::read_sens(path, reader)
    } else {
        datasets::read_scannet(path, reader)
    }
}

impl Colmap {
    async fn import(self) -> anyhow::Result<()> {
        let times = match (self.rate, self.times) {
            (Some(hertz), _) => ImageTimes::Rate(hertz),
            (None, Some(file)) => ImageTimes::File(file),
            (None, None) => ImageTimes::Unknown,
        };
        let images = self.images.as_deref();
        self.room
            .import("colmap", &self.path, |path, reader| {
                datasets::read_colmap(path, images, &times, reader)
            })
            .await
    }
}

impl Plain {
    async fn import(
        self,
        format: &str,
        read: impl FnOnce(&Path, &mut Reader<'_>) -> Result<Recording, datasets::Error>,
    ) -> anyhow::Result<()> {
        self.room.import(format, &self.path, read).await
    }
}

impl NewRoom {
    /// Reads a recording of one format and publishes it.
    async fn import(
        &self,
        format: &str,
        path: &Path,
        read: impl FnOnce(&Path, &mut Reader<'_>) -> Result<Recording, datasets::Error>,
    ) -> anyhow::Result<()> {
        let recording = self.to.read(|reader| read(path, reader))?;
        self.to
            .publish(format, path, recording, self.poses.direction)
            .await
    }
}

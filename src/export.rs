//! `seese3 export`: writes a stored room in a format that other programs read.

use std::path::PathBuf;

use anyhow::bail;
use clap::{Args, Subcommand};
use ndarray::{Array1, Array2};
use serde_json::json;

use super::output::{begin_output, check_folder, say, write_file};
use super::store_option::StoreAndJson;
use seese3_data::datasets::{BundleContents, KeypointArrays, write_numpy};
use seese3_data::export::{kitti_trajectory, tum_trajectory};
use seese3_robot::matched_views::{COMPRESSED, KeypointMap, MappedKeypoints};
use seese3_store::StoredRoom;

#[derive(Debug, Args)]
pub struct Export {
    #[command(subcommand)]
    format: Format,
}

#[derive(Debug, Subcommand)]
enum Format {
    /// A folder with poses.npy, timestamps.npy, frame_ids.npy, features_NAME.npy, bundle.json and,
    /// if the room has keypoints, keypoint_*.npy
    Numpy(From),
    /// A TUM trajectory file, "timestamp tx ty tz qx qy qz qw" per line: seconds, meters,
    /// world_from_camera
    Tum(Timed),
    /// A KITTI trajectory file: the first three rows of world_from_camera per line, meters
    Kitti(From),
}

#[derive(Debug, Args)]
struct From {
    #[command(flatten)]
    common: StoreAndJson,
    /// Name of the room
    #[arg(long)]
    room: String,
    /// Revision of the room; the newest if omitted
    #[arg(long)]
    revision: Option<u64>,
    /// Output path: a folder for numpy, a file for the other formats
    #[arg(long)]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Timed {
    #[command(flatten)]
    from: From,
    /// Frames per second, 0.001 to 1000000: creates timestamps, starting at 0, for a room without
    /// any
    #[arg(long)]
    rate: Option<f64>,
}

impl Export {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.format {
            Format::Numpy(from) => {
                let stored = from.load().await?;
                let keypoints = stored.keypoints.as_ref();
                let keypoints = keypoints
                    .map(|keypoints| keypoint_arrays(&keypoints.map))
                    .transpose()?;
                let contents = BundleContents {
                    room: &stored.room,
                    features: &stored.features,
                    keypoints: keypoints.as_ref(),
                };
                let files = write_numpy(&from.out, contents)?;
                for file in &files {
                    say(format_args!("wrote {}", file.display()));
                }
                from.common.json.write(&json!({ "files": files }))
            }
            Format::Tum(Timed { from, rate }) => {
                let stored = from.load().await?;

                // The format needs one timestamp per pose. Recorded timestamps are never
                // overridden; a room without any gets evenly spaced ones.
                let times = match (stored.room.timestamps_ns(), rate) {
                    ([], Some(rate)) if (1e-3..=1e6).contains(&rate) => {
                        (0..stored.room.frame_count())
                            .map(|row| (row as f64 / rate * 1e9).round() as i64)
                            .collect()
                    }
                    ([], Some(rate)) => {
                        bail!("--rate must be 0.001 to 1,000,000 frames a second, got {rate}")
                    }
                    ([], None) => bail!(
                        "room '{}' has no timestamps, which the format needs; give --rate FRAMES_A_SECOND, \
                         or export kitti",
                        from.room
                    ),
                    (times, None) => times.to_vec(),
                    (_, Some(_)) => bail!(
                        "room '{}' already has timestamps; leave out --rate",
                        from.room
                    ),
                };

                from.write(&tum_trajectory(&times, stored.room.poses()))
            }
            Format::Kitti(from) => {
                let stored = from.load().await?;
                from.write(&kitti_trajectory(stored.room.poses()))
            }
        }
    }
}

impl From {
    async fn load(&self) -> anyhow::Result<StoredRoom> {
        check_folder(&self.out)?;
        let store = self.common.open()?;
        Ok(store.load_room(&self.room, self.revision).await?)
    }

    fn write(&self, text: &str) -> anyhow::Result<()> {
        begin_output(&self.out)?;
        write_file(&self.out, text.as_bytes())?;
        say(format_args!("wrote {}", self.out.display()));
        self.common.json.write(&json!({ "files": [&self.out] }))
    }
}

/// The keypoints of all frames, frame after frame.
fn keypoint_arrays(map: &KeypointMap) -> anyhow::Result<KeypointArrays> {
    let frames = || map.frames.iter();
    let count = frames().map(MappedKeypoints::len).sum();
    let points = frames().flat_map(|frame| &frame.points);
    let positions = points.flat_map(|point| [point.x, point.y]).collect();
    let descriptors = frames().flat_map(|frame| &frame.descriptors).copied();

    Ok(KeypointArrays {
        counts: frames().map(|frame| frame.len() as i64).collect(),
        positions: Array2::from_shape_vec((count, 2), positions)?,
        inverse_depths: column(frames().map(|frame| &frame.inverse_depths)),
        deviations: column(frames().map(|frame| &frame.deviations)),
        descriptors: Array2::from_shape_vec((count, COMPRESSED), descriptors.collect())?,
        basis_mean: map.basis.mean().clone(),
        basis_axes: map.basis.axes().clone(),
    })
}

/// The numbers of all frames, frame after frame.
fn column<'a>(frames: impl Iterator<Item = &'a Vec<f32>>) -> Array1<f32> {
    frames.flatten().copied().collect()
}

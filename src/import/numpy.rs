//! `seese3 import numpy`: poses, times and features in NumPy files.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;

use super::destination::Destination;
use crate::pose_options::DirectionName;
use seese3_data::datasets;

#[derive(Debug, Args)]
pub struct Numpy {
    /// A folder with poses.npy and, optionally, timestamps.npy, frame_ids.npy, sequences.npy and
    /// features_NAME.npy
    #[arg(required_unless_present = "poses", conflicts_with = "timestamps")]
    path: Option<PathBuf>,
    /// Either the transform that the poses represent, world_from_camera or camera_from_world, or,
    /// instead of a folder, the NumPy file of poses, shape (n, 4, 4), f64 or f32; may be given once
    /// for each
    #[arg(long, value_name = "TRANSFORM|FILE", action = clap::ArgAction::Append)]
    poses: Vec<PosesOption>,
    /// NumPy file of timestamps, shape (n,), int64 nanoseconds or float seconds; only with --poses
    #[arg(long)]
    timestamps: Option<PathBuf>,
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

impl Numpy {
    pub async fn import(self) -> anyhow::Result<()> {
        self.to.begin()?;
        let mut file = None;
        let mut direction = None;
        for given in self.poses {
            match given {
                PosesOption::Direction(given) if direction.is_none() => direction = Some(given),
                PosesOption::Direction(_) => {
                    bail!("--poses: the transform was given twice")
                }
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
                "--poses: {} is neither world_from_camera nor camera_from_world; as a pose file, it \
                 would replace the folder {}: give only one of them",
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

        // Without a folder, the room has no default name.
        if self.path.is_none() && self.to.name.is_none() {
            bail!("--name NAME is required");
        }

        let path = self.path.as_deref().unwrap_or(Path::new(""));
        self.to
            .publish("numpy", path, recording, direction.unwrap_or_default())
            .await
    }
}

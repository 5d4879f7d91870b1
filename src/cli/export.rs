//! `seese3 export`: a stored room for other programs.

use std::path::PathBuf;

use anyhow::bail;
use clap::{Args, Subcommand};

use super::{check_writable, say, write_file};
use crate::datasets::write_numpy;
use crate::report::{kitti_trajectory, tum_trajectory};
use crate::store::{Store, StoredRoom};

#[derive(Debug, Args)]
pub struct Export {
    #[command(subcommand)]
    format: Format,
}

#[derive(Debug, Subcommand)]
enum Format {
    /// A folder of poses.npy, timestamps.npy, frame_ids.npy, features_NAME.npy and bundle.json
    Numpy(From),
    /// A trajectory file, "timestamp tx ty tz qx qy qz qw"
    Tum(Timed),
    /// A trajectory file of 3x4 matrices
    Kitti(From),
}

#[derive(Debug, Args)]
struct From {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// Which revision; the newest if none is given
    #[arg(long)]
    revision: Option<u64>,
    /// Where to write: a folder for numpy, a file for the others
    #[arg(long)]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Timed {
    #[command(flatten)]
    from: From,
    /// Frames a second, for a room without timestamps
    #[arg(long)]
    rate: Option<f64>,
}

impl Export {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.format {
            Format::Numpy(from) => {
                let stored = from.load().await?;
                for file in write_numpy(&from.out, &stored.room, &stored.features)? {
                    say(format_args!("wrote {}", file.display()));
                }

                Ok(())
            }
            Format::Tum(Timed { from, rate }) => {
                let stored = from.load().await?;
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
                        "room '{}' has timestamps of its own; leave out --rate",
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
        check_writable(&self.out)?;
        Ok(Store::open(&self.store)?
            .load_room(&self.room, self.revision)
            .await?)
    }

    fn write(&self, text: &str) -> anyhow::Result<()> {
        write_file(&self.out, text.as_bytes())?;
        say(format_args!("wrote {}", self.out.display()));
        Ok(())
    }
}

//! `seese3 evaluate trajectory`: APE and RPE of one file against another, as evo takes them.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;

use super::super::{check_writable, say, write_json};
use crate::datasets::read_tum_trajectory;
use crate::report::{PathErrors, PathProtocol, path_errors_json, path_errors_table};
use crate::trajectory::{RpePairs, associate};

#[derive(Debug, Args)]
pub struct Trajectory {
    /// The true path, a TUM file: "timestamp tx ty tz qx qy qz qw" a line, world_from_camera
    #[arg(long)]
    reference: PathBuf,
    /// The estimated path, a TUM file
    #[arg(long)]
    estimate: PathBuf,
    /// The farthest apart in time that two poses belong together, milliseconds
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    max_difference_ms: u64,
    #[command(flatten)]
    relative: RelativeOptions,
    /// Write the errors here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Which relative errors are taken.
#[derive(Debug, Clone, Args)]
pub struct RelativeOptions {
    /// Poses over which RPE is taken
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    delta: u32,
    /// Take every pair that far apart, not one after the other
    #[arg(long)]
    all_pairs: bool,
}

impl RelativeOptions {
    pub fn protocol(&self) -> PathProtocol {
        let pairs = if self.all_pairs {
            RpePairs::All
        } else {
            RpePairs::Consecutive
        };
        PathProtocol {
            delta: self.delta as usize,
            pairs,
        }
    }
}

impl Trajectory {
    pub fn run(self) -> anyhow::Result<()> {
        if let Some(path) = &self.json {
            check_writable(path)?;
        }

        let reference = read_tum_trajectory(&self.reference)?;
        let estimate = read_tum_trajectory(&self.estimate)?;
        for (path, file) in [(&reference, &self.reference), (&estimate, &self.estimate)] {
            if path.is_empty() {
                bail!("{} has no poses", file.display());
            }
        }

        let files = || {
            format!(
                "{} and {}",
                self.reference.display(),
                self.estimate.display()
            )
        };

        let matches = associate(&reference, &estimate, self.max_difference_ms * 1_000_000)
            .with_context(files)?;
        let errors = PathErrors::of(&reference, &estimate, &matches, self.relative.protocol())
            .with_context(files)?;
        say(format_args!(
            "{} poses belong together; {} of the reference's and {} of the estimate's to none",
            errors.matched, errors.unmatched_reference, errors.unmatched_estimate
        ));

        say(path_errors_table(&errors).trim_end());
        if let Some(path) = &self.json {
            write_json(path, &path_errors_json(&errors))?;
            say(format_args!("wrote {}", path.display()));
        }

        Ok(())
    }
}

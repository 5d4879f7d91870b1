//! `seese3 evaluate trajectory`: APE and RPE of one file against another, as evo defines them.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;

use super::super::output::{JsonOutput, say};
use crate::table_files::TableFiles;
use seese3_core::trajectory::{RpePairs, associate};
use seese3_data::datasets::read_tum_trajectory;
use seese3_lab::experiments::path_comparison::{PathComparison, PathProtocol};
use seese3_lab::report::{path_errors_json, path_errors_table};

#[derive(Debug, Args)]
pub struct EvaluateTrajectory {
    /// Ground-truth path, a TUM file with lines "timestamp tx ty tz qx qy qz qw", world_from_camera
    #[arg(long)]
    reference: PathBuf,
    /// Estimated path, a TUM file
    #[arg(long)]
    estimate: PathBuf,
    /// Largest time difference at which two poses are matched, milliseconds, 0 to 1000000
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    max_difference_ms: u64,
    #[command(flatten)]
    relative: RelativeOptions,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

/// Pose pairs of the relative pose error.
#[derive(Debug, Clone, Args)]
pub struct RelativeOptions {
    /// RPE: number of poses from the first to the second of a pair; at least 1
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    delta: u32,
    /// RPE: use all pairs at this distance, including overlapping ones, instead of consecutive
    /// pairs
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

impl EvaluateTrajectory {
    pub fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;

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

        // Poses are matched by time: the two files need neither the same rate nor the same length.
        let matches = associate(&reference, &estimate, self.max_difference_ms * 1_000_000)
            .with_context(files)?;
        let errors = PathComparison::of(&reference, &estimate, &matches, self.relative.protocol())
            .with_context(files)?;
        say(format_args!(
            "{} poses matched; {} of the reference and {} of the estimate have no match",
            errors.matched, errors.unmatched_reference, errors.unmatched_estimate
        ));

        let title = format!("{} poses", errors.matched);
        let (table, notes) = path_errors_table(&errors);
        self.files.say(&table, &title)?;
        say(notes);
        self.json.write(&path_errors_json(&errors))?;

        Ok(())
    }
}

//! `seese3 theory`: the paper's theorems, measured.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use super::progress::bar;
use super::{check_writable, say, write_json};
use crate::report::{theory_json, theory_table};
use crate::theory::{Effort, checks};

#[derive(Debug, Args)]
pub struct Theory {
    /// Of everything that is drawn at random
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Poses of an intrinsic dimension
    #[arg(long, default_value_t = 1_024, value_parser = clap::value_parser!(u32).range(64..=100_000))]
    poses: u32,
    /// Pairs of poses and directions of the other checks
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(8..=100_000))]
    samples: u32,
    /// Write all of it here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Theory {
    pub fn run(self) -> anyhow::Result<()> {
        if let Some(file) = &self.json {
            check_writable(file)?;
        }

        let effort = Effort {
            seed: self.seed,
            poses: self.poses as usize,
            samples: self.samples as usize,
        };

        let progress = bar(4, "theory");
        let found = checks(effort, &mut |part| {
            progress.set_message(part);
            progress.inc(1);
        })?;

        progress.finish_and_clear();
        say(theory_table(&found).trim_end());
        if let Some(file) = &self.json {
            write_json(file, &theory_json(&found))?;
            say(format_args!("wrote {}", file.display()));
        }

        let broken = found.iter().filter(|check| !check.holds()).count();
        if broken > 0 {
            bail!("{broken} of {} bounds are not kept", found.len());
        }

        Ok(())
    }
}

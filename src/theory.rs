//! `seese3 theory`: numerical checks of the paper's theorems.

use anyhow::bail;
use clap::Args;

use super::output::JsonOutput;
use super::progress::bar;
use crate::table_files::TableFiles;
use seese3_lab::report::{theory_json, theory_plot, theory_table};
use seese3_lab::theory::{Effort, checks};

#[derive(Debug, Args)]
pub struct Theory {
    /// Seed of all random samples
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Number of poses for the intrinsic dimension, 64 to 100000
    #[arg(long, default_value_t = 1_024, value_parser = clap::value_parser!(u32).range(64..=100_000))]
    poses: u32,
    /// Number of sampled pose pairs and directions in the other checks, 8 to 100000
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(8..=100_000))]
    samples: u32,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl Theory {
    pub fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;

        let effort = Effort {
            seed: self.seed,
            poses: self.poses as usize,
            samples: self.samples as usize,
        };

        // One tick per group of checks: intrinsic dimension, decodability, bracket and flow.
        let progress = bar(4, "theory");
        let found = checks(effort, &mut |part| {
            progress.set_message(part);
            progress.inc(1);
        })?;

        progress.finish_and_clear();
        self.files.say_and_draw(
            &theory_table(&found),
            &theory_plot(&found),
            "theory: measured values within their bounds",
        )?;
        self.json.write(&theory_json(&found))?;

        // The table and the file show every check; the exit status reports whether all bounds hold.
        let broken = found.iter().filter(|check| !check.holds()).count();
        if broken > 0 {
            bail!("{broken} of {} bounds are violated", found.len());
        }

        Ok(())
    }
}

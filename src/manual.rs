//! `seese3 completions` and `seese3 man`: shell completions and manual pages, generated from the
//! command line definition.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, CommandFactory};
use clap_complete::Shell;

use super::Cli;
use super::examples::with_examples;
use super::help::with_comma_lists;
use super::output::say;

#[derive(Debug, Args)]
pub struct Completions {
    /// The shell
    shell: Shell,
}

impl Completions {
    pub fn run(self) -> anyhow::Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Cli::command(), "seese3", &mut script);
        say(String::from_utf8(script)?.trim_end());
        Ok(())
    }
}

#[derive(Debug, Args)]
pub struct Man {
    /// Output folder for the pages; created if it does not exist
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Man {
    pub fn run(self) -> anyhow::Result<()> {
        let failed = || format!("{} cannot be written", self.out.display());
        std::fs::create_dir_all(&self.out).with_context(failed)?;

        let command = with_examples(with_comma_lists(Cli::command())).disable_help_subcommand(true);
        clap_mangen::generate_to(command, &self.out).with_context(failed)?;

        let count = std::fs::read_dir(&self.out).with_context(failed)?.count();
        say(format_args!(
            "wrote {count} pages to {}",
            self.out.display()
        ));
        Ok(())
    }
}

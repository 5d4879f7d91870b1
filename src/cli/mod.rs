//! The command line. One file a command; each reads its arguments, calls the library and prints.

mod ask;
mod cross_room;
mod demo;
mod encode;
mod encoder;
mod encoders;
mod evaluate;
mod export;
mod health;
mod import;
mod probe;
mod progress;
mod protocol;
mod reproduce;
mod rooms;
mod serve;
mod studio;
mod sweep;
mod theory;
mod track;
mod train;

use clap::{Parser, Subcommand};

/// Latent navigation over gRPC: learn a room, serve it, navigate it.
#[derive(Debug, Parser)]
#[command(version, about, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// See the whole idea work: a room is drawn, learned, served and navigated
    Demo(demo::Demo),
    /// Read a recording into a store
    Import(import::Import),
    /// Give a stored room to other programs
    Export(export::Export),
    /// Turn a room's images into features
    Encode(encode::Encode),
    /// List the encoders that are known, with their preprocessing
    Encoders(encoders::Encoders),
    /// Draw a suite of rooms and encode it
    Studio(studio::Studio),
    /// Learn an adapter from a room's features and publish it
    Train(train::Train),
    /// Score navigators on held-out motions: Hit@ε with baselines and intervals
    Evaluate(evaluate::Evaluate),
    /// Measure how much of SE(3) features hold: M1 to M4
    Probe(probe::Probe),
    /// Learn from some rooms, navigate in others: zero-shot, against Identity, by how many rooms
    /// were learned from
    CrossRoom(cross_room::CrossRoom),
    /// Score many features at once
    Sweep(sweep::Sweep),
    /// Run the paper's tables and figures on given rooms and write one report
    Reproduce(reproduce::Reproduce),
    /// Check the paper's theorems numerically: measured against bound
    Theory(theory::Theory),
    /// Answer over gRPC until told to stop
    Serve(serve::Serve),
    /// Ask a server for the frames that a motion leads to
    Navigate(ask::Navigate),
    /// Ask a server where a view was seen
    Localize(ask::Localize),
    /// Ask a server for the motion between two views
    Motion(ask::Motion),
    /// Have a server follow a camera whose features are in a file
    Track(track::Track),
    /// List what a server answers for
    Catalog(ask::Catalog),
    /// Succeed if a server serves, for containers and supervisors
    Health(health::Health),
}

/// Runs a command; what it finds goes to standard output, what goes wrong into the error.
///
/// # Errors
/// What went wrong, in one line, with what to change.
pub async fn run(cli: Cli) -> anyhow::Result<()> {
    match cli.command {
        Command::Import(arguments) => arguments.run().await,
        Command::Export(arguments) => arguments.run().await,
        Command::Encode(arguments) => arguments.run().await,
        Command::Encoders(arguments) => arguments.run(),
        Command::Studio(arguments) => arguments.run().await,
        Command::Train(arguments) => arguments.run().await,
        Command::Evaluate(arguments) => arguments.run().await,
        Command::Demo(arguments) => arguments.run().await,
        Command::Probe(arguments) => arguments.run().await,
        Command::CrossRoom(arguments) => arguments.run().await,
        Command::Sweep(arguments) => arguments.run().await,
        Command::Reproduce(arguments) => arguments.run().await,
        Command::Theory(arguments) => arguments.run(),
        Command::Serve(arguments) => arguments.run().await,
        Command::Navigate(arguments) => arguments.run().await,
        Command::Localize(arguments) => arguments.run().await,
        Command::Motion(arguments) => arguments.run().await,
        Command::Track(arguments) => arguments.run().await,
        Command::Catalog(arguments) => arguments.run().await,
        Command::Health(arguments) => arguments.run().await,
    }
}

/// Prints a line to standard output; a reader that went away is no error of ours.
fn say(line: impl std::fmt::Display) {
    use std::io::Write;
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Refuses a file whose folder is not there, before long work is done for it.
fn check_writable(path: &std::path::Path) -> anyhow::Result<()> {
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    if path.is_dir() {
        anyhow::bail!("{} is a folder; name a file in it", path.display());
    }

    match folder {
        Some(folder) if !folder.is_dir() => {
            anyhow::bail!("{}: the folder does not exist", path.display())
        }
        _ => Ok(()),
    }
}

/// Writes a file whole or not at all.
fn write_file(path: &std::path::Path, content: &[u8]) -> anyhow::Result<()> {
    use anyhow::Context;

    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let partial = std::path::PathBuf::from(partial);
    std::fs::write(&partial, content)
        .with_context(|| format!("{} cannot be written", path.display()))?;

    std::fs::rename(&partial, path).with_context(|| format!("{} cannot be written", path.display()))
}

/// Writes JSON, indented, with a line end.
fn write_json(path: &std::path::Path, value: &serde_json::Value) -> anyhow::Result<()> {
    write_file(path, format!("{value:#}\n").as_bytes())
}

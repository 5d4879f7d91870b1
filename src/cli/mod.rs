//! The command line: one file per command. Each reads its arguments, calls the library and prints
//! the results.

mod ask;
mod camera;
mod check;
mod config;
#[cfg(feature = "lab")]
mod cross_room;
#[cfg(feature = "lab")]
mod demo;
mod encode;
mod encoder;
mod encoders;
#[cfg(feature = "lab")]
mod evaluate;
mod export;
mod fit;
mod health;
mod import;
mod log;
mod named;
#[cfg(feature = "lab")]
mod probe;
mod pose_options;
mod pose_report;
mod progress;
mod push;
#[cfg(feature = "lab")]
mod protocol;
#[cfg(feature = "lab")]
mod reproduce;
#[cfg(feature = "lab")]
mod rooms;
mod serve;
mod store;
#[cfg(feature = "lab")]
mod studio;
#[cfg(feature = "lab")]
mod sweep;
#[cfg(feature = "lab")]
mod theory;
mod track;
#[cfg(feature = "lab")]
mod train;

pub use config::parse;

use clap::{Parser, Subcommand};

/// Latent navigation over gRPC: train on a room's images, serve the room, navigate in it
#[derive(Debug, Parser)]
#[command(version, about, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[cfg(feature = "lab")]
    /// Show the whole pipeline on a synthetic room: render, train, serve and navigate
    Demo(demo::Demo),
    /// Read a recording from disk and publish it as a room in a store
    Import(import::Import),
    /// Check a stored room: what its camera did, and whether its poses can be those of its images
    Check(check::Check),
    /// Write a stored room in a format that other programs read
    Export(export::Export),
    /// Encode a room's images as features
    Encode(encode::Encode),
    /// List the known encoder recipes, with their preprocessing and layers
    Encoders(encoders::Encoders),
    #[cfg(feature = "lab")]
    /// Render a suite of synthetic rooms and encode their images
    Studio(studio::Studio),
    #[cfg(feature = "lab")]
    /// Train an adapter on the features of one or more rooms and publish it
    Train(train::Train),
    /// Fit an adapter to one room, measure how far it may be believed there, and publish it
    Fit(fit::Fit),
    #[cfg(feature = "lab")]
    /// Score navigators on held-out motions: Hit@ε with baselines and intervals
    Evaluate(evaluate::Evaluate),
    #[cfg(feature = "lab")]
    /// Measure how much SE(3) structure features carry: M1 mutual k-NN, M2 intrinsic dimension, M3
    /// ridge probe, M4 trained adapter
    Probe(probe::Probe),
    #[cfg(feature = "lab")]
    /// Train on some rooms and navigate zero-shot in others: scores against Identity, by the number
    /// of training rooms
    CrossRoom(cross_room::CrossRoom),
    #[cfg(feature = "lab")]
    /// Compare many layers, adapter configurations or formulations in one run
    Sweep(sweep::Sweep),
    #[cfg(feature = "lab")]
    /// Reproduce the paper's tables and figures on given rooms and write one report
    Reproduce(reproduce::Reproduce),
    #[cfg(feature = "lab")]
    /// Check the paper's theorems numerically: the measured value against the bound
    Theory(theory::Theory),
    /// Answer over gRPC until SIGTERM or Ctrl-C
    Serve(Box<serve::Serve>),
    /// Look after a store: list, defaults, removal, garbage, verification
    Store(store::StoreCommand),
    /// Upload a room or an adapter of a store to a server that was started with --writable
    Push(push::Push),
    /// Check or print the settings of `serve`
    Config(Box<config::Config>),
    /// Ask a server for the frames that a camera motion leads to
    Navigate(ask::Navigate),
    /// Ask a server for the frames of its rooms that look most like a view
    Localize(ask::Localize),
    /// Ask a server for the camera motion between two views
    Motion(ask::Motion),
    /// Track a camera with a server, from a file of features or a folder of images
    Track(track::Track),
    /// List the rooms and adapters of a server
    Catalog(ask::Catalog),
    /// Exit successfully if a server is serving, for containers and supervisors
    Health(health::Health),
}

impl Cli {
    fn remember(&mut self, matches: &clap::ArgMatches) {
        if let Command::Config(config) = &mut self.command {
            config.remember(matches);
        }
    }
}

/// Runs a command. Results go to standard output; a failure is returned as the error.
///
/// # Errors
/// When the command fails: one line that says what went wrong and what to change.
pub async fn run(cli: Cli) -> anyhow::Result<()> {
    match cli.command {
        Command::Import(arguments) => arguments.run().await,
        Command::Check(arguments) => arguments.run().await,
        Command::Export(arguments) => arguments.run().await,
        Command::Encode(arguments) => arguments.run().await,
        Command::Fit(arguments) => arguments.run().await,
        Command::Encoders(arguments) => arguments.run(),
        #[cfg(feature = "lab")]
        Command::Studio(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Train(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Evaluate(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Demo(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Probe(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::CrossRoom(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Sweep(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Reproduce(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Theory(arguments) => arguments.run(),
        Command::Serve(arguments) => arguments.run().await,
        Command::Store(arguments) => arguments.run().await,
        Command::Push(arguments) => arguments.run().await,
        Command::Config(arguments) => arguments.run(),
        Command::Navigate(arguments) => arguments.run().await,
        Command::Localize(arguments) => arguments.run().await,
        Command::Motion(arguments) => arguments.run().await,
        Command::Track(arguments) => arguments.run().await,
        Command::Catalog(arguments) => arguments.run().await,
        Command::Health(arguments) => arguments.run().await,
    }
}

/// Prints a line to standard output. A closed pipe (`seese3 … | head`) is not an error, so failed
/// writes are ignored.
fn say(line: impl std::fmt::Display) {
    use std::io::Write;
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Prints where an adapter was published.
fn say_published(store: &crate::store::Store, name: &str, published: &crate::store::Published) {
    let state = if published.is_new {
        "published"
    } else {
        "already there, unchanged:"
    };

    say(format_args!(
        "{state} adapter '{name}' revision {}: {}/{}",
        published.revision,
        store.location(),
        published.manifest
    ));
}

/// Rejects an output file whose folder does not exist, before any long computation is started for
/// it.
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

/// Writes a file atomically: readers see either the old file or the complete new one. What is no
/// regular file, such as a device or a pipe, is written into and never replaced.
fn write_file(path: &std::path::Path, content: &[u8]) -> anyhow::Result<()> {
    use anyhow::Context;

    let failed = || format!("{} cannot be written", path.display());

    // A symbolic link stays, and what it points to is replaced.
    let target = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    if std::fs::metadata(&target).is_ok_and(|found| !found.is_file()) {
        return std::fs::OpenOptions::new()
            .write(true)
            .open(&target)
            .and_then(|mut file| std::io::Write::write_all(&mut file, content))
            .with_context(failed);
    }

    // The content goes into a neighbouring file first: renaming within one folder replaces the
    // target in a single step.
    let mut partial = target.as_os_str().to_owned();
    partial.push(".partial");
    let partial = std::path::PathBuf::from(partial);

    let written =
        std::fs::write(&partial, content).and_then(|()| std::fs::rename(&partial, &target));
    if written.is_err() {
        // Half a file is of no use, and on a full disk it takes what space there is.
        let _ = std::fs::remove_file(&partial);
    }
    written.with_context(failed)
}

/// Writes indented JSON, with a newline at the end.
#[cfg(feature = "lab")]
fn write_json(path: &std::path::Path, record: &impl serde::Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(record)?;
    text.push('\n');

    write_file(path, text.as_bytes())
}

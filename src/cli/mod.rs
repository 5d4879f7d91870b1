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
mod examples;
#[cfg(feature = "lab")]
mod evaluate;
mod export;
mod fit;
mod health;
mod import;
mod log;
mod manual;
mod named;
mod output;
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
    /// Print nothing but warnings and errors; files that options name are written
    #[arg(short, long, global = true)]
    quiet: bool,
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
    /// Ask a server in which room a camera is, and where in it, from some of its views; and how sure
    /// that is
    Relocalize(ask::Relocalize),
    /// Ask a server for the camera motion between two views
    Motion(ask::Motion),
    /// Track a camera with a server, from a file of features or a folder of images
    Track(track::Track),
    /// List the rooms and adapters of a server
    Catalog(ask::Catalog),
    /// Exit successfully if a server is serving, for containers and supervisors
    Health(health::Health),
    /// Print the completions of a shell
    Completions(manual::Completions),
    /// Write the manual pages, one for each command
    Man(manual::Man),
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
    dispatch(cli).await?;
    output::check_printed()
}

async fn dispatch(cli: Cli) -> anyhow::Result<()> {
    if cli.quiet {
        output::silence();
    }

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
        Command::Relocalize(arguments) => arguments.run().await,
        Command::Motion(arguments) => arguments.run().await,
        Command::Track(arguments) => arguments.run().await,
        Command::Catalog(arguments) => arguments.run().await,
        Command::Health(arguments) => arguments.run().await,
        Command::Completions(arguments) => arguments.run(),
        Command::Man(arguments) => arguments.run(),
    }
}

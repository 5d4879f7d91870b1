//! The program `seese3`: the command line, one file per command. Each file reads its arguments,
//! calls the crates and prints the results.

mod camera;
mod examples;
mod help;
mod log;
mod made_by;
mod named;
mod output;
#[cfg(feature = "lab")]
mod errors_file;
#[cfg(feature = "lab")]
mod table_files;
mod encoder;
mod pose_options;
mod store_option;
mod room_names;
mod shard;
#[cfg(feature = "lab")]
mod rooms;
mod ask;
mod encoders;
mod export;
mod manual;
mod progress;
mod keypoints;
#[cfg(feature = "lab")]
mod protocol;
mod serve;
mod config;
mod encode;
mod fit;
mod health;
mod map;
mod pose_report;
#[cfg(feature = "lab")]
mod probe;
mod push;
mod pull;
#[cfg(feature = "lab")]
mod reproduce;
mod store;
#[cfg(feature = "lab")]
mod sweep;
#[cfg(feature = "lab")]
mod theory;
mod track;
#[cfg(feature = "lab")]
mod train;
mod check;
#[cfg(feature = "lab")]
mod demo;
#[cfg(feature = "lab")]
mod evaluate;
#[cfg(feature = "lab")]
mod fit_tracking;
mod import;
#[cfg(feature = "lab")]
mod studio;
#[cfg(feature = "lab")]
mod benchmark;
#[cfg(feature = "lab")]
mod card;
#[cfg(feature = "lab")]
mod cross_room;

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, Subcommand};

/// Maximum delay of the exit by blocking tasks that cannot be canceled.
const LAST_WORK: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    let cli = match config::parse() {
        Ok(cli) => cli,
        Err(error) => {
            complain(&with_causes(&error));
            return ExitCode::FAILURE;
        }
    };

    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .max_blocking_threads(seese3_server::MAX_BLOCKING_THREADS)
        .build();
    let runtime = match runtime {
        Ok(runtime) => runtime,
        Err(error) => {
            complain(&format_args!("cannot start the async runtime: {error}"));
            return ExitCode::FAILURE;
        }
    };

    let result = runtime.block_on(run(cli));

    // Dropping the runtime would wait without limit for blocking tasks that are still running.
    runtime.shutdown_timeout(LAST_WORK);

    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&with_causes(&error));
            ExitCode::FAILURE
        }
    }
}

/// The error's message, and those of its causes that it does not contain already: messages of the
/// crates end with their cause.
fn with_causes(error: &anyhow::Error) -> String {
    let mut text = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

/// Prints an error to standard error. A failed write is ignored, because `eprintln` would panic;
/// the exit code still reports the failure.
fn complain(error: &dyn std::fmt::Display) {
    let error = output::printable(&error.to_string());
    let _ = writeln!(std::io::stderr(), "error: {error}");
}

/// Latent navigation over gRPC: train on a room's images, serve the room, navigate in it
#[derive(Debug, Parser)]
#[command(version, about, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Print only warnings and errors; output files are still written
    #[arg(short, long, global = true, display_order = output::LAST_OPTION + 1)]
    quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[cfg(feature = "lab")]
    /// Show the whole pipeline on a synthetic room: render, train, serve and navigate
    Demo(demo::Demo),
    /// Read a recording from disk and publish it as a room in a store
    ///
    /// For a video or photographs without poses, `python -m seese3.mapping` of the Python package
    /// estimates the poses and imports the room.
    Import(import::Import),
    /// Check a stored room: its camera path, and whether its poses agree with its images. Fails if
    /// the poses are wrong
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
    /// Fit an adapter to one room, measure its errors by cross-validation, and publish it
    Fit(fit::Fit),
    /// Crop, move, align and merge mapped rooms
    Map(map::Map),
    #[cfg(feature = "lab")]
    /// Fit the parameters of filters that track cameras in rooms
    FitTracking(fit_tracking::FitTracking),
    #[cfg(feature = "lab")]
    /// Score navigators on held-out motions: Hit@ε with baselines and intervals
    Evaluate(evaluate::Evaluate),
    #[cfg(feature = "lab")]
    /// Measure how much SE(3) structure features carry: M1 mutual k-NN, M2 intrinsic dimension, M3
    /// ridge probe, M4 trained adapter
    Probe(probe::Probe),
    #[cfg(feature = "lab")]
    /// Train on some rooms and navigate zero-shot in others: scores against the Identity baseline,
    /// by number of training rooms
    CrossRoom(cross_room::CrossRoom),
    #[cfg(feature = "lab")]
    /// Describe recordings by statistics, to compare drawn rooms with real ones
    Card(card::Card),
    #[cfg(feature = "lab")]
    /// Freeze rooms and pairs as a benchmark, score submissions, and compare encoders in its rooms
    Benchmark(benchmark::BenchmarkCommand),
    #[cfg(feature = "lab")]
    /// Compare many layers, adapter configurations or formulations in one run
    Sweep(sweep::Sweep),
    #[cfg(feature = "lab")]
    /// Reproduce the paper's tables and figures on given rooms and write one report
    Reproduce(reproduce::Reproduce),
    #[cfg(feature = "lab")]
    /// Check the paper's theorems numerically: the measured value against the bound
    Theory(theory::Theory),
    /// Serve a store over gRPC until SIGTERM or Ctrl-C
    Serve(Box<serve::Serve>),
    /// Manage a store: list, set defaults, remove, collect garbage, verify
    Store(store::StoreCommand),
    /// Upload a room or an adapter from a store to a server that was started with --writable
    Push(push::Push),
    /// Download a room or an adapter from a server into a store
    Pull(pull::Pull),
    /// Check or print the settings of `serve`
    Config(Box<config::Config>),
    /// Ask a server for the frames that a camera motion leads to
    Navigate(ask::Navigate),
    /// Ask a server for a route of stored frames from a view to a goal
    Plan(ask::Plan),
    /// Ask a server for the camera pose of a view, and the mapped frames most similar to it
    Localize(ask::Localize),
    /// Ask a server for the room and the pose of a camera, with covariance, from one or more views
    Relocalize(ask::Relocalize),
    /// Ask a server for the camera motion between two views
    Motion(ask::Motion),
    /// Track a camera with a server, from a file of features or a folder of images
    Track(track::Track),
    /// List the rooms and adapters of a server
    Catalog(ask::Catalog),
    /// Exit with status 0 if a server is serving, for container health checks and supervisors
    Health(health::Health),
    /// Print a shell completion script
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
/// If the command fails: one line with the cause and the remedy.
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
        Command::Map(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::FitTracking(arguments) => arguments.run().await,
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
        Command::Card(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Benchmark(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Sweep(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Reproduce(arguments) => arguments.run().await,
        #[cfg(feature = "lab")]
        Command::Theory(arguments) => arguments.run(),
        Command::Serve(arguments) => arguments.run().await,
        Command::Store(arguments) => arguments.run().await,
        Command::Push(arguments) => arguments.run().await,
        Command::Pull(arguments) => arguments.run().await,
        Command::Config(arguments) => arguments.run(),
        Command::Navigate(arguments) => arguments.run().await,
        Command::Plan(arguments) => arguments.run().await,
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

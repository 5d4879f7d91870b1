//! The program: reads the command line, runs a command, says in one line what went wrong.

use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;

/// How long work that does not hear that it is over may keep the program.
const LAST_WORK: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    let cli = seese3::cli::Cli::parse();

    let runtime = match tokio::runtime::Runtime::new() {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("error: no threads can be started: {error}");
            return ExitCode::FAILURE;
        }
    };

    let result = runtime.block_on(seese3::cli::run(cli));
    runtime.shutdown_timeout(LAST_WORK);

    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

//! The program: parses the command line, runs the command, and reports an error in one line.

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

/// How long blocking work that cannot be cancelled may delay the exit.
const LAST_WORK: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    let cli = match seese3::cli::parse() {
        Ok(cli) => cli,
        Err(error) => {
            complain(&format_args!("{error:#}"));
            return ExitCode::FAILURE;
        }
    };

    let runtime = match tokio::runtime::Runtime::new() {
        Ok(runtime) => runtime,
        Err(error) => {
            complain(&format_args!("no threads can be started: {error}"));
            return ExitCode::FAILURE;
        }
    };

    let result = runtime.block_on(seese3::cli::run(cli));

    // Dropping the runtime would wait without limit for blocking tasks that are still running.
    runtime.shutdown_timeout(LAST_WORK);

    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            complain(&format_args!("{error:#}"));
            ExitCode::FAILURE
        }
    }
}

/// Prints an error. Where standard error cannot be written, the exit code alone has to tell:
/// `eprintln` would panic.
fn complain(error: &dyn std::fmt::Display) {
    let _ = writeln!(std::io::stderr(), "error: {error}");
}

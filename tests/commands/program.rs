//! The program as a test runs it.

use std::path::Path;
use std::process::{Command, Output};

/// Runs the program, with no setting of the caller's environment.
pub fn seese3(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_seese3"))
        .args(arguments)
        .env_remove("SEESE3_STORE")
        .env_remove("SEESE3_RUNTIME")
        .output()
        .unwrap()
}

/// What the program prints; it has to succeed, with nothing on standard error in a pipe.
#[track_caller]
pub fn succeeds(arguments: &[&str]) -> String {
    let output = seese3(arguments);
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {error}");
    assert_eq!(error, "", "nothing on standard error in a pipe");

    String::from_utf8(output.stdout).unwrap()
}

/// The program has to fail with one line on standard error that contains every word.
#[track_caller]
pub fn refuses(arguments: &[&str], words: &[&str]) {
    let output = seese3(arguments);
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success(), "{arguments:?}");
    assert!(
        error.starts_with("error: ") && error.trim_end().lines().count() == 1,
        "{arguments:?}: {error}"
    );

    for word in words {
        assert!(
            error.contains(word),
            "{arguments:?}: {error} does not say {word}"
        );
    }
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

//! Records the commit that the program is built from, for `made_by` in its JSON.

use std::path::Path;
use std::process::Command;

/// The commit, for builds without a repository, such as those of containers.
const VARIABLE: &str = "SEESE3_COMMIT";

fn main() {
    println!("cargo:rerun-if-env-changed={VARIABLE}");
    // The sources, because they decide whether the tree is that of the commit.
    for path in [
        "build.rs",
        "crates",
        "proto",
        "src",
        "Cargo.lock",
        ".git/HEAD",
        ".git/logs/HEAD",
    ] {
        if Path::new(path).exists() {
            println!("cargo:rerun-if-changed={path}");
        }
    }

    let stated = std::env::var(VARIABLE)
        .ok()
        .filter(|commit| !commit.is_empty());
    if let Some(commit) = stated.or_else(commit_of_repository) {
        println!("cargo:rustc-env={VARIABLE}={commit}");
    }
}

/// The commit of the repository that has this package as its root, with "-modified" if tracked
/// files differ from it. `None` without git or without a repository.
fn commit_of_repository() -> Option<String> {
    if !Path::new(".git").exists() {
        return None;
    }
    let commit = git(&["rev-parse", "HEAD"])?;
    let changes = git(&["status", "--porcelain", "--untracked-files=no"])?;
    let mark = if changes.is_empty() { "" } else { "-modified" };
    Some(format!("{commit}{mark}"))
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}

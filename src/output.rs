//! What commands print. Lines for people go to standard output, unless `--quiet` is given, or
//! `--json -` has standard output to itself.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clap::Args;
use serde::Serialize;

/// Whether lines for people are left out. It belongs to the process, as standard output does.
static IS_SILENT: AtomicBool = AtomicBool::new(false);

/// The first error of a write to standard output.
static PRINT_PROBLEM: OnceLock<String> = OnceLock::new();

/// The path that stands for standard output.
pub const STANDARD_OUTPUT: &str = "-";

/// `--json`, of commands whose results programs read.
#[derive(Debug, Default, Args)]
pub struct JsonOutput {
    /// Also write the results as JSON to this file; "-", or no name, is standard output, where
    /// nothing else is then printed
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = STANDARD_OUTPUT)]
    json: Option<PathBuf>,
}

impl JsonOutput {
    /// For a command that declares its own `--json` option.
    #[cfg(feature = "lab")]
    pub fn to(json: Option<PathBuf>) -> Self {
        Self { json }
    }

    /// Called before the work: refuses a file that could not be written.
    pub fn begin(&self) -> anyhow::Result<()> {
        match &self.json {
            Some(path) if is_standard_output(path) => {
                silence();
                Ok(())
            }
            Some(path) => check_writable(path),
            None => Ok(()),
        }
    }

    /// Whether JSON is wanted.
    #[cfg(feature = "lab")]
    pub fn is_wanted(&self) -> bool {
        self.json.is_some()
    }

    /// Writes the results, indented, if they are wanted.
    pub fn write(&self, record: &impl Serialize) -> anyhow::Result<()> {
        let Some(path) = &self.json else {
            return Ok(());
        };

        write_json(path, record)?;
        say(format_args!("wrote {}", path.display()));
        Ok(())
    }

    /// Where results are written as they come, a line each; none if they are not wanted.
    pub fn lines(&self) -> anyhow::Result<Option<JsonLines>> {
        let Some(path) = &self.json else {
            return Ok(None);
        };

        let to: Box<dyn Write> = match is_standard_output(path) {
            true => Box::new(std::io::stdout()),
            false => {
                let file = std::fs::File::create(path);
                Box::new(file.with_context(|| format!("{} cannot be written", path.display()))?)
            }
        };
        Ok(Some(JsonLines {
            to: std::io::BufWriter::new(to),
            path: path.clone(),
        }))
    }
}

/// JSON, an object a line.
pub struct JsonLines {
    to: std::io::BufWriter<Box<dyn Write>>,
    path: PathBuf,
}

impl JsonLines {
    /// Writes one result, and hands it on at once: a program may be waiting for it.
    pub fn write(&mut self, record: &impl Serialize) -> anyhow::Result<()> {
        let mut line = serde_json::to_vec(record)?;
        line.push(b'\n');
        let written = self.to.write_all(&line).and_then(|()| self.to.flush());

        // A closed pipe (`seese3 track --json - | head`) is no error here either.
        if let Err(error) = &written
            && error.kind() == std::io::ErrorKind::BrokenPipe
        {
            return Ok(());
        }
        written.with_context(|| format!("{} cannot be written", self.path.display()))
    }
}

fn is_standard_output(path: &Path) -> bool {
    path.as_os_str() == STANDARD_OUTPUT
}

/// Prints no more lines for people.
pub fn silence() {
    IS_SILENT.store(true, Ordering::Relaxed);
}

/// Whether lines for people and progress are left out.
pub fn is_silent() -> bool {
    IS_SILENT.load(Ordering::Relaxed)
}

/// Prints a line to standard output.
pub fn say(line: impl std::fmt::Display) {
    if !is_silent() {
        print(format!("{line}\n").as_bytes());
    }
}

/// Writes to standard output. What cannot be written is remembered for [`check_printed`]: the work
/// itself goes on. A closed pipe (`seese3 … | head`) is no error.
fn print(content: &[u8]) {
    let mut output = std::io::stdout().lock();
    let written = output.write_all(content).and_then(|()| output.flush());
    if let Err(error) = written
        && error.kind() != std::io::ErrorKind::BrokenPipe
    {
        let _ = PRINT_PROBLEM.set(error.to_string());
    }
}

/// Fails if anything could not be written to standard output, as on a full disk.
pub fn check_printed() -> anyhow::Result<()> {
    match PRINT_PROBLEM.get() {
        Some(problem) => anyhow::bail!("standard output cannot be written: {problem}"),
        None => Ok(()),
    }
}

/// Prints where an adapter was published.
pub fn say_published(store: &seese3_store::Store, name: &str, published: &seese3_store::Published) {
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

/// The error of an option or command whose feature is not in this build.
#[cfg_attr(
    all(feature = "bags", feature = "hnsw", feature = "otlp"),
    expect(dead_code, reason = "everything is built in")
)]
pub fn not_built(what: &str, feature: &str) -> anyhow::Error {
    anyhow::anyhow!(
        "{what}: this program was built without the feature `{feature}`; build it with \
         `cargo install --path . --features {feature}`"
    )
}

/// Rejects an output file whose folder does not exist, before any long computation is started for
/// it.
pub fn check_writable(path: &Path) -> anyhow::Result<()> {
    if path.is_dir() {
        anyhow::bail!("{} is a folder; name a file in it", path.display());
    }
    check_folder(path)
}

/// Rejects an output whose parent folder does not exist.
pub fn check_folder(path: &Path) -> anyhow::Result<()> {
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());

    match folder {
        Some(folder) if !folder.is_dir() => {
            anyhow::bail!("{}: the folder does not exist", path.display())
        }
        _ => Ok(()),
    }
}

/// Writes indented JSON, with a newline at the end, to a file or to standard output.
pub fn write_json(path: &Path, record: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(record)?;
    text.push('\n');
    write_result(path, text.as_bytes())
}

/// Writes results to a file, or to standard output.
pub fn write_result(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    if is_standard_output(path) {
        print(content);
        return Ok(());
    }
    write_file(path, content)
}

/// Writes a file atomically: readers see either the old file or the complete new one. What is no
/// regular file, such as a device or a pipe, is written into and never replaced.
pub fn write_file(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    let failed = || format!("{} cannot be written", path.display());

    // A symbolic link stays, and what it points to is replaced.
    let target = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    if std::fs::metadata(&target).is_ok_and(|found| !found.is_file()) {
        return std::fs::OpenOptions::new()
            .write(true)
            .open(&target)
            .and_then(|mut file| file.write_all(content))
            .with_context(failed);
    }

    // The content goes into a neighbouring file first: renaming within one folder replaces the
    // target in a single step.
    let mut partial = target.as_os_str().to_owned();
    partial.push(".partial");
    let partial = PathBuf::from(partial);

    let written =
        std::fs::write(&partial, content).and_then(|()| std::fs::rename(&partial, &target));
    if written.is_err() {
        // Half a file is of no use, and on a full disk it takes what space there is.
        let _ = std::fs::remove_file(&partial);
    }
    written.with_context(failed)
}

//! Output of the commands. Text goes to standard output, unless `--quiet` is given or `--json -`
//! writes JSON there.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use anyhow::Context;
use clap::Args;
use seese3_client::one_line;
use serde::Serialize;

use super::made_by::MadeBy;

/// Whether text output is turned off. A static, because standard output belongs to the process.
static IS_SILENT: AtomicBool = AtomicBool::new(false);

/// The first error of a write to standard output.
static PRINT_PROBLEM: OnceLock<String> = OnceLock::new();

/// The registered files of this process.
static FILES: Mutex<Vec<(PathBuf, Use)>> = Mutex::new(Vec::new());

/// Place of `--json` in the help of a command: after the command's own options.
pub const LAST_OPTION: usize = 900;

/// The path that stands for standard output.
pub const STANDARD_OUTPUT: &str = "-";

/// The option `--json`: machine-readable results.
#[derive(Debug, Default, Args)]
pub struct JsonOutput {
    /// Also write the results as JSON to this file. With "-" or no value, JSON goes to standard
    /// output, and no text is printed
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = STANDARD_OUTPUT, display_order = LAST_OPTION)]
    json: Option<PathBuf>,
}

impl JsonOutput {
    /// For a command that declares its own `--json` option.
    #[cfg(feature = "lab")]
    pub fn to(json: Option<PathBuf>) -> Self {
        Self { json }
    }

    /// Checks, before the work, that the file can be written.
    pub fn begin(&self) -> anyhow::Result<()> {
        self.json.as_deref().map_or(Ok(()), begin_output)
    }

    /// Whether `--json` was given.
    #[cfg(feature = "lab")]
    pub fn is_wanted(&self) -> bool {
        self.json.is_some()
    }

    /// Writes the results as indented JSON, if `--json` was given.
    pub fn write(&self, record: &impl Serialize) -> anyhow::Result<()> {
        let Some(path) = &self.json else {
            return Ok(());
        };

        write_json(path, record)?;
        say(format_args!("wrote {}", path.display()));
        Ok(())
    }

    /// A writer of one result per line; `None` without `--json`.
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
            is_first: true,
        }))
    }
}

/// Writer of JSON Lines: one object per line.
pub struct JsonLines {
    to: std::io::BufWriter<Box<dyn Write>>,
    path: PathBuf,
    is_first: bool,
}

impl JsonLines {
    /// Writes and flushes one result, because a program may be waiting for it. The first one has
    /// `made_by`.
    pub fn write(&mut self, record: &impl Serialize) -> anyhow::Result<()> {
        let made_by = std::mem::take(&mut self.is_first).then(MadeBy::now);
        let mut line = serde_json::to_vec(&Signed { record, made_by })?;
        line.push(b'\n');
        let written = self.to.write_all(&line).and_then(|()| self.to.flush());

        // A closed pipe (`seese3 track --json - | head`) is not an error.
        if let Err(error) = &written
            && error.kind() == std::io::ErrorKind::BrokenPipe
        {
            return Ok(());
        }
        written.with_context(|| format!("{} cannot be written", self.path.display()))
    }
}

fn is_standard_output(path: &Path) -> bool {
    path.as_os_str() == STANDARD_OUTPUT || path == Path::new("/dev/stdout")
}

/// Turns text output off.
pub fn silence() {
    IS_SILENT.store(true, Ordering::Relaxed);
}

/// Whether text output and progress are turned off.
pub fn is_silent() -> bool {
    IS_SILENT.load(Ordering::Relaxed)
}

/// Prints a line, or several, to standard output. Control characters within a line are left out:
/// the text may come from a server.
pub fn say(line: impl std::fmt::Display) {
    if !is_silent() {
        print(format!("{}\n", printable(&line.to_string())).as_bytes());
    }
}

/// The text without control characters, apart from tabs and the ends of lines.
pub fn printable(text: &str) -> String {
    let cells = |line: &str| {
        line.split('\t')
            .map(one_line)
            .collect::<Vec<_>>()
            .join("\t")
    };
    text.split('\n').map(cells).collect::<Vec<_>>().join("\n")
}

/// Writes to standard output. The first write error is kept for [`check_printed`], and the command
/// continues. A closed pipe (`seese3 … | head`) is not an error.
fn print(content: &[u8]) {
    let mut output = std::io::stdout().lock();
    let written = output.write_all(content).and_then(|()| output.flush());
    if let Err(error) = written
        && error.kind() != std::io::ErrorKind::BrokenPipe
    {
        let _ = PRINT_PROBLEM.set(error.to_string());
    }
}

/// Fails if a write to standard output failed, for example on a full disk.
pub fn check_printed() -> anyhow::Result<()> {
    match PRINT_PROBLEM.get() {
        Some(problem) => anyhow::bail!("standard output cannot be written: {problem}"),
        None => Ok(()),
    }
}

/// Prints where something was published; `what` is for example "adapter 'a'".
pub fn say_published(store: &seese3_store::Store, what: &str, published: &seese3_store::Published) {
    let state = if published.is_new {
        "published"
    } else {
        "already there, unchanged:"
    };

    say(format_args!(
        "{state} {what} revision {}: {}/{}",
        published.revision,
        store.location(),
        published.manifest
    ));
}

/// The error for an option or command that needs a feature missing in this build.
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

/// Registers an output, before a long computation starts. "-" is standard output, and turns text
/// output off.
///
/// # Errors
/// A folder, a file in a missing folder, a file of a store, an input of the command, and a second
/// output to the same file.
pub fn begin_output(path: &Path) -> anyhow::Result<()> {
    if is_standard_output(path) {
        silence();
    } else if path.is_dir() {
        anyhow::bail!("{} is a folder; name a file in it", path.display());
    }
    check_folder(path)?;

    let place = absolute(path);
    if place.ancestors().skip(1).any(is_resource_of_a_store) {
        anyhow::bail!(
            "{} is a file of a store; name a file elsewhere",
            path.display()
        );
    }
    register(path, place, Use::Output)
}

/// Registers a file that the command reads, so that no output replaces it.
///
/// # Errors
/// The file is an output, too.
#[cfg(feature = "lab")]
pub fn begin_input(path: &Path) -> anyhow::Result<()> {
    register(path, absolute(path), Use::Input)
}

/// What a command does with a file.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Use {
    #[cfg(feature = "lab")]
    Input,
    Output,
}

fn register(path: &Path, place: PathBuf, this: Use) -> anyhow::Result<()> {
    // Devices, for example /dev/null, take any number of outputs.
    if std::fs::metadata(&place).is_ok_and(|found| !found.is_file()) {
        return Ok(());
    }

    let mut files = FILES.lock().unwrap_or_else(PoisonError::into_inner);
    let mut earlier = files.iter().filter(|(other, _)| *other == place);
    if let Some((_, other)) = earlier.find(|(_, other)| [*other, this].contains(&Use::Output)) {
        let problem = match [*other, this] {
            [Use::Output, Use::Output] => "two outputs cannot have the same file",
            #[cfg(feature = "lab")]
            _ => "an output would replace this input; name another file",
        };
        anyhow::bail!("{}: {problem}", path.display());
    }
    files.push((place, this));
    Ok(())
}

/// Whether a folder is that of a room or an adapter of a store.
fn is_resource_of_a_store(folder: &Path) -> bool {
    let kind = folder.parent().and_then(Path::file_name);
    let is_kind = kind.is_some_and(|kind| kind == "rooms" || kind == "adapters");
    is_kind && folder.join("revisions").is_dir()
}

/// The path with its folder made absolute, and without symbolic links.
fn absolute(path: &Path) -> PathBuf {
    if let Ok(found) = std::fs::canonicalize(path) {
        return found;
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    match (std::fs::canonicalize(folder), path.file_name()) {
        (Ok(folder), Some(name)) => folder.join(name),
        _ => path.to_owned(),
    }
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

/// A result with what made it.
#[derive(Serialize)]
struct Signed<'a, T> {
    #[serde(flatten)]
    record: &'a T,
    #[serde(skip_serializing_if = "Option::is_none")]
    made_by: Option<MadeBy>,
}

/// Writes a result and what made it as indented JSON, with a newline at the end, to a file or to
/// standard output. The record must be an object.
pub fn write_json(path: &Path, record: &impl Serialize) -> anyhow::Result<()> {
    let made_by = Some(MadeBy::now());
    let mut text = serde_json::to_string_pretty(&Signed { record, made_by })?;
    text.push('\n');
    write_file(path, text.as_bytes())
}

/// As [`write_json`], on one line: for long lists of numbers.
#[cfg(feature = "lab")]
pub fn write_compact_json(path: &Path, record: &impl Serialize) -> anyhow::Result<()> {
    let made_by = Some(MadeBy::now());
    let mut text = serde_json::to_string(&Signed { record, made_by })?;
    text.push('\n');
    write_file(path, text.as_bytes())
}

/// Writes a record that a later run of the same command reads, as indented JSON without `made_by`.
#[cfg(feature = "lab")]
pub fn write_intermediate(path: &Path, record: &impl Serialize) -> anyhow::Result<()> {
    write_file(path, &serde_json::to_vec_pretty(record)?)
}

/// Writes a file atomically: readers see either the old file or the complete new one. A device or a
/// pipe is written to directly, and "-" is standard output.
pub fn write_file(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    if is_standard_output(path) {
        print(content);
        return Ok(());
    }

    let failed = || format!("{} cannot be written", path.display());

    // A symbolic link is kept; its target is replaced.
    let target = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    if std::fs::metadata(&target).is_ok_and(|found| !found.is_file()) {
        return std::fs::OpenOptions::new()
            .write(true)
            .open(&target)
            .and_then(|mut file| file.write_all(content))
            .with_context(failed);
    }

    // Write to a temporary file in the same folder first: a rename within a folder replaces the
    // target atomically.
    let mut partial = target.as_os_str().to_owned();
    partial.push(".partial");
    let partial = PathBuf::from(partial);

    let written =
        std::fs::write(&partial, content).and_then(|()| std::fs::rename(&partial, &target));
    if written.is_err() {
        // Remove the partial file: it is useless, and takes space on a full disk.
        let _ = std::fs::remove_file(&partial);
    }
    written.with_context(failed)
}

//! The rows of a sweep, a line a run, written as they are done: what a killed sweep goes on from.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use anyhow::Context;

use crate::report::SweepRow;

/// What journals' names end with.
const EXTENSION: &str = "runs.jsonl";

/// The journal of one shard.
pub struct Journal {
    path: PathBuf,
    file: Mutex<File>,
}

impl Journal {
    /// Opens a shard's journal in a folder, which is made; what a kill left half written is cut
    /// off.
    pub fn open(folder: &Path, shard: &str) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("{} cannot be made", folder.display()))?;
        let path = folder.join(format!("{shard}.{EXTENSION}"));
        let shown = || format!("{} cannot be written", path.display());

        let mut options = OpenOptions::new();
        let file = options
            .create(true)
            .append(true)
            .read(true)
            .open(&path)
            .with_context(shown)?;

        file.try_lock()
            .with_context(|| format!("{} is written by another sweep", path.display()))?;
        let text = std::fs::read(&path).with_context(shown)?;
        let whole = text
            .iter()
            .rposition(|&byte| byte == b'\n')
            .map_or(0, |at| at + 1);

        file.set_len(whole as u64).with_context(shown)?;

        Ok(Self {
            path,
            file: Mutex::new(file),
        })
    }

    /// Keeps a row.
    pub fn add(&self, row: &SweepRow) -> anyhow::Result<()> {
        let mut line = serde_json::to_vec(row)?;
        line.push(b'\n');

        let mut file = self
            .file
            .lock()
            .map_err(|_| anyhow::anyhow!("another run's writing failed"))?;

        file.write_all(&line)
            .and_then(|()| file.sync_data())
            .with_context(|| format!("{}", self.path.display()))
    }
}

/// The rows of all journals of a folder, by key, each once.
pub fn rows(folder: &Path) -> anyhow::Result<Vec<SweepRow>> {
    let mut found = std::collections::BTreeMap::new();
    let entries = std::fs::read_dir(folder)
        .with_context(|| format!("{} cannot be read", folder.display()))?;
    for entry in entries {
        let path = entry?.path();
        if !path.to_string_lossy().ends_with(EXTENSION) {
            continue;
        }

        let text =
            std::fs::read(&path).with_context(|| format!("{} cannot be read", path.display()))?;

        // Another shard may be writing its last line.
        let whole = text
            .iter()
            .rposition(|&byte| byte == b'\n')
            .map_or(&[][..], |end| &text[..end]);

        for (number, line) in whole
            .split(|&byte| byte == b'\n')
            .enumerate()
            .filter(|(_, line)| !line.is_empty())
        {
            let row: SweepRow = serde_json::from_slice(line).with_context(|| {
                format!("{}, line {}: no run of a sweep", path.display(), number + 1)
            })?;
            found.insert(row.key.clone(), row);
        }
    }

    Ok(found.into_values().collect())
}

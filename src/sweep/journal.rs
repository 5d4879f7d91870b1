//! The journal of a sweep: one line per finished run, written at once. A killed sweep resumes from
//! it.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use anyhow::Context;

use seese3_lab::experiments::adapter_sweep::SweepRow;

/// Suffix of every journal's file name.
const EXTENSION: &str = "runs.jsonl";

/// The journal of one shard, open for appending and locked against other processes.
pub struct SweepJournal {
    path: PathBuf,
    file: Mutex<File>,
}

impl SweepJournal {
    /// Opens the journal of a shard. Creates the folder if needed, and removes a last line that a
    /// killed sweep left incomplete.
    pub fn open(folder: &Path, shard: &str) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("{} cannot be created", folder.display()))?;
        let path = folder.join(format!("{shard}.{EXTENSION}"));
        let shown = || format!("{} cannot be written", path.display());

        let mut options = OpenOptions::new();
        let file = options
            .create(true)
            .append(true)
            .read(true)
            .open(&path)
            .with_context(shown)?;

        // Two sweeps that append to one file would mix their lines.
        file.try_lock()
            .with_context(|| format!("{} is in use by another sweep", path.display()))?;

        // Appending to an incomplete line would corrupt two rows: truncate after the last complete
        // line.
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

    /// Appends a row and waits until it is on disk.
    pub fn add(&self, row: &SweepRow) -> anyhow::Result<()> {
        let mut line = serde_json::to_vec(row)?;
        line.push(b'\n');

        let mut file = self
            .file
            .lock()
            .map_err(|_| anyhow::anyhow!("another run failed while it wrote to the journal"))?;

        file.write_all(&line)
            .and_then(|()| file.sync_data())
            .with_context(|| format!("{}", self.path.display()))
    }
}

/// The rows of all journals in a folder, sorted by key, without duplicates.
pub fn rows(folder: &Path) -> anyhow::Result<Vec<SweepRow>> {
    // Sorted by key, the rows do not depend on which shard finished first.
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

        // Another shard may be writing its last line: read only complete lines.
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
                format!("{}, line {}: not a sweep run", path.display(), number + 1)
            })?;
            found.insert(row.key.clone(), row);
        }
    }

    Ok(found.into_values().collect())
}

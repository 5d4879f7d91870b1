//! The option `--errors`: the error of every pair or view, for other statistics than the printed ones.

use std::ffi::OsStr;
use std::path::PathBuf;

use clap::Args;

use super::output::{LAST_OPTION, begin_output, say, write_file};

#[derive(Debug, Args)]
pub struct ErrorsFile {
    /// Also write the errors of every pair or view, by method, to this Parquet file
    #[arg(long, value_name = "FILE.parquet", value_parser = parquet, display_order = LAST_OPTION - 1)]
    errors: Option<PathBuf>,
}

impl ErrorsFile {
    /// For a command that declares its own `--errors` option.
    pub fn to(errors: Option<PathBuf>) -> Self {
        Self { errors }
    }

    /// Checks, before the work, that the file can be written.
    pub fn begin(&self) -> anyhow::Result<()> {
        self.errors.as_deref().map_or(Ok(()), begin_output)
    }

    /// Writes the file, if it was asked for.
    pub fn write(
        &self,
        content: impl FnOnce() -> Result<Vec<u8>, seese3_lab::report::Error>,
    ) -> anyhow::Result<()> {
        let Some(file) = &self.errors else {
            return Ok(());
        };

        write_file(file, &content()?)?;
        say(format_args!("wrote {}", file.display()));
        Ok(())
    }
}

/// Accepts a file name that ends with .parquet.
pub fn parquet(given: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(given);
    match path.extension() == Some(OsStr::new("parquet")) {
        true => Ok(path),
        false => Err("the name must end with .parquet".to_owned()),
    }
}

//! The options `--table` and `--plot`, of commands that print a table.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use clap::Args;

use super::output::{STANDARD_OUTPUT, begin_output, say, write_file};
use seese3_lab::report::{Table, dot_plot};
#[cfg(feature = "plots")]
use seese3_lab::report::{plot_pdf, plot_png};

#[derive(Debug, Args)]
pub struct TableFiles {
    /// Also write the table to this file: .csv for programs, .tex for LaTeX with booktabs, .md for
    /// Markdown
    #[arg(long, value_name = "FILE", value_parser = table_file)]
    table: Option<PathBuf>,
    /// Also draw the numbers to this file, .svg, .pdf or .png: a panel for each column
    #[arg(long, value_name = "FILE", value_parser = plot_file)]
    plot: Option<PathBuf>,
}

impl TableFiles {
    /// Checks, before the work, that the files can be written.
    pub fn begin(&self) -> anyhow::Result<()> {
        let files = self.table.iter().chain(&self.plot);
        files.map(PathBuf::as_path).try_for_each(begin_output)
    }

    /// Prints the table, and writes the files that were asked for. `title` is that of the plot.
    pub fn say(&self, table: &Table, title: &str) -> anyhow::Result<()> {
        self.say_and_draw(table, table, title)
    }

    /// The same, but `drawn` is drawn instead of the table.
    pub fn say_and_draw(&self, table: &Table, drawn: &Table, title: &str) -> anyhow::Result<()> {
        say(table);
        if let Some(file) = &self.table {
            write_file(file, table_text(file, table).as_bytes())?;
            say(format_args!("wrote {}", file.display()));
        }
        if let Some(file) = &self.plot {
            write_plot(file, dot_plot(drawn, title)?)?;
        }
        Ok(())
    }
}

/// The table in the format of the file's extension.
fn table_text(file: &Path, table: &Table) -> String {
    match file.extension().and_then(OsStr::to_str) {
        Some("tex") => table.escaped_for_latex().latex(),
        Some("md") => table.markdown(),
        _ => table.csv(),
    }
}

/// Writes an SVG plot in the format of the file's extension, and says so.
pub fn write_plot(file: &Path, svg: Vec<u8>) -> anyhow::Result<()> {
    write_file(file, &plot_bytes(file, svg)?)?;
    say(format_args!("wrote {}", file.display()));
    Ok(())
}

#[cfg(feature = "plots")]
fn plot_bytes(file: &Path, svg: Vec<u8>) -> anyhow::Result<Vec<u8>> {
    Ok(match file.extension().and_then(OsStr::to_str) {
        Some("pdf") => plot_pdf(&svg)?,
        Some("png") => plot_png(&svg)?,
        _ => svg,
    })
}

#[cfg(not(feature = "plots"))]
fn plot_bytes(_: &Path, svg: Vec<u8>) -> anyhow::Result<Vec<u8>> {
    Ok(svg)
}

/// Accepts a file name that ends with .svg, .pdf or .png.
pub fn plot_file(given: &str) -> Result<PathBuf, String> {
    let file = named(given, &["svg", "pdf", "png"])?;
    if cfg!(not(feature = "plots")) && file.extension() != Some(OsStr::new("svg")) {
        return Err("this build draws .svg only; .pdf and .png need the feature plots".into());
    }
    Ok(file)
}

/// Accepts a file name that ends with .md, and standard output.
pub fn markdown_file(given: &str) -> Result<PathBuf, String> {
    match given {
        STANDARD_OUTPUT => Ok(PathBuf::from(given)),
        _ => named(given, &["md"]),
    }
}

/// Accepts a file name that ends with .csv, .tex or .md.
pub fn table_file(given: &str) -> Result<PathBuf, String> {
    named(given, &["csv", "tex", "md"])
}

fn named(given: &str, extensions: &[&str]) -> Result<PathBuf, String> {
    let path = PathBuf::from(given);
    let extension = path.extension().and_then(OsStr::to_str).unwrap_or_default();
    if extensions.contains(&extension) {
        return Ok(path);
    }
    let known: Vec<String> = extensions.iter().map(|known| format!(".{known}")).collect();
    Err(format!("the name must end with {}", known.join(" or ")))
}

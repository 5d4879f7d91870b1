//! The table of every report: a head and rows of text cells.

use std::fmt;

/// A column of a table of `R`s.
pub enum Column<R> {
    /// The title, and the cell of a row.
    Text(&'static str, fn(&R) -> String),
    /// The title, the number of decimals, and the number of a row.
    Number(&'static str, usize, fn(&R) -> f64),
}

impl<R> Column<R> {
    fn title(&self) -> String {
        let (Self::Text(title, _) | Self::Number(title, ..)) = self;
        (*title).to_owned()
    }

    fn cell(&self, row: &R) -> String {
        match self {
            Self::Text(_, of) => of(row),
            Self::Number(_, decimals, of) => format!("{:.decimals$}", of(row)),
        }
    }
}

/// A table. [`fmt::Display`] aligns it as text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    /// The head, then the rows; a row may have fewer cells than the head.
    lines: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows. `head` has the titles of the columns, separated by ` | `.
    pub fn new(head: &str) -> Self {
        Self {
            lines: vec![head.split(" | ").map(str::to_owned).collect()],
        }
    }

    /// A table with one line per row.
    pub fn of<R>(rows: &[R], columns: &[Column<R>]) -> Self {
        let head = columns.iter().map(Column::title);
        let line = |row: &R| columns.iter().map(|column| column.cell(row)).collect();

        Self {
            lines: std::iter::once(head.collect())
                .chain(rows.iter().map(line))
                .collect(),
        }
    }

    /// Adds a row: its name in the first column, then the other cells.
    pub fn row(&mut self, name: impl Into<String>, cells: impl IntoIterator<Item = String>) {
        let line = std::iter::once(name.into()).chain(cells);
        self.lines.push(line.collect());
    }

    /// The cells of row `place`, from 0.
    pub fn cells(&self, place: usize) -> &[String] {
        &self.lines[place + 1]
    }

    /// The table as Markdown.
    pub fn markdown(&self) -> String {
        let line = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
            format!("| {} |\n", cells.join(" | "))
        };

        // Markdown aligns by column: the first column holds names, the others hold numbers.
        let columns = self.lines[0].len();
        let rule: Vec<String> = (0..columns)
            .map(|column| if column == 0 { "---" } else { "---:" }.to_owned())
            .collect();

        let rest = self.lines[1..].iter().map(|cells| line(cells));
        [line(&self.lines[0]), line(&rule)]
            .into_iter()
            .chain(rest)
            .collect()
    }

    /// The table as HTML.
    pub fn html(&self) -> String {
        let mut body = String::new();
        for (place, cells) in self.lines.iter().enumerate() {
            let tag = if place == 0 { "th" } else { "td" };
            let cells: String = cells
                .iter()
                .map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell)))
                .collect();
            body.push_str(&format!("<tr>{cells}</tr>\n"));
        }

        format!("<table>\n{body}</table>\n")
    }

    /// The table as comma-separated values; no cell may contain a comma.
    pub fn csv(&self) -> String {
        let lines = self.lines.iter().map(|cells| cells.join(",") + "\n");
        lines.collect()
    }

    /// The table as a LaTeX `tabular` for the package `booktabs`.
    pub fn latex(&self) -> String {
        let line = |cells: &[String]| format!("{} \\\\\n", cells.join(" & "));
        let columns = "r".repeat(self.lines[0].len() - 1);
        let body: String = self.lines[1..].iter().map(|cells| line(cells)).collect();

        format!(
            "\\begin{{tabular}}{{l{columns}}}\n\\toprule\n{}\\midrule\n{body}\\bottomrule\n\\end{{tabular}}\n",
            line(&self.lines[0])
        )
    }
}

/// Every column is as wide as its widest cell. The first is left-aligned, the others are
/// right-aligned. There is no line break after the last line.
impl fmt::Display for Table {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Widths are counted in characters, not in bytes: cells hold letters such as ², ° and –.
        let mut widths: Vec<usize> = Vec::new();
        for line in &self.lines {
            widths.resize(widths.len().max(line.len()), 0);
            for (width, cell) in widths.iter_mut().zip(line) {
                *width = (*width).max(cell.chars().count());
            }
        }

        for (place, line) in self.lines.iter().enumerate() {
            let mut text = format!("{:1$}", line[0], widths[0]);
            for (cell, width) in line.iter().zip(&widths).skip(1) {
                text.push_str(&format!("  {cell:>width$}"));
            }

            // A left-aligned or empty last cell leaves trailing blanks.
            let end = if place == 0 { "" } else { "\n" };
            write!(to, "{end}{}", text.trim_end())?;
        }

        Ok(())
    }
}

/// Formats numbers with a fixed number of decimals.
pub fn fixed<const N: usize>(values: [f64; N], decimals: usize) -> [String; N] {
    values.map(|value| format!("{value:.decimals$}"))
}

/// Groups results by a key, in order of first appearance.
pub(super) fn grouped<'a, T, K: PartialEq>(
    results: impl IntoIterator<Item = &'a T>,
    key: impl Fn(&'a T) -> K,
) -> Vec<Vec<&'a T>> {
    let mut groups: Vec<Vec<&T>> = Vec::new();
    for one in results {
        match groups.iter_mut().find(|group| key(group[0]) == key(one)) {
            Some(group) => group.push(one),
            None => groups.push(vec![one]),
        }
    }

    groups
}

/// Escapes text for HTML.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

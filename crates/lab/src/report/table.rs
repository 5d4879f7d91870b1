//! The table of every report: a head and rows of text cells.

use std::fmt;
use std::ops::Range;

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
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
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

    /// The titles of the columns.
    pub fn titles(&self) -> &[String] {
        &self.lines[0]
    }

    /// The rows below the head.
    pub fn rows(&self) -> &[Vec<String>] {
        &self.lines[1..]
    }

    /// The cells of row `place`, from 0.
    pub fn cells(&self, place: usize) -> &[String] {
        &self.lines[place + 1]
    }

    /// The lines, with an empty cell where a row has fewer cells than the head.
    fn full_lines(&self) -> impl Iterator<Item = Vec<String>> {
        self.lines.iter().map(|cells| {
            let mut cells = cells.clone();
            cells.resize(cells.len().max(self.lines[0].len()), String::new());
            cells
        })
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

        let rest = self.full_lines().skip(1).map(|cells| line(&cells));
        [line(&self.lines[0]), line(&rule)]
            .into_iter()
            .chain(rest)
            .collect()
    }

    /// The table as HTML.
    pub fn html(&self) -> String {
        let mut body = String::new();
        for (place, cells) in self.full_lines().enumerate() {
            let tag = if place == 0 { "th" } else { "td" };
            let cells: String = cells
                .iter()
                .map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell)))
                .collect();
            body.push_str(&format!("<tr>{cells}</tr>\n"));
        }

        format!("<table>\n{body}</table>\n")
    }

    /// The table as comma-separated values (RFC 4180).
    pub fn csv(&self) -> String {
        let quoted = |cell: &String| {
            let cell = cell.trim();
            if cell.contains([',', '"', '\n']) {
                format!("\"{}\"", cell.replace('"', "\"\""))
            } else {
                cell.to_owned()
            }
        };
        let line = |cells: Vec<String>| {
            let cells: Vec<String> = cells.iter().map(quoted).collect();
            cells.join(",") + "\n"
        };
        self.full_lines().map(line).collect()
    }

    /// The table with its cells escaped for LaTeX.
    pub fn escaped_for_latex(&self) -> Self {
        let escaped = |cell: &String| cell.trim().chars().map(latex_letter).collect();
        let lines = self.lines.iter();
        Self {
            lines: lines
                .map(|cells| cells.iter().map(escaped).collect())
                .collect(),
        }
    }

    /// The table as a LaTeX `tabular` for the package `booktabs`.
    pub fn latex(&self) -> String {
        let line = |cells: &[String]| format!("{} \\\\\n", cells.join(" & "));
        let columns = "r".repeat(self.lines[0].len() - 1);
        let body: String = self
            .full_lines()
            .skip(1)
            .map(|cells| line(&cells))
            .collect();

        format!(
            "\\begin{{tabular}}{{l{columns}}}\n\\toprule\n{}\\midrule\n{body}\\bottomrule\n\\end{{tabular}}\n",
            line(&self.lines[0])
        )
    }
}

/// A letter of a table as LaTeX text.
fn latex_letter(letter: char) -> String {
    let math = match letter {
        '&' | '%' | '$' | '#' | '_' | '{' | '}' => return format!("\\{letter}"),
        '–' => return "--".to_owned(),
        '±' => "\\pm",
        '²' => "^2",
        '°' => "^\\circ",
        '⁻' => "^-",
        '¹' => "^1",
        '½' => "\\frac12",
        '₁' => "_1",
        '₂' => "_2",
        '‖' => "\\|",
        '·' => "\\cdot",
        '→' => "\\to",
        '≤' => "\\le",
        '≥' => "\\ge",
        '−' => "-",
        '∇' => "\\nabla",
        'Δ' => "\\Delta",
        'ε' => "\\varepsilon",
        'λ' => "\\lambda",
        'ξ' => "\\xi",
        'ω' => "\\omega",
        other => return other.to_string(),
    };
    format!("${math}$")
}

/// The width of a terminal that every table fits, characters.
const TERMINAL_WIDTH: usize = 100;

/// Between two columns.
const GAP: usize = 2;

/// Largest width to which cells are padded: larger ones are a mistake, and `format!` panics beyond
/// 65,535.
const WIDEST: usize = 1_000;

/// Every column is as wide as its widest cell. The first is left-aligned, the others are
/// right-aligned. A table wider than 100 characters is folded: its columns follow in blocks, each
/// of which begins with the first column. There is no line break after the last line.
impl fmt::Display for Table {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let widths = self.widths();
        for (place, block) in blocks(&widths).into_iter().enumerate() {
            if place > 0 {
                to.write_str("\n\n")?;
            }
            self.write_block(to, &widths, block)?;
        }
        Ok(())
    }
}

impl Table {
    /// The width of each column, characters: cells hold letters such as ², ° and –.
    fn widths(&self) -> Vec<usize> {
        let mut widths: Vec<usize> = Vec::new();
        for line in &self.lines {
            widths.resize(widths.len().max(line.len()), 0);
            for (width, cell) in widths.iter_mut().zip(line) {
                *width = (*width).max(cell.chars().count());
            }
        }
        widths
    }

    /// Writes the first column and the columns of `block`.
    fn write_block(
        &self,
        to: &mut fmt::Formatter<'_>,
        widths: &[usize],
        block: Range<usize>,
    ) -> fmt::Result {
        for (place, line) in self.lines.iter().enumerate() {
            let mut text = format!("{:1$}", line[0], widths[0].min(WIDEST));
            for column in block.clone() {
                let cell = line.get(column).map_or("", String::as_str);
                text.push_str(&format!("  {cell:>0$}", widths[column].min(WIDEST)));
            }

            // A left-aligned or empty last cell leaves trailing blanks.
            let end = if place == 0 { "" } else { "\n" };
            write!(to, "{end}{}", text.trim_end())?;
        }
        Ok(())
    }
}

/// The columns after the first, in blocks that fit the terminal's width; at least one block, and at
/// least one column in each if there is one.
fn blocks(widths: &[usize]) -> Vec<Range<usize>> {
    let mut blocks = Vec::new();
    let mut start = 1;
    let mut taken = widths[0];
    for (column, width) in widths.iter().enumerate().skip(1) {
        if taken + GAP + width > TERMINAL_WIDTH && column > start {
            blocks.push(start..column);
            start = column;
            taken = widths[0];
        }
        taken += GAP + width;
    }
    blocks.push(start..widths.len().max(1));
    blocks
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand; RFC 4180 wants the same number of cells in every line.
    #[test]
    fn short_rows_are_filled_and_signs_are_math() {
        let mut table = Table::new("a | b | c");
        table.row("‖x‖ ≤ ½", ["1".to_owned()]);
        assert_eq!(table.csv(), "a,b,c\n‖x‖ ≤ ½,1,\n");

        let latex = table.escaped_for_latex().latex();
        let row = "$\\|$x$\\|$ $\\le$ $\\frac12$ & 1 &  \\\\\n";
        assert!(latex.contains(row), "{latex}");
    }
}

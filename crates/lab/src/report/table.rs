//! Tables of plain text.

/// Formats a table as text. Every column is as wide as its widest cell. The first column is
/// left-aligned, the others are right-aligned. Lines may have different numbers of cells.
pub fn aligned(lines: &[Vec<String>]) -> String {
    let columns = lines.iter().map(Vec::len).max().unwrap_or(0);

    // Widths are counted in characters, not in bytes: cells hold letters such as ², ° and –.
    let width = |column: usize| {
        lines
            .iter()
            .filter_map(|line| line.get(column))
            .map(|cell| cell.chars().count())
            .max()
            .unwrap_or(0)
    };

    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for line in lines {
        for (column, cell) in line.iter().enumerate() {
            let padding = " ".repeat(widths[column] - cell.chars().count());
            let cell = if column == 0 {
                format!("{cell}{padding}")
            } else {
                format!("  {padding}{cell}")
            };
            text.push_str(&cell);
        }

        // A left-aligned or empty last cell leaves trailing blanks.
        text.truncate(text.trim_end().len());
        text.push('\n');
    }

    text
}

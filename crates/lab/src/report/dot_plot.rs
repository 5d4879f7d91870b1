//! Dot plots of tables: one panel for each column of numbers, one line for each row.

use plotters::prelude::*;

use super::Error;
use super::table::Table;

/// Width of a character of a name, pixels.
const CHARACTER: u32 = 7;
/// Width of a panel, pixels.
const PANEL: u32 = 170;
/// Height of a row, pixels.
const ROW: u32 = 22;
/// Height of the title and of the names of the columns, pixels.
const HEAD: u32 = 62;
/// Height of the labels below the panels, pixels.
const FOOT: u32 = 40;
/// Maximum length of a name, characters.
const LONGEST: usize = 80;
/// The column that counts what a row is over. It is not drawn.
const COUNT: &str = "n";
const COLOR: RGBColor = RGBColor(31, 119, 180);

/// A number of a table, with the interval that the cell states.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Estimate {
    value: f64,
    low: f64,
    high: f64,
}

impl Estimate {
    /// Reads a cell: `0.5`, `0.5*`, `12.0 %`, `0.5 ± 0.1` or `0.50 [0.41, 0.59]`. `None` for other
    /// cells, such as two numbers with their units.
    fn of(cell: &str) -> Option<Self> {
        let (value, rest) = leading_number(cell)?;
        let rest = rest.trim_start();
        let (low, high) = if let Some(deviation) = rest.strip_prefix('±') {
            let (deviation, _) = leading_number(deviation)?;
            (value - deviation, value + deviation)
        } else if let Some(interval) = rest.strip_prefix('[') {
            let (low, after) = leading_number(interval)?;
            let after = after.trim_start_matches([',', ' ', '–', ';']);
            (low, leading_number(after)?.0)
        } else if matches!(rest.trim_end(), "" | "*" | "%" | "% *") {
            (value, value)
        } else {
            return None;
        };
        Some(Self { value, low, high })
    }
}

/// The number at the beginning of a text, and what follows it.
fn leading_number(text: &str) -> Option<(f64, &str)> {
    let text = text.trim_start();
    let is_part = |c: char| c.is_ascii_digit() || matches!(c, '.' | '-' | '+' | 'e');
    let end = text.find(|c| !is_part(c)).unwrap_or(text.len());
    let value: f64 = text[..end].parse().ok()?;
    value.is_finite().then_some((value, &text[end..]))
}

/// A column of numbers. A cell without one is `None`.
struct Panel<'a> {
    title: &'a str,
    cells: Vec<Option<Estimate>>,
}

impl Panel<'_> {
    /// The range of the values and their intervals, with a margin.
    fn range(&self) -> std::ops::Range<f64> {
        let cells = self.cells.iter().flatten();
        let (low, high) = cells.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), cell| {
            (low.min(cell.low), high.max(cell.high))
        });
        let margin = ((high - low) * 0.08).max(1e-9 + 1e-3 * high.abs());
        low - margin..high + margin
    }
}

/// The name of each row: its cells in the columns before the first one with numbers, without those
/// that are the same in every row.
fn names(rows: &[Vec<String>]) -> Vec<String> {
    let cell =
        |row: &[String], place: usize| row.get(place).map_or("", |cell| cell.trim()).to_owned();
    let has_numbers = |place: usize| {
        rows.iter()
            .any(|row| Estimate::of(&cell(row, place)).is_some())
    };
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let leading: Vec<usize> = std::iter::once(0)
        .chain((1..columns).take_while(|&place| !has_numbers(place)))
        .collect();

    let differs = |&place: &usize| {
        rows.iter()
            .any(|row| cell(row, place) != cell(&rows[0], place))
    };
    let mut named: Vec<usize> = leading.iter().copied().filter(differs).collect();
    if named.is_empty() {
        named.push(0);
    }

    let name = |row: &Vec<String>| {
        let cells: Vec<String> = named.iter().map(|&place| cell(row, place)).collect();
        cells.join(" ").trim().chars().take(LONGEST).collect()
    };
    rows.iter().map(name).collect()
}

/// Draws a table as an SVG file. Columns without numbers, and the column `n`, are left out.
///
/// # Errors
/// [`Error::Picture`] if the table has no numbers, or the drawing library fails.
pub fn dot_plot(table: &Table, title: &str) -> Result<Vec<u8>, Error> {
    let rows = table.rows();
    let columns = table.titles().iter().enumerate().skip(1);
    let columns = columns.filter(|(_, title)| *title != COUNT);
    let panels: Vec<Panel<'_>> = columns
        .map(|(place, title)| Panel {
            title,
            cells: rows
                .iter()
                .map(|row| row.get(place).and_then(|cell| Estimate::of(cell)))
                .collect(),
        })
        .filter(|panel| panel.cells.iter().any(Option::is_some))
        .collect();
    if panels.is_empty() {
        return Err(Error::Picture {
            problem: "the table has no numbers to draw".into(),
        });
    }

    let names = names(rows);
    let longest = names.iter().map(|name| name.chars().count()).max();
    let beside = CHARACTER * longest.unwrap_or(0) as u32 + 24;
    let width = beside + PANEL * panels.len() as u32;
    let height = HEAD + ROW * rows.len() as u32 + FOOT;
    let mut svg = String::new();
    draw(&mut svg, (width, height), title, (&names, beside), &panels).map_err(|error| {
        Error::Picture {
            problem: error.to_string().into(),
        }
    })?;
    Ok(svg.into_bytes())
}

fn draw(
    svg: &mut String,
    size: (u32, u32),
    title: &str,
    (names, beside): (&[String], u32),
    panels: &[Panel<'_>],
) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::with_string(svg, size).into_drawing_area();
    root.fill(&WHITE)?;
    root.draw(&Text::new(
        title.to_owned(),
        (8, 8),
        ("sans-serif", 17).into_font(),
    ))?;

    for (place, name) in names.iter().enumerate() {
        let y = HEAD as i32 + ROW as i32 * place as i32 + 4;
        root.draw(&Text::new(
            name.clone(),
            (8, y),
            ("sans-serif", 13).into_font(),
        ))?;
    }

    let (_, all) = root.split_horizontally(beside);
    let areas = all.split_evenly((1, panels.len()));
    for (panel, area) in panels.iter().zip(areas) {
        let at = (4, HEAD as i32 - 20);
        let title = Text::new(panel.title.to_owned(), at, ("sans-serif", 13).into_font());
        area.draw(&title)?;

        let x = panel.range();
        let mut chart = ChartBuilder::on(&area)
            .margin_top(HEAD)
            .margin_right(14)
            .x_label_area_size(FOOT)
            .build_cartesian_2d(x.clone(), names.len() as f64..0.0)?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .x_labels(3)
            .light_line_style(WHITE)
            .draw()?;
        if x.contains(&0.0) {
            let zero = [(0.0, 0.0), (0.0, names.len() as f64)];
            chart.draw_series(LineSeries::new(zero, BLACK.mix(0.35)))?;
        }

        for (place, cell) in panel.cells.iter().enumerate() {
            let Some(Estimate { value, low, high }) = *cell else {
                continue;
            };
            let y = place as f64 + 0.5;
            let interval = vec![(low, y), (high, y)];
            chart.draw_series([PathElement::new(interval, COLOR.mix(0.6).stroke_width(2))])?;
            chart.draw_series([Circle::new((value, y), 4, COLOR.filled())])?;
        }
    }

    root.present()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn cells_are_read_with_their_intervals() {
        let estimate = |value, low, high| Some(Estimate { value, low, high });
        assert_eq!(Estimate::of(" 0.5*"), estimate(0.5, 0.5, 0.5));
        assert_eq!(Estimate::of("-1.25 ± 0.25*"), estimate(-1.25, -1.5, -1.0));
        assert_eq!(Estimate::of("0.50 [0.40, 0.65]"), estimate(0.5, 0.4, 0.65));
        assert_eq!(Estimate::of("12.5 %"), estimate(12.5, 12.5, 12.5));
        for cell in [
            "",
            "LEAK",
            "undefined",
            "NaN",
            "-",
            "0.35 m 5°",
            "5.0 to 7.0",
        ] {
            assert_eq!(Estimate::of(cell), None, "{cell}");
        }
    }

    /// Oracle: by hand: the room is the same in every row, the metric is not.
    #[test]
    fn rows_are_named_by_what_differs() {
        let mut table = Table::new("room | metric | value");
        table.row("a", ["M1".to_owned(), "0.5".to_owned()]);
        table.row("a", ["M2".to_owned(), "6".to_owned()]);
        assert_eq!(names(table.rows()), ["M1", "M2"]);

        table.row("b", ["M1".to_owned(), "0.6".to_owned()]);
        assert_eq!(names(table.rows()), ["a M1", "a M2", "b M1"]);
    }

    /// Oracle: by hand: two columns have numbers, and three cells in all.
    #[test]
    fn a_panel_is_drawn_for_each_column_of_numbers() {
        let mut table = Table::new("name | kind | R² | m");
        table.row(
            "a",
            ["x".to_owned(), "0.5 ± 0.1".to_owned(), "2.0".to_owned()],
        );
        table.row("b", ["y".to_owned(), "0.7".to_owned()]);
        let svg = String::from_utf8(dot_plot(&table, "a title").unwrap()).unwrap();
        assert_eq!(svg.matches("<circle").count(), 3);
        for text in ["a title", "R²", ">\nm\n"] {
            assert!(svg.contains(text), "{text}: {svg}");
        }
        assert!(!svg.contains("kind"));

        let mut words = Table::new("name | kind");
        words.row("a", ["x".to_owned()]);
        assert!(dot_plot(&words, "").is_err());
    }
}

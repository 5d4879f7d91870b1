//! Line and scatter plots, as SVG.

use super::Error;
use plotters::coord::Shift;
use plotters::prelude::*;

/// A named set of points (x, y).
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points in the order of the line; points that are not finite are skipped.
    pub points: Vec<[f64; 2]>,
    /// Whether a line joins the points.
    pub joined: bool,
}

/// A plot.
#[derive(Debug, Clone)]
pub struct Curves {
    /// Title, drawn above the plot.
    pub title: String,
    /// Label of the x axis.
    pub x: String,
    /// Label of the y axis.
    pub y: String,
    /// Sets of points, one color each; eight colors repeat cyclically.
    pub series: Vec<Series>,
    /// Whether the line y = x is drawn.
    pub diagonal: bool,
}

impl Series {
    /// Points joined by a line.
    pub fn line(name: impl Into<String>, points: Vec<[f64; 2]>) -> Self {
        Self {
            name: name.into(),
            points,
            joined: true,
        }
    }
}

impl Curves {
    /// A plot without the line y = x.
    pub fn new(
        title: impl Into<String>,
        x: impl Into<String>,
        y: impl Into<String>,
        series: Vec<Series>,
    ) -> Self {
        Self {
            title: title.into(),
            x: x.into(),
            y: y.into(),
            series,
            diagonal: false,
        }
    }

    /// Draws the plot as an SVG file.
    ///
    /// # Errors
    /// [`Error::Picture`] if the drawing library fails.
    pub fn svg(&self) -> Result<Vec<u8>, Error> {
        svg(SIZE, &|root| draw(root, self))
    }
}

/// What is drawn on a picture, or why the library refused it.
pub(super) type Drawn = Result<(), Box<dyn std::error::Error>>;
/// The picture that is drawn on.
pub(super) type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// An SVG file of a size in pixels, drawn on white by `draw`.
///
/// # Errors
/// [`Error::Picture`] if the drawing library fails.
pub(super) fn svg(size: (u32, u32), draw: &dyn Fn(&Canvas<'_>) -> Drawn) -> Result<Vec<u8>, Error> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let drawn = root.fill(&WHITE).map_err(Into::into);
        let drawn = drawn.and_then(|()| draw(&root));
        let drawn = drawn.and_then(|()| root.present().map_err(Into::into));
        drawn.map_err(|error: Box<dyn std::error::Error>| Error::Picture {
            problem: error.to_string().into(),
        })?;
    }

    Ok(svg.into_bytes())
}

const SIZE: (u32, u32) = (1_080, 520);
/// Left edge of the legend, pixels. The legend is beside the plot and covers no points.
const LEGEND_X: u32 = 800;
const COLOURS: [RGBColor; 8] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 96, 20),
    RGBColor(44, 140, 70),
    RGBColor(148, 103, 189),
    RGBColor(140, 86, 75),
    RGBColor(200, 60, 90),
    RGBColor(100, 100, 100),
    RGBColor(23, 160, 180),
];

fn draw(root: &Canvas<'_>, curves: &Curves) -> Drawn {
    let (plot, legend) = root.split_horizontally(LEGEND_X);

    // Values that are not finite are not drawn and must not affect the axis ranges.
    let values = |axis: usize| {
        curves
            .series
            .iter()
            .flat_map(|s| &s.points)
            .map(move |p| p[axis])
            .filter(|value| value.is_finite())
    };

    let mut x_range = range(values(0));
    let mut y_range = range(values(1));
    if curves.diagonal {
        // Both axes share one range, so that the diagonal y = x crosses the whole plot.
        let both = x_range.start.min(y_range.start)..x_range.end.max(y_range.end);
        x_range = both.clone();
        y_range = both;
    }

    let mut chart = ChartBuilder::on(&plot)
        .caption(&curves.title, ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(42)
        .y_label_area_size(56)
        .build_cartesian_2d(x_range.clone(), y_range.clone())?;

    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc(&curves.x)
        .y_desc(&curves.y)
        .draw()?;

    if curves.diagonal {
        chart.draw_series(LineSeries::new(
            [(x_range.start, x_range.start), (x_range.end, x_range.end)],
            BLACK.mix(0.3),
        ))?;
    }

    for (place, (series, colour)) in curves.series.iter().zip(COLOURS.iter().cycle()).enumerate() {
        let points: Vec<(f64, f64)> = series
            .points
            .iter()
            .filter(|p| p.iter().all(|value| value.is_finite()))
            .map(|p| (p[0], p[1]))
            .collect();

        if series.joined {
            chart.draw_series(LineSeries::new(
                points.iter().copied(),
                colour.stroke_width(2),
            ))?;
        }

        // Mark the points on lines too: only the points are measured.
        chart.draw_series(points.iter().map(|&at| Circle::new(at, 3, colour.filled())))?;

        // The legend is drawn by hand, one line of 22 pixels per series.
        let at = 60 + 22 * i32::try_from(place).unwrap_or(0);
        legend.draw(&Circle::new((8, at + 7), 4, colour.filled()))?;

        legend.draw(&Text::new(
            series.name.clone(),
            (20, at),
            ("sans-serif", 13),
        ))?;
    }

    Ok(())
}

/// The range of the values with a margin to both sides; 0 to 1 if there are no values.
fn range(values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if low > high {
        return 0.0..1.0;
    }

    // Equal values would give an empty range, which cannot be drawn.
    let margin = if high > low { 0.06 * (high - low) } else { 0.5 };
    low - margin..high + margin
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the SVG text: one circle per finite point, one per series for the legend, and the
    /// given labels.
    #[test]
    fn every_point_is_drawn() {
        let points = vec![[0.0, 1.0], [1.0, 2.0], [2.0, f64::NAN]];
        let curves = Curves::new("T", "rooms", "hits", vec![Series::line("grows", points)]);
        let text = |curves: &Curves| String::from_utf8(curves.svg().unwrap()).unwrap();

        let svg = text(&curves);
        assert_eq!(svg.matches("<circle").count(), 2 + 1);
        assert!(svg.contains("grows") && svg.contains("rooms") && svg.contains("hits"));

        let empty = Curves {
            series: Vec::new(),
            ..curves
        };

        assert!(text(&empty).contains("<svg"));
    }
}

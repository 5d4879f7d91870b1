//! Figures: series of points in a plane, as SVG.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::Error;

/// A figure.
#[derive(Debug, Clone)]
pub struct Figure {
    /// Title, drawn above the plot.
    pub title: String,
    /// Label of the x axis.
    pub x: String,
    /// Label of the y axis.
    pub y: String,
    /// Sets of points, in drawing order.
    pub series: Vec<Series>,
    /// The ranges of the axes.
    pub axes: Axes,
}

/// The ranges of the axes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axes {
    /// Each axis has the range of its values.
    Fitted,
    /// Both axes have one range, and the line y = x is drawn.
    Diagonal,
    /// A meter has the same length on both axes. The legend is inside the plot.
    Plan,
}

/// A named set of points (x, y).
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// The marked points; points that are not finite are skipped.
    pub points: Vec<[f64; 2]>,
    /// Points joined by a line.
    line: Vec<[f64; 2]>,
    /// Headings at the points, radians from the x axis.
    headings: Vec<f64>,
    /// `None` for the next of eight colors, which repeat cyclically.
    color: Option<RGBColor>,
    mark: Mark,
}

/// The mark of a point; sizes are in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mark {
    Dot(i32),
    Triangle(i32),
}

impl Series {
    /// Points without a line.
    pub fn dots(name: impl Into<String>, points: Vec<[f64; 2]>) -> Self {
        Self {
            name: name.into(),
            points,
            line: Vec::new(),
            headings: Vec::new(),
            color: None,
            mark: Mark::Dot(3),
        }
    }

    /// Points joined by a line, in their order. They are marked too: only the points are measured.
    pub fn line(name: impl Into<String>, points: Vec<[f64; 2]>) -> Self {
        Self {
            line: points.clone(),
            ..Self::dots(name, points)
        }
    }

    /// Cameras: x, y, heading.
    fn cameras(name: &str, cameras: &[[f64; 3]], color: RGBColor, mark: Mark) -> Self {
        let points = cameras.iter().map(|&[x, y, _]| [x, y]).collect();
        Self {
            headings: cameras.iter().map(|camera| camera[2]).collect(),
            color: Some(color),
            mark,
            ..Self::dots(name, points)
        }
    }
}

/// A plan view of a navigation: positions in meters and headings in radians from the x axis.
#[derive(Debug, Clone, PartialEq)]
pub struct PathPlot {
    /// Title above the picture.
    pub title: String,
    /// Positions (x, y) of all map frames.
    pub map: Vec<[f64; 2]>,
    /// The source camera: x, y, heading.
    pub source: [f64; 3],
    /// The target camera: x, y, heading.
    pub target: [f64; 3],
    /// The target poses of the steps: x, y, heading.
    pub requested: Vec<[f64; 3]>,
    /// The poses of the retrieved frames, one per step: x, y, heading.
    pub retrieved: Vec<[f64; 3]>,
}

impl From<&PathPlot> for Figure {
    fn from(plot: &PathPlot) -> Self {
        // Both paths, requested and retrieved, begin at the source.
        let [x, y, _] = plot.source;
        let path = |name: &str, steps: &[[f64; 3]], color: RGBColor| {
            let steps = Series::cameras(name, steps, color, Mark::Dot(5));
            let line = std::iter::once([x, y]).chain(steps.points.iter().copied());
            Series {
                line: line.collect(),
                ..steps
            }
        };
        let map = Series {
            color: Some(MAP_COLOR),
            mark: Mark::Dot(2),
            ..Series::dots("frames of the map", plot.map.clone())
        };

        // Source and target are drawn last, on top of both paths.
        let end = |name: &str, camera: [f64; 3], color: RGBColor| {
            Series::cameras(name, &[camera], color, Mark::Triangle(9))
        };
        let series = vec![
            map,
            path("requested", &plot.requested, RGBColor(40, 100, 220)),
            path("retrieved frames", &plot.retrieved, RGBColor(225, 90, 20)),
            end("source", plot.source, RGBColor(30, 30, 30)),
            end("target", plot.target, RGBColor(20, 140, 70)),
        ];

        Self {
            axes: Axes::Plan,
            ..Self::new(&plot.title, "x, meters", "y, meters", series)
        }
    }
}

const MAP_COLOR: RGBColor = RGBColor(200, 205, 212);
const COLORS: [RGBColor; 8] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 96, 20),
    RGBColor(44, 140, 70),
    RGBColor(148, 103, 189),
    RGBColor(140, 86, 75),
    RGBColor(200, 60, 90),
    RGBColor(100, 100, 100),
    RGBColor(23, 160, 180),
];
/// Left edge of the legend beside a plot, pixels.
const LEGEND_X: u32 = 800;

type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

impl Figure {
    /// A figure with fitted axes.
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
            axes: Axes::Fitted,
        }
    }

    /// Draws the figure as an SVG file.
    ///
    /// # Errors
    /// [`Error::Picture`] if the drawing library fails.
    pub fn svg(&self) -> Result<Vec<u8>, Error> {
        let size = match self.axes {
            Axes::Plan => (900, 700),
            Axes::Fitted | Axes::Diagonal => (1_080, 520),
        };

        let mut svg = String::new();
        {
            let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
            self.draw(&root).map_err(|error| Error::Picture {
                problem: error.to_string().into(),
            })?;
        }

        Ok(svg.into_bytes())
    }

    fn draw(&self, root: &Canvas<'_>) -> Drawn {
        root.fill(&WHITE)?;
        let is_plan = self.axes == Axes::Plan;

        // The legend of curves is beside the plot and covers no points.
        let (plot, legend) = if is_plan {
            (root.clone(), root.clone())
        } else {
            root.split_horizontally(LEGEND_X)
        };
        let (below, left) = if is_plan { (40, 50) } else { (42, 56) };

        let (x_range, y_range) = self.ranges();
        let mut chart = ChartBuilder::on(&plot)
            .caption(&self.title, ("sans-serif", 20))
            .margin(12)
            .x_label_area_size(below)
            .y_label_area_size(left)
            .build_cartesian_2d(x_range.clone(), y_range)?;

        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .x_desc(&self.x)
            .y_desc(&self.y)
            .draw()?;

        if self.axes == Axes::Diagonal {
            chart.draw_series(LineSeries::new(
                [(x_range.start, x_range.start), (x_range.end, x_range.end)],
                BLACK.mix(0.3),
            ))?;
        }

        for (place, (series, next)) in self.series.iter().zip(COLORS.iter().cycle()).enumerate() {
            let color = series.color.unwrap_or(*next);
            if !series.line.is_empty() {
                let line = finite(&series.line);
                chart.draw_series(LineSeries::new(line, color.stroke_width(2)))?;
            }

            // A heading is a line of 12 cm.
            let heading = |((x, y), heading): ((f64, f64), &f64)| {
                let (sin, cos) = heading.sin_cos();
                let ends = vec![(x, y), (x + 0.12 * cos, y + 0.12 * sin)];
                PathElement::new(ends, color.stroke_width(3))
            };
            let points = finite(&series.points);
            chart.draw_series(points.iter().copied().zip(&series.headings).map(heading))?;

            let mark = |&at: &(f64, f64)| match series.mark {
                Mark::Dot(size) => Circle::new(at, size, color.filled()).into_dyn(),
                Mark::Triangle(size) => TriangleMarker::new(at, size, color.filled()).into_dyn(),
            };
            let marked = chart.draw_series(points.iter().map(mark))?;

            if is_plan {
                let entry = move |(x, y)| Circle::new((x + 10, y), 5, color.filled());
                marked.label(&series.name).legend(entry);
            } else {
                // The legend is drawn by hand, one line of 22 pixels per series.
                let at = 60 + 22 * i32::try_from(place).unwrap_or(0);
                legend.draw(&Circle::new((8, at + 7), 4, color.filled()))?;
                legend.draw(&Text::new(
                    series.name.clone(),
                    (20, at),
                    ("sans-serif", 13),
                ))?;
            }
        }

        if is_plan {
            chart
                .configure_series_labels()
                .position(SeriesLabelPosition::LowerLeft)
                .background_style(WHITE.mix(0.85))
                .border_style(MAP_COLOR)
                .draw()?;
        }

        root.present()?;
        Ok(())
    }

    /// The ranges of x and y, with margins.
    fn ranges(&self) -> (Range<f64>, Range<f64>) {
        // Values that are not finite are not drawn and must not affect the axis ranges.
        let extent = |axis: usize| {
            let points = self.series.iter().flat_map(|series| &series.points);
            let values = points
                .map(|point| point[axis])
                .filter(|value| value.is_finite());
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
                (low.min(value), high.max(value))
            })
        };
        let [x, y] = [extent(0), extent(1)];

        match self.axes {
            Axes::Fitted => (with_margin(x), with_margin(y)),
            Axes::Diagonal => {
                // The diagonal y = x crosses the whole plot.
                let (x, y) = (with_margin(x), with_margin(y));
                let both = x.start.min(y.start)..x.end.max(y.end);
                (both.clone(), both)
            }
            Axes::Plan => {
                // Center and half width of an axis, with a margin of 25 cm; the full width is at
                // least 1 m.
                let span = |(low, high): (f64, f64)| {
                    ((low + high) / 2.0, (high - low).max(0.5) / 2.0 + 0.25)
                };
                let ((x, half_x), (y, half_y)) = (span(x), span(y));

                // The plot area inside the margins and labels is about 830 × 600 pixels. Widen the
                // shorter range until a meter has the same length on both axes.
                let aspect = 830.0 / 600.0;
                let half_y = half_y.max(half_x / aspect);
                let half_x = half_y * aspect;
                (x - half_x..x + half_x, y - half_y..y + half_y)
            }
        }
    }
}

fn finite(points: &[[f64; 2]]) -> Vec<(f64, f64)> {
    let finite = points
        .iter()
        .filter(|point| point.iter().all(|value| value.is_finite()));
    finite.map(|point| (point[0], point[1])).collect()
}

/// A range of values with a margin to both sides; 0 to 1 if there are no values.
fn with_margin((low, high): (f64, f64)) -> Range<f64> {
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
        let figure = Figure::new("T", "rooms", "hits", vec![Series::line("grows", points)]);
        let text = |figure: &Figure| String::from_utf8(figure.svg().unwrap()).unwrap();

        let svg = text(&figure);
        assert_eq!(svg.matches("<circle").count(), 2 + 1);
        assert!(svg.contains("grows") && svg.contains("rooms") && svg.contains("hits"));

        let empty = Figure {
            series: Vec::new(),
            ..figure
        };

        assert!(text(&empty).contains("<svg"));
    }
}

//! Plan view of a navigation, as SVG.

use super::Error;
use super::curves::{Canvas, Drawn, svg};
use plotters::prelude::*;

/// Contents of a plan view: positions in metres and headings in radians from the x axis.
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

const SIZE: (u32, u32) = (900, 700);
const MAP_COLOUR: RGBColor = RGBColor(200, 205, 212);
const SOURCE_COLOUR: RGBColor = RGBColor(30, 30, 30);
const TARGET_COLOUR: RGBColor = RGBColor(20, 140, 70);
const REQUESTED_COLOUR: RGBColor = RGBColor(40, 100, 220);
const RETRIEVED_COLOUR: RGBColor = RGBColor(225, 90, 20);

/// Draws the plan view as an SVG file.
///
/// # Errors
/// [`Error::Picture`] if the drawing library fails.
pub fn path_svg(plot: &PathPlot) -> Result<Vec<u8>, Error> {
    svg(SIZE, &|root| draw(root, plot))
}

fn draw(root: &Canvas<'_>, plot: &PathPlot) -> Drawn {
    let (x_range, y_range) = ranges(plot);

    let mut chart = ChartBuilder::on(root)
        .caption(&plot.title, ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(50)
        .build_cartesian_2d(x_range, y_range)?;

    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc("x, metres")
        .y_desc("y, metres")
        .draw()?;

    let entry = |colour: RGBColor| move |(x, y)| Circle::new((x + 10, y), 5, colour.filled());
    chart
        .draw_series(
            plot.map
                .iter()
                .map(|at| Circle::new((at[0], at[1]), 2, MAP_COLOUR.filled())),
        )?
        .label("frames of the map")
        .legend(entry(MAP_COLOUR));

    // Both paths, requested and retrieved, begin at the source.
    let way = |steps: &[[f64; 3]]| -> Vec<(f64, f64)> {
        std::iter::once(&plot.source)
            .chain(steps)
            .map(|at| (at[0], at[1]))
            .collect()
    };

    // A heading is a line of 12 cm.
    let arrow = |at: &[f64; 3]| {
        let (sin, cos) = at[2].sin_cos();
        vec![(at[0], at[1]), (at[0] + 0.12 * cos, at[1] + 0.12 * sin)]
    };

    for (label, steps, colour) in [
        ("requested", &plot.requested, REQUESTED_COLOUR),
        ("retrieved frames", &plot.retrieved, RETRIEVED_COLOUR),
    ] {
        chart.draw_series(LineSeries::new(way(steps), colour.stroke_width(2)))?;

        chart.draw_series(
            steps
                .iter()
                .map(|at| PathElement::new(arrow(at), colour.stroke_width(3))),
        )?;

        chart
            .draw_series(
                steps
                    .iter()
                    .map(|at| Circle::new((at[0], at[1]), 5, colour.filled())),
            )?
            .label(label)
            .legend(entry(colour));
    }

    // Draw source and target last, on top of both paths.
    for (label, at, colour) in [
        ("source", &plot.source, SOURCE_COLOUR),
        ("target", &plot.target, TARGET_COLOUR),
    ] {
        chart.draw_series([PathElement::new(arrow(at), colour.stroke_width(3))])?;

        chart
            .draw_series([TriangleMarker::new((at[0], at[1]), 9, colour.filled())])?
            .label(label)
            .legend(entry(colour));
    }

    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerLeft)
        .background_style(WHITE.mix(0.85))
        .border_style(MAP_COLOUR)
        .draw()?;

    Ok(())
}

/// Ranges of x and y that contain every point, with the same scale on both axes.
fn ranges(plot: &PathPlot) -> (std::ops::Range<f64>, std::ops::Range<f64>) {
    let places = [plot.source, plot.target];
    let posed = plot
        .requested
        .iter()
        .chain(&plot.retrieved)
        .chain(&places)
        .map(|at| [at[0], at[1]]);

    let points: Vec<[f64; 2]> = plot.map.iter().copied().chain(posed).collect();

    // Center and half width of an axis, with a margin of 25 cm; the full width is at least 1 m.
    let span = |axis: usize| {
        let low = points
            .iter()
            .map(|at| at[axis])
            .fold(f64::INFINITY, f64::min);

        let high = points
            .iter()
            .map(|at| at[axis])
            .fold(f64::NEG_INFINITY, f64::max);

        ((low + high) / 2.0, (high - low).max(0.5) / 2.0 + 0.25)
    };

    let (x, half_x) = span(0);
    let (y, half_y) = span(1);

    // The plot area inside the margins and labels is about 830 × 600 pixels. Widen the shorter
    // range until a metre has the same length on both axes.
    let aspect = 830.0 / 600.0;
    let half_y = half_y.max(half_x / aspect);
    let half_x = half_y * aspect;

    (x - half_x..x + half_x, y - half_y..y + half_y)
}

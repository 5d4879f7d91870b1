//! Formatting of numbers and curves for the sections.

use seese3_core::statistics::{deviation, mean_of_known};

use super::Error;
use crate::report::{Curves, curves_svg};

/// The mean of the defined values and, for several values, the sample standard deviation, as text.
pub fn spread(values: &[f64]) -> String {
    let middle = mean_of_known(values);
    if values.len() > 1 {
        format!("{middle:.2} ± {:.2}", deviation(values))
    } else {
        format!("{middle:.2}")
    }
}

/// Draws curves as an SVG file.
pub fn plotted(curves: &Curves) -> Result<Vec<u8>, Error> {
    let svg = curves_svg(curves).map_err(|problem| Error::Rendering(problem.into()))?;
    Ok(svg.into_bytes())
}

//! R² of the adapter and of the alternative formulations, in the layout of the paper's table (Sec.
//! A.5).

use super::table::Table;
use crate::experiments::formulations::{Comparison, FormulationScores};
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{deviation, mean_of_known};

/// R² by part of the motion, in the order of tables.
pub(super) const PARTS: [fn(&MotionScores) -> f64; 4] = [
    |scores| scores.translation,
    |scores| scores.rotation,
    |scores| scores.direction,
    |scores| scores.magnitude,
];

/// One line per formulation: R² by part of the motion, averaged over seeds, and the sample standard
/// deviation of the overall R². The last line is the constant baseline.
pub fn formulations_table(comparison: &Comparison) -> Table {
    let mut table = Table::new("formulation | overall | transl. | rotation | direct. | magnit.");
    add_formulations(&mut table, comparison, 3, |_| None);
    table
}

/// Adds the rows of [`formulations_table`] to a table with other titles, with one more cell of each formulation.
pub fn add_formulations(
    table: &mut Table,
    comparison: &Comparison,
    decimals: usize,
    last: impl Fn(&FormulationScores) -> Option<String>,
) {
    for score in &comparison.formulations {
        // One value per seed, already averaged over the rooms.
        let column = |of: fn(&MotionScores) -> f64| score.runs.iter().map(of).collect::<Vec<f64>>();
        let parts = PARTS.map(|of| format!("{:.decimals$}", mean_of_known(&column(of))));
        let overall = spread_text(&column(|run| run.overall), decimals);
        let cells = std::iter::once(overall).chain(parts);
        table.row(score.name, cells.chain(last(score)));
    }

    let constant = format!("{:.decimals$}", comparison.constant_r2);
    table.row("mean training motion", [constant]);
}

/// The mean of the defined values and, for several values, the sample standard deviation, as text.
pub fn spread_text(values: &[f64], decimals: usize) -> String {
    let middle = format!("{:.decimals$}", mean_of_known(values));
    if values.len() > 1 {
        format!("{middle} ± {:.decimals$}", deviation(values))
    } else {
        middle
    }
}

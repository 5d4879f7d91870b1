//! R² of the adapter and of the alternative formulations, in the layout of the paper's table (Sec.
//! A.5).

use serde::Serialize;

use super::json::{MotionJson, PartsJson};
use super::table::aligned;
use crate::experiments::formulations::{Comparison, FormulationScores};
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{deviation, mean_of_known};

/// One line per formulation: R² by part of the motion, averaged over seeds, and the sample standard
/// deviation of the overall R². The last line is the constant baseline.
pub fn formulations_table(comparison: &Comparison) -> String {
    let head = [
        "formulation",
        "overall",
        "transl.",
        "rotation",
        "direct.",
        "magnit.",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for score in &comparison.formulations {
        let column = |of: fn(&MotionScores) -> f64| score.runs.iter().map(of).collect::<Vec<f64>>();
        let overall = column(|run| run.overall);

        // A single seed has no standard deviation.
        let spread = if overall.len() > 1 {
            format!(" ± {:.3}", deviation(&overall))
        } else {
            String::new()
        };

        let parts = [
            column(|run| run.translation),
            column(|run| run.rotation),
            column(|run| run.direction),
            column(|run| run.magnitude),
        ];

        let mut cells = vec![
            score.name.to_owned(),
            format!("{:.3}{spread}", mean_of_known(&overall)),
        ];
        cells.extend(
            parts
                .iter()
                .map(|part| format!("{:.3}", mean_of_known(part))),
        );

        lines.push(cells);
    }

    lines.push(vec![
        "mean training motion".to_owned(),
        format!("{:.3}", comparison.constant_r2),
    ]);

    aligned(&lines)
}

/// The JSON record of `seese3 sweep formulations`, one entry per formulation.
#[derive(Debug, Serialize)]
pub struct FormulationsJson {
    formulations: Vec<FormulationJson>,
    /// R² of the constant baseline (the mean training motion), averaged over rooms.
    constant_r2: f64,
}

#[derive(Debug, Serialize)]
struct FormulationJson {
    name: &'static str,
    by_part: PartsJson,
    runs: Vec<MotionJson>,
}

/// Builds the JSON record of a comparison.
pub fn formulations_json(comparison: &Comparison) -> FormulationsJson {
    let entry = |score: &FormulationScores| FormulationJson {
        name: score.name,
        by_part: PartsJson::of(&score.runs),
        runs: score.runs.iter().map(MotionJson::from).collect(),
    };

    FormulationsJson {
        formulations: comparison.formulations.iter().map(entry).collect(),
        constant_r2: comparison.constant_r2,
    }
}

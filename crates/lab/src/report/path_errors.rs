//! Absolute and relative pose errors (APE and RPE) of an estimated path, with their formulas.

use std::collections::BTreeMap;

use serde::Serialize;
use strum::VariantArray;

use super::table::aligned;
use crate::experiments::path_comparison::PathComparison;
use seese3_core::trajectory::{Error, Relation, RpePairs, Statistics};

/// Definition of the absolute pose error, printed with the results.
pub const APE_FORMULA: &str = "APE: E_i = est_i⁻¹ ref_i after alignment; translation ‖t(E)‖ in metres, rotation ∠E in \
                               radians, full ‖E − I‖_F; poses world_from_camera";
/// Definition of the relative pose error, printed with the results.
pub const RPE_FORMULA: &str =
    "RPE: E_i = (ref_i⁻¹ ref_j)⁻¹ (est_i⁻¹ est_j), j = i + Δ poses; no alignment";

/// One line per error and relation: root mean square, mean, median, standard deviation, smallest
/// and largest value, and count. The formulas follow the table.
pub fn path_errors_table(errors: &PathComparison) -> String {
    let head = [
        "error", "part", "rmse", "mean", "median", "sd", "least", "largest", "n",
    ];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    // Undefined errors are listed below the table, each with the reason.
    let mut undefined = String::new();
    for (name, found) in rows(errors) {
        match found {
            Ok(found) => {
                for (statistics, relation) in found.iter().zip(Relation::VARIANTS) {
                    let s = statistics;
                    let numbers = [s.rmse, s.mean, s.median, s.deviation, s.least, s.largest];
                    let cells = numbers.map(|number| format!("{number:.6}"));
                    let start = [name.clone(), relation.to_string()];

                    lines.push(
                        start
                            .into_iter()
                            .chain(cells)
                            .chain([s.count.to_string()])
                            .collect(),
                    );
                }
            }
            Err(why) => undefined.push_str(&format!("{name}: none, {why}\n")),
        }
    }

    format!(
        "{}{undefined}{APE_FORMULA}\n{RPE_FORMULA}\n",
        aligned(&lines)
    )
}

fn rows(errors: &PathComparison) -> Vec<(String, &Result<[Statistics; 3], Error>)> {
    let absolute = errors
        .absolute
        .iter()
        .map(|(alignment, found)| (format!("APE {alignment}"), found));
    let relative = format!("RPE Δ {}", errors.protocol.delta);

    absolute.chain([(relative, &errors.relative)]).collect()
}

/// The JSON record of `seese3 evaluate trajectory`, with its settings and formulas.
#[derive(Debug, Serialize)]
pub struct PathErrorsJson {
    matched: usize,
    unmatched_reference: usize,
    unmatched_estimate: usize,
    /// Absolute errors by alignment.
    ape: BTreeMap<&'static str, ErrorsJson>,
    ape_formula: &'static str,
    rpe: ErrorsJson,
    rpe_formula: &'static str,
    rpe_delta_poses: usize,
    rpe_all_pairs: bool,
}

#[derive(Debug, Serialize)]
#[serde(untagged)]
enum ErrorsJson {
    /// Statistics by relation.
    Found(BTreeMap<&'static str, StatisticsJson>),
    /// These errors are undefined for the path.
    Undefined { undefined: String },
}

#[derive(Debug, Serialize)]
struct StatisticsJson {
    rmse: f64,
    mean: f64,
    median: f64,
    std: f64,
    min: f64,
    max: f64,
    sse: f64,
    n: usize,
}

/// Builds the JSON record of a path's errors.
pub fn path_errors_json(errors: &PathComparison) -> PathErrorsJson {
    PathErrorsJson {
        matched: errors.matched,
        unmatched_reference: errors.unmatched_reference,
        unmatched_estimate: errors.unmatched_estimate,
        ape: errors
            .absolute
            .iter()
            .map(|(alignment, found)| (alignment.into(), errors_json(found)))
            .collect(),
        ape_formula: APE_FORMULA,
        rpe: errors_json(&errors.relative),
        rpe_formula: RPE_FORMULA,
        rpe_delta_poses: errors.protocol.delta,
        rpe_all_pairs: errors.protocol.pairs == RpePairs::All,
    }
}

fn errors_json(found: &Result<[Statistics; 3], Error>) -> ErrorsJson {
    let statistics = |s: &Statistics| StatisticsJson {
        rmse: s.rmse,
        mean: s.mean,
        median: s.median,
        std: s.deviation,
        min: s.least,
        max: s.largest,
        sse: s.sum_of_squares,
        n: s.count,
    };

    match found {
        Ok(found) => {
            let named = Relation::VARIANTS.iter().zip(found);
            ErrorsJson::Found(
                named
                    .map(|(relation, found)| (relation.into(), statistics(found)))
                    .collect(),
            )
        }
        Err(why) => ErrorsJson::Undefined {
            undefined: why.to_string(),
        },
    }
}

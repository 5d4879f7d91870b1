//! Absolute and relative pose errors (APE and RPE) of an estimated path, with their formulas.

use std::collections::BTreeMap;
use strum::VariantArray;

use serde::Serialize;

use super::table::{Table, fixed};
use crate::experiments::path_comparison::PathComparison;
use seese3_core::trajectory::{Error, Relation, RpePairs, Statistics};

/// Definition of the absolute pose error, printed with the results.
pub const APE_FORMULA: &str = "APE: E_i = est_i⁻¹ ref_i after alignment; translation ‖t(E)‖ in meters, rotation ∠E in \
                               radians, full ‖E − I‖_F; poses world_from_camera";
/// Definition of the relative pose error, printed with the results.
pub const RPE_FORMULA: &str =
    "RPE: E_i = (ref_i⁻¹ ref_j)⁻¹ (est_i⁻¹ est_j), j = i + Δ poses; no alignment";

/// One line per error and relation: root mean square, mean, median, standard deviation, smallest
/// and largest value, and count; and the notes below the table: undefined errors
/// and the formulas.
pub fn path_errors_table(errors: &PathComparison) -> (Table, String) {
    let mut table = Table::new("error | part | rmse | mean | median | sd | least | largest | n");

    // Undefined errors are listed below the table, each with the reason.
    let mut undefined = String::new();
    for (name, found) in rows(errors) {
        let found = match found {
            Ok(found) => found,
            Err(why) => {
                undefined.push_str(&format!("{name}: none, {why}\n"));
                continue;
            }
        };

        for (s, relation) in found.iter().zip(Relation::VARIANTS) {
            let numbers = [s.rmse, s.mean, s.median, s.deviation, s.least, s.largest];
            let cells = std::iter::once(relation.to_string()).chain(fixed(numbers, 6));
            table.row(&name, cells.chain([s.count.to_string()]));
        }
    }

    (table, format!("{undefined}{APE_FORMULA}\n{RPE_FORMULA}"))
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
    Found(BTreeMap<&'static str, Statistics>),
    /// These errors are undefined for the path.
    Undefined { undefined: String },
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
    match found {
        Ok(found) => {
            let named = Relation::VARIANTS.iter().zip(found);
            let named = named.map(|(relation, found)| (relation.into(), *found));
            ErrorsJson::Found(named.collect())
        }
        Err(why) => ErrorsJson::Undefined {
            undefined: why.to_string(),
        },
    }
}

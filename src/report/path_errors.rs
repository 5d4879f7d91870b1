//! APE and RPE of a path, with the formulas they are by.

use serde_json::{Map, Value, json};

use super::table::aligned;
use crate::trajectory::{
    Alignment, Error, Matches, Relation, RpePairs, Statistics, Trajectory, ape, rpe,
};

/// E of the absolute error.
pub const APE_FORMULA: &str = "APE: E_i = est_i⁻¹ ref_i after alignment; translation ‖t(E)‖ in metres, rotation ∠E in \
                               radians, full ‖E − I‖_F; poses world_from_camera";
/// E of the relative error.
pub const RPE_FORMULA: &str =
    "RPE: E_i = (ref_i⁻¹ ref_j)⁻¹ (est_i⁻¹ est_j), j = i + Δ poses; no alignment";

/// How paths are compared.
#[derive(Debug, Clone, Copy)]
pub struct PathProtocol {
    /// Poses over which a relative error is taken.
    pub delta: usize,
    /// Which pairs of them.
    pub pairs: RpePairs,
}

/// Errors of one estimated path.
#[derive(Debug, Clone)]
pub struct PathErrors {
    /// Of the pairs that were compared, and how many there were of each.
    pub matched: usize,
    /// Poses of the reference that no estimate belongs to.
    pub unmatched_reference: usize,
    /// Poses of the estimate that belong to no reference.
    pub unmatched_estimate: usize,
    /// By alignment and relation; an alignment that the path does not determine says why.
    pub absolute: Vec<(Alignment, Result<[Statistics; 3], Error>)>,
    /// By relation.
    pub relative: Result<[Statistics; 3], Error>,
    /// How they were taken.
    pub protocol: PathProtocol,
}

impl PathErrors {
    /// Of the poses that belong together.
    ///
    /// # Errors
    /// [`Error`] of comparing them.
    pub fn of(
        reference: &Trajectory,
        estimate: &Trajectory,
        matches: &Matches,
        protocol: PathProtocol,
    ) -> Result<Self, Error> {
        let of_reference = reference.select(&matches.reference);
        let of_estimate = estimate.select(&matches.estimate);
        let mut absolute = Vec::new();
        for alignment in Alignment::ALL {
            let errors = match alignment.apply(&of_reference, &of_estimate) {
                Ok(aligned) => {
                    let mut by_relation = [Statistics::of(&[]); 3];
                    for (statistics, relation) in by_relation.iter_mut().zip(Relation::ALL) {
                        *statistics = Statistics::of(&ape(&of_reference, &aligned, relation)?);
                    }

                    Ok(by_relation)
                }
                Err(error) => Err(error),
            };

            absolute.push((alignment, errors));
        }

        let relative = Relation::ALL
            .map(|relation| {
                rpe(
                    &of_reference,
                    &of_estimate,
                    relation,
                    protocol.delta,
                    protocol.pairs,
                )
            })
            .into_iter()
            .map(|errors| errors.map(|errors| Statistics::of(&errors)))
            .collect::<Result<Vec<_>, Error>>()
            .map(|found| [found[0], found[1], found[2]]);

        let distinct = |places: &[usize]| {
            places
                .iter()
                .collect::<std::collections::BTreeSet<_>>()
                .len()
        };

        Ok(Self {
            matched: matches.reference.len(),
            unmatched_reference: reference.len() - distinct(&matches.reference),
            unmatched_estimate: estimate.len() - distinct(&matches.estimate),
            absolute,
            relative,
            protocol,
        })
    }

    fn rows(&self) -> Vec<(String, &Result<[Statistics; 3], Error>)> {
        let absolute = self
            .absolute
            .iter()
            .map(|(alignment, errors)| (format!("APE {}", alignment.name()), errors));
        absolute
            .chain([(format!("RPE Δ {}", self.protocol.delta), &self.relative)])
            .collect()
    }
}

/// A line an error and relation: root mean square, mean, median, deviation, least, largest.
pub fn path_errors_table(errors: &PathErrors) -> String {
    let head = [
        "error", "part", "rmse", "mean", "median", "sd", "least", "largest", "n",
    ];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    let mut undefined = String::new();
    for (name, found) in errors.rows() {
        match found {
            Ok(found) => {
                for (statistics, relation) in found.iter().zip(Relation::ALL) {
                    let s = statistics;
                    let numbers = [s.rmse, s.mean, s.median, s.deviation, s.least, s.largest];
                    let cells = numbers.map(|number| format!("{number:.6}"));
                    let start = [name.clone(), relation.name().to_owned()];

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

/// The same as JSON.
pub fn path_errors_json(errors: &PathErrors) -> Value {
    let statistics = |s: &Statistics| {
        json!({ "rmse": s.rmse, "mean": s.mean, "median": s.median, "std": s.deviation, "min": s.least,
            "max": s.largest, "sse": s.sum_of_squares, "n": s.count })
    };

    let parts = |found: &Result<[Statistics; 3], Error>| match found {
        Ok(found) => {
            let named = Relation::ALL
                .iter()
                .zip(found)
                .map(|(relation, s)| (relation.name().to_owned(), statistics(s)));
            Value::Object(named.collect::<Map<_, _>>())
        }
        Err(why) => json!({ "undefined": why.to_string() }),
    };

    let absolute: Map<String, Value> = errors
        .absolute
        .iter()
        .map(|(alignment, found)| (alignment.name().to_owned(), parts(found)))
        .collect();

    json!({
        "matched": errors.matched,
        "unmatched_reference": errors.unmatched_reference,
        "unmatched_estimate": errors.unmatched_estimate,
        "ape": absolute,
        "ape_formula": APE_FORMULA,
        "rpe": parts(&errors.relative),
        "rpe_formula": RPE_FORMULA,
        "rpe_delta_poses": errors.protocol.delta,
        "rpe_all_pairs": errors.protocol.pairs == RpePairs::All,
    })
}

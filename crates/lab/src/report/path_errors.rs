//! Absolute and relative pose errors (APE and RPE) of an estimated path, with their formulas.

use serde_json::{Map, Value, json};

use super::table::aligned;
use seese3_core::trajectory::{
    Alignment, Error, Matches, Relation, RpePairs, Statistics, Trajectory, ape, rpe,
};

/// Definition of the absolute pose error, as it is printed with the results.
pub const APE_FORMULA: &str = "APE: E_i = est_i⁻¹ ref_i after alignment; translation ‖t(E)‖ in metres, rotation ∠E in \
                               radians, full ‖E − I‖_F; poses world_from_camera";
/// Definition of the relative pose error, as it is printed with the results.
pub const RPE_FORMULA: &str =
    "RPE: E_i = (ref_i⁻¹ ref_j)⁻¹ (est_i⁻¹ est_j), j = i + Δ poses; no alignment";

/// Settings of the relative pose error.
#[derive(Debug, Clone, Copy)]
pub struct PathProtocol {
    /// Δ, the number of poses from the start of a relative motion to its end.
    pub delta: usize,
    /// Which pairs of poses that are Δ apart are compared.
    pub pairs: RpePairs,
}

/// Errors of one estimated path.
#[derive(Debug, Clone)]
pub struct PathErrors {
    /// Number of pose pairs that were compared.
    pub matched: usize,
    /// Poses of the reference that have no matching estimate.
    pub unmatched_reference: usize,
    /// Poses of the estimate that have no matching reference.
    pub unmatched_estimate: usize,
    /// Absolute errors by alignment, one entry per relation of [`Relation::ALL`]. An alignment that
    /// the path does not determine holds the reason instead.
    pub absolute: Vec<(Alignment, Result<[Statistics; 3], Error>)>,
    /// Relative errors, one entry per relation of [`Relation::ALL`], or why there are none.
    pub relative: Result<[Statistics; 3], Error>,
    /// The settings of the relative error.
    pub protocol: PathProtocol,
}

impl PathErrors {
    /// The errors of the associated poses, with each alignment.
    ///
    /// # Errors
    /// [`Error`] if `matches` does not hold as many poses of the one path as of the other. An error
    /// that is undefined for another reason is kept in the result.
    pub fn of(
        reference: &Trajectory,
        estimate: &Trajectory,
        matches: &Matches,
        protocol: PathProtocol,
    ) -> Result<Self, Error> {
        let of_reference = reference.select(&matches.reference);
        let of_estimate = estimate.select(&matches.estimate);
        let mut absolute = Vec::new();

        // An alignment may be undefined, as for positions on a line; the others are still
        // reported.
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

        // Relative errors do not depend on the choice of the world frame and need no alignment.
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

        // A pose may be matched more than once: several estimates can be nearest to one
        // reference.
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

/// One line per error and relation: root mean square, mean, median, standard deviation, smallest
/// and largest value, and count. The formulas stand below.
pub fn path_errors_table(errors: &PathErrors) -> String {
    let head = [
        "error", "part", "rmse", "mean", "median", "sd", "least", "largest", "n",
    ];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    // Errors that the path does not determine are listed with their reason below the table.
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

/// The errors as JSON, with the settings and formulas that define them.
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

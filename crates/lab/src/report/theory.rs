//! Numeric checks of the paper's theorems, as a table and as JSON.

use serde::Serialize;

use super::table::aligned;
use crate::theory::{Bound, Check};

/// One line per check: the measured value and its bound.
pub fn theory_table(checks: &[Check]) -> String {
    aligned(&theory_table_rows(checks))
}

/// The cells of [`theory_table`], header row first.
pub fn theory_table_rows(checks: &[Check]) -> Vec<Vec<String>> {
    let head = ["theorem: what", "measured", "bound", ""];
    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for check in checks {
        let measured = number(check.measured);
        let verdict = if check.holds() { "" } else { "NOT KEPT" };
        let what = format!("{}: {}", check.theorem, check.what);

        lines.push(vec![
            what,
            measured,
            bound_text(check.bound),
            verdict.to_owned(),
        ]);
    }

    lines
}

fn number(value: f64) -> String {
    if value != 0.0 && value.abs() < 1e-3 {
        format!("{value:.1e}")
    } else {
        format!("{value:.4}")
    }
}

fn bound_text(bound: Bound) -> String {
    match bound {
        Bound::AtMost(most) => format!("≤ {}", number(most)),
        Bound::AtLeast(least) => format!("≥ {}", number(least)),
        Bound::Equals(value, tolerance) => format!("{} ± {}", number(value), number(tolerance)),
        Bound::Between(low, high) => format!("{} to {}", number(low), number(high)),
        Bound::Free => "–".to_owned(),
    }
}

/// The JSON record of `seese3 theory`, one entry per check.
#[derive(Debug, Serialize)]
pub struct TheoryJson {
    checks: Vec<CheckJson>,
}

#[derive(Debug, Serialize)]
struct CheckJson {
    theorem: String,
    what: String,
    measured: f64,
    /// The bound in words.
    bound: String,
    holds: bool,
}

/// Builds the JSON record of checks.
pub fn theory_json(checks: &[Check]) -> TheoryJson {
    let entry = |check: &Check| CheckJson {
        theorem: check.theorem.to_string(),
        what: check.what.to_string(),
        measured: check.measured,
        bound: bound_text(check.bound),
        holds: check.holds(),
    };

    TheoryJson {
        checks: checks.iter().map(entry).collect(),
    }
}

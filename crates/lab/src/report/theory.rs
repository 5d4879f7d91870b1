//! The numeric checks of the paper's theorems, as a table and as JSON.

use serde_json::{Value, json};

use super::table::aligned;
use crate::theory::{Bound, Check};

/// One line per check: the measured value and the bound that it has to keep.
pub fn theory_table(checks: &[Check]) -> String {
    aligned(&theory_table_rows(checks))
}

/// The cells of [`theory_table`], the head first.
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

/// The checks as JSON, one entry each.
pub fn theory_json(checks: &[Check]) -> Value {
    let entry = |check: &Check| {
        json!({
            "theorem": check.theorem,
            "what": check.what,
            "measured": check.measured,
            "bound": bound_text(check.bound),
            "holds": check.holds(),
        })
    };

    json!({ "checks": checks.iter().map(entry).collect::<Vec<_>>() })
}

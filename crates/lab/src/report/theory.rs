//! Numeric checks of the paper's theorems, as a table and as JSON.

use serde::Serialize;

use super::table::Column::Text;
use super::table::Table;
use crate::theory::{Bound, Check};

/// One line per check: the measured value and its bound.
pub fn theory_table(checks: &[Check]) -> Table {
    Table::of(
        checks,
        &[
            Text("theorem: what", |check| {
                format!("{}: {}", check.theorem, check.what)
            }),
            Text("measured", |check| number(check.measured)),
            Text("bound", |check| {
                let remark = if check.holds() { "" } else { " NOT KEPT" };
                bound_text(check.bound) + remark
            }),
        ],
    )
}

/// What `--plot` draws: where each measured value lies within its bound. From 0 to 1 the bound
/// holds: 1 is the upper bound, or a lower bound over the value.
pub fn theory_plot(checks: &[Check]) -> Table {
    let within = |value: f64, low: f64, high: f64| (value - low) / (high - low);
    let share = |check: &Check| match check.bound {
        Bound::AtMost(most) => Some(check.measured / most),
        Bound::AtLeast(least) => Some(least / check.measured),
        Bound::Equals(value, tolerance) => {
            Some(within(check.measured, value - tolerance, value + tolerance))
        }
        Bound::Between(low, high) => Some(within(check.measured, low, high)),
        Bound::Free => None,
    };

    let mut table = Table::new("theorem: what | within its bound, 0 to 1");
    for check in checks {
        if let Some(share) = share(check) {
            let name = format!("{}: {}", check.theorem, check.what);
            table.row(name, [format!("{share:.4}")]);
        }
    }
    table
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
    theorem: &'static str,
    what: &'static str,
    measured: f64,
    /// The bound in words.
    bound: String,
    holds: bool,
}

/// Builds the JSON record of checks.
pub fn theory_json(checks: &[Check]) -> TheoryJson {
    let entry = |check: &Check| CheckJson {
        theorem: check.theorem,
        what: check.what,
        measured: check.measured,
        bound: bound_text(check.bound),
        holds: check.holds(),
    };

    TheoryJson {
        checks: checks.iter().map(entry).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn a_plot_shows_where_in_its_bound_a_value_lies() {
        let check = |measured, bound| Check {
            theorem: "1",
            what: "a",
            measured,
            bound,
        };
        let checks = [
            check(1.0, Bound::AtMost(4.0)),
            check(4.0, Bound::AtLeast(2.0)),
            check(2.0, Bound::Equals(2.0, 0.1)),
            check(6.0, Bound::Between(1.0, 5.0)),
            check(1.0, Bound::Free),
        ];
        let drawn = theory_plot(&checks);
        let shares: Vec<&str> = drawn.rows().iter().map(|row| row[1].as_str()).collect();
        assert_eq!(shares, ["0.2500", "0.5000", "0.5000", "1.2500"]);
    }
}

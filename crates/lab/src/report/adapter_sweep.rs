//! Tables of a sweep over adapters: one row per run, and the paper's tables from these rows.

use std::collections::BTreeMap;

use super::Error;
use super::columns::ParquetColumn::{Real, Text, Whole};
use super::columns::parquet_file;
use super::table::Table;
use crate::experiments::adapter_sweep::SweepRow;
use seese3_core::statistics::{deviation, mean, mean_of_known};

/// The rows as the bytes of a Parquet file, one column per field.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects a column.
pub fn sweep_parquet(rows: &[SweepRow]) -> Result<Vec<u8>, Error> {
    // The columns have no nulls: a missing score is NaN in the file.
    parquet_file(
        rows,
        &[
            ("key", Text(|row| &row.key)),
            ("room", Text(|row| &row.room)),
            ("room_revision", Whole(|row| row.room_revision)),
            ("format", Text(|row| &row.format)),
            ("frames", Whole(|row| row.frames as u64)),
            ("features", Text(|row| &row.features)),
            ("preset", Text(|row| &row.preset)),
            ("split", Text(|row| &row.split)),
            ("stride", Whole(|row| u64::from(row.stride))),
            ("geo_dim", Whole(|row| row.geo_dim as u64)),
            ("charts", Whole(|row| row.charts as u64)),
            ("mixing", Text(|row| &row.mixing)),
            ("pairs", Text(|row| &row.pairs)),
            ("lr", Real(|row| row.lr)),
            ("loss", Text(|row| &row.loss)),
            ("epochs", Whole(|row| row.epochs as u64)),
            ("batch", Whole(|row| row.batch as u64)),
            ("weight_decay", Real(|row| row.weight_decay)),
            ("hidden", Whole(|row| row.hidden as u64)),
            ("seed", Whole(|row| row.seed)),
            ("n", Whole(|row| row.n as u64)),
            ("r2_overall", Real(|row| row.overall.unwrap_or(f64::NAN))),
            (
                "r2_translation",
                Real(|row| row.translation.unwrap_or(f64::NAN)),
            ),
            ("r2_rotation", Real(|row| row.rotation.unwrap_or(f64::NAN))),
            (
                "r2_direction",
                Real(|row| row.direction.unwrap_or(f64::NAN)),
            ),
            (
                "r2_magnitude",
                Real(|row| row.magnitude.unwrap_or(f64::NAN)),
            ),
            (
                "r2_train",
                Real(|row| row.train_overall.unwrap_or(f64::NAN)),
            ),
            ("seconds", Real(|row| row.seconds)),
            ("failure", Text(|row| &row.failure)),
        ],
    )
}

/// The paper's success table (Sec. 5): by recording format and features, the best R² and the
/// percentage of rooms above 0 and 0.3. A room's score is that of its best run, chosen by test
/// score, as in the paper's "Max R²".
pub fn success_table(rows: &[SweepRow]) -> Table {
    let mut groups: BTreeMap<[&str; 2], BTreeMap<&str, f64>> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.failure.is_empty()) {
        // A room without a defined R² still counts, as a failure.
        let rooms = groups.entry([&row.format, &row.features]).or_default();
        let best = rooms.entry(&row.room).or_insert(f64::NEG_INFINITY);
        *best = best.max(row.overall.unwrap_or(f64::NEG_INFINITY));
    }

    let mut table = Table::new("recorded as | features | rooms | max R² | % > 0 | % > 0.3");
    for ([format, features], rooms) in groups {
        let best: Vec<f64> = rooms.into_values().collect();
        let cells = [
            features.to_owned(),
            best.len().to_string(),
            highest(&best),
            percent(&best, 0.0),
            percent(&best, 0.3),
        ];
        table.row(format, cells);
    }

    table
}

/// The paper's difficulty table (Sec. A.4), by recording format over all features. It has the mean
/// numbers of frames and of test pairs per room, the percentage of rooms with a best run above 0,
/// and the R² of the best run.
pub fn difficulty_table(rows: &[SweepRow]) -> Table {
    let mut groups: BTreeMap<&str, BTreeMap<&str, Vec<&SweepRow>>> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.failure.is_empty()) {
        let rooms = groups.entry(&row.format).or_default();
        rooms.entry(&row.room).or_default().push(row);
    }

    let mut table = Table::new("recorded as | rooms | frames | test pairs | % > 0 | best R²");
    for (format, rooms) in groups {
        let over_rooms = |of: fn(&[&SweepRow]) -> f64| {
            let values = rooms.values().map(|runs| of(runs));
            values.collect::<Vec<f64>>()
        };
        let frames = over_rooms(|runs| runs[0].frames as f64);
        let pairs = over_rooms(|runs| runs.iter().map(|run| run.n).max().unwrap_or(0) as f64);
        let best = over_rooms(|runs| {
            let scores = runs.iter().filter_map(|run| run.overall);
            scores.fold(f64::NEG_INFINITY, f64::max)
        });

        let cells = [
            rooms.len().to_string(),
            format!("{:.0}", mean(&frames)),
            format!("{:.0}", mean(&pairs)),
            percent(&best, 0.0),
            highest(&best),
        ];
        table.row(format, cells);
    }

    table
}

/// The paper's sweep table: by part of the motion, the best R², the percentage of runs above 0 and
/// 0.5, and the standard deviation over seeds. The deviation is averaged over all combinations of
/// room, split, stride and configuration with several seeds.
pub fn parts_table(rows: &[SweepRow]) -> Table {
    type Part = fn(&SweepRow) -> Option<f64>;

    let parts: [(&str, Part); 5] = [
        ("overall", |row| row.overall),
        ("rotation", |row| row.rotation),
        ("translation", |row| row.translation),
        ("direction", |row| row.direction),
        ("magnitude", |row| row.magnitude),
    ];

    let mut table = Table::new("part | runs | best R² | % > 0 | % > 0.5 | sd over seeds | mean R²");
    for (name, part) in parts {
        // Failed runs have no scores and drop out here.
        let values: Vec<f64> = rows.iter().filter_map(part).collect();
        let mut by_configuration: BTreeMap<_, Vec<f64>> = BTreeMap::new();
        for row in rows {
            let seeds = by_configuration
                .entry((&row.room, &row.split, row.stride, row.configuration()))
                .or_default();
            seeds.extend(part(row));
        }

        // A single seed has no spread; use only rooms and configurations with several seeds.
        let spreads: Vec<f64> = by_configuration
            .values()
            .filter(|seeds| seeds.len() > 1)
            .map(|seeds| deviation(seeds))
            .collect();
        let spread = (!spreads.is_empty()).then(|| format!("{:.3}", mean_of_known(&spreads)));

        let cells = [
            values.len().to_string(),
            highest(&values),
            percent(&values, 0.0),
            percent(&values, 0.5),
            spread.unwrap_or("–".to_owned()),
            format!("{:.3}", mean(&values)),
        ];
        table.row(name, cells);
    }

    table
}

/// The `most` best configurations by mean R² over rooms and seeds, best first.
pub fn configurations_table(rows: &[SweepRow], most: usize) -> Table {
    let mut by_configuration: BTreeMap<_, Vec<f64>> = BTreeMap::new();
    for row in rows {
        let scores = by_configuration.entry(row.configuration()).or_default();
        scores.extend(row.overall);
    }

    // A configuration whose runs all failed has no mean and cannot be ranked.
    let mut ranked: Vec<_> = by_configuration
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .collect();
    ranked.sort_by(|a, b| mean_of_known(&b.1).total_cmp(&mean_of_known(&a.1)));

    let mut table = Table::new("features | geo_dim | K | lr | loss | runs | mean R² | sd");
    for ((geo_dim, charts, lr, loss, features), values) in ranked.into_iter().take(most) {
        let spread = (values.len() > 1).then(|| format!("{:.3}", deviation(&values)));
        let cells = [
            geo_dim.to_string(),
            charts.to_string(),
            lr,
            loss,
            values.len().to_string(),
            format!("{:.3}", mean_of_known(&values)),
            spread.unwrap_or_default(),
        ];
        table.row(features, cells);
    }

    table
}

fn highest(values: &[f64]) -> String {
    let highest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    format!("{highest:.3}")
}

fn percent(values: &[f64], above: f64) -> String {
    let count = values.iter().filter(|&&value| value > above).count();
    format!("{:.0}", 100.0 * count as f64 / values.len().max(1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(room: &str, seed: u64, overall: Option<f64>) -> SweepRow {
        SweepRow {
            room: room.to_owned(),
            format: "tum".to_owned(),
            frames: 200,
            features: "f".to_owned(),
            seed,
            n: 40,
            overall,
            translation: overall,
            rotation: overall,
            magnitude: overall,
            ..SweepRow::default()
        }
    }

    /// Oracle: by hand. A room's score is that of its best run; failed runs are skipped.
    #[test]
    fn rooms_count_by_their_best_run() {
        let rows = [
            row("a", 0, Some(-1.0)),
            row("a", 1, Some(0.4)),
            row("b", 0, Some(-0.5)),
            row("b", 1, None),
        ];

        assert_eq!(
            success_table(&rows).cells(0),
            ["tum", "f", "2", "0.400", "50", "50"]
        );

        assert_eq!(
            difficulty_table(&rows).cells(0),
            ["tum", "2", "200", "40", "50", "0.400"]
        );

        // The seeds of room a deviate by 1.4/√2; room b has only one successful seed.
        assert_eq!(
            parts_table(&rows).cells(0),
            ["overall", "3", "0.400", "33", "0", "0.990", "-0.367"]
        );
    }

    /// Oracle: the format's magic at both ends; `.ci/claims.py` has pandas read a file.
    #[test]
    fn rows_become_a_parquet_file() {
        let file = sweep_parquet(&[row("a", 0, Some(0.5)), row("b", 0, None)]).unwrap();
        assert!(file.starts_with(b"PAR1") && file.ends_with(b"PAR1"));
    }
}

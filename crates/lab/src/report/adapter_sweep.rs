//! Tables of a sweep over adapters: one row per run, and the paper's tables from these rows.

use std::collections::BTreeMap;

use super::Error;
use super::columns::{Column, parquet_file};
use crate::experiments::adapter_sweep::SweepRow;
use seese3_core::statistics::{deviation, mean, mean_of_known};

/// The rows as the bytes of a Parquet file, one column per field.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects a column.
pub fn sweep_parquet(rows: &[SweepRow]) -> Result<Vec<u8>, Error> {
    // One closure per type of column, so that the list below reads as name and field.
    let text = |of: fn(&SweepRow) -> &str| {
        Column::Text(rows.iter().map(|row| of(row).to_owned()).collect())
    };

    let whole =
        |of: fn(&SweepRow) -> u64| Column::Whole(rows.iter().map(|row| of(row) as i64).collect());
    let real = |of: fn(&SweepRow) -> f64| Column::Real(rows.iter().map(of).collect());

    // The columns have no nulls: a missing score is NaN in the file.
    let known = |of: fn(&SweepRow) -> Option<f64>| {
        Column::Real(rows.iter().map(|row| of(row).unwrap_or(f64::NAN)).collect())
    };

    parquet_file(&[
        ("key", text(|row| &row.key)),
        ("room", text(|row| &row.room)),
        ("room_revision", whole(|row| row.room_revision)),
        ("format", text(|row| &row.format)),
        ("frames", whole(|row| row.frames as u64)),
        ("features", text(|row| &row.features)),
        ("preset", text(|row| &row.preset)),
        ("split", text(|row| &row.split)),
        ("stride", whole(|row| u64::from(row.stride))),
        ("geo_dim", whole(|row| row.geo_dim as u64)),
        ("charts", whole(|row| row.charts as u64)),
        ("mixing", text(|row| &row.mixing)),
        ("pairs", text(|row| &row.pairs)),
        ("lr", real(|row| row.lr)),
        ("loss", text(|row| &row.loss)),
        ("epochs", whole(|row| row.epochs as u64)),
        ("batch", whole(|row| row.batch as u64)),
        ("weight_decay", real(|row| row.weight_decay)),
        ("hidden", whole(|row| row.hidden as u64)),
        ("seed", whole(|row| row.seed)),
        ("n", whole(|row| row.n as u64)),
        ("r2_overall", known(|row| row.overall)),
        ("r2_translation", known(|row| row.translation)),
        ("r2_rotation", known(|row| row.rotation)),
        ("r2_direction", known(|row| row.direction)),
        ("r2_magnitude", known(|row| row.magnitude)),
        ("r2_train", known(|row| row.train_overall)),
        ("seconds", real(|row| row.seconds)),
        ("failure", text(|row| &row.failure)),
    ])
}

/// The paper's success table (Sec. 5): by recording format and features, the best R² and the
/// percentage of rooms above 0 and 0.3. A room's score is that of its best run, chosen by test
/// score, as in the paper's "Max R²".
pub fn success_rows(rows: &[SweepRow]) -> Vec<Vec<String>> {
    let mut groups: BTreeMap<(String, String), BTreeMap<String, f64>> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.failure.is_empty()) {
        // A room without a defined R² still counts, as a failure.
        let best = groups
            .entry((row.format.clone(), row.features.clone()))
            .or_default();
        let of_room = best.entry(row.room.clone()).or_insert(f64::NEG_INFINITY);
        *of_room = of_room.max(row.overall.unwrap_or(f64::NEG_INFINITY));
    }

    let head = [
        "recorded as",
        "features",
        "rooms",
        "max R²",
        "% > 0",
        "% > 0.3",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for ((format, features), rooms) in groups {
        let best: Vec<f64> = rooms.into_values().collect();
        lines.push(vec![
            format,
            features,
            best.len().to_string(),
            format!(
                "{:.3}",
                best.iter().copied().fold(f64::NEG_INFINITY, f64::max)
            ),
            percent(&best, 0.0),
            percent(&best, 0.3),
        ]);
    }

    lines
}

/// The paper's difficulty table (Sec. A.4), by recording format over all features. It has the mean
/// numbers of frames and of test pairs per room, the percentage of rooms with a best run above 0,
/// and the R² of the best run.
pub fn difficulty_rows(rows: &[SweepRow]) -> Vec<Vec<String>> {
    let mut groups: BTreeMap<&str, BTreeMap<&str, (usize, usize, f64)>> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.failure.is_empty()) {
        let rooms = groups.entry(&row.format).or_default();

        // Per room: frames, the largest number of test pairs of its runs, and the best R².
        let (_, pairs, best) = rooms
            .entry(&row.room)
            .or_insert((row.frames, 0, f64::NEG_INFINITY));
        *pairs = row.n.max(*pairs);

        *best = best.max(row.overall.unwrap_or(f64::NEG_INFINITY));
    }

    let head = [
        "recorded as",
        "rooms",
        "frames",
        "test pairs",
        "% > 0",
        "best R²",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for (format, rooms) in groups {
        let column =
            |of: fn(&(usize, usize, f64)) -> f64| rooms.values().map(of).collect::<Vec<_>>();
        let best = column(|room| room.2);

        lines.push(vec![
            format.to_owned(),
            rooms.len().to_string(),
            format!("{:.0}", mean(&column(|room| room.0 as f64))),
            format!("{:.0}", mean(&column(|room| room.1 as f64))),
            percent(&best, 0.0),
            format!(
                "{:.3}",
                best.iter().copied().fold(f64::NEG_INFINITY, f64::max)
            ),
        ]);
    }

    lines
}

/// The paper's sweep table: by part of the motion, the best R², the percentage of runs above 0 and
/// 0.5, and the standard deviation over seeds. The deviation is averaged over all combinations of
/// room, split, stride and configuration with several seeds.
pub fn parts_rows(rows: &[SweepRow]) -> Vec<Vec<String>> {
    type Part = fn(&SweepRow) -> Option<f64>;

    let parts: [(&str, Part); 5] = [
        ("overall", |row| row.overall),
        ("rotation", |row| row.rotation),
        ("translation", |row| row.translation),
        ("direction", |row| row.direction),
        ("magnitude", |row| row.magnitude),
    ];

    let head = [
        "part",
        "runs",
        "best R²",
        "% > 0",
        "% > 0.5",
        "sd over seeds",
        "mean R²",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
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

        lines.push(vec![
            name.to_owned(),
            values.len().to_string(),
            format!(
                "{:.3}",
                values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
            ),
            percent(&values, 0.0),
            percent(&values, 0.5),
            match spreads.is_empty() {
                true => "–".to_owned(),
                false => format!("{:.3}", mean_of_known(&spreads)),
            },
            format!("{:.3}", mean(&values)),
        ]);
    }

    lines
}

/// The `most` best configurations by mean R² over rooms and seeds, best first.
pub fn configurations_rows(rows: &[SweepRow], most: usize) -> Vec<Vec<String>> {
    let mut by_configuration: BTreeMap<_, Vec<f64>> = BTreeMap::new();
    for row in rows {
        by_configuration
            .entry(row.configuration())
            .or_default()
            .extend(row.overall);
    }

    // A configuration whose runs all failed has no mean and cannot be ranked.
    let mut ranked: Vec<_> = by_configuration
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .collect();
    ranked.sort_by(|a, b| mean_of_known(&b.1).total_cmp(&mean_of_known(&a.1)));

    let head = [
        "features", "geo_dim", "K", "lr", "loss", "runs", "mean R²", "sd",
    ];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    for ((geo_dim, charts, lr, loss, features), values) in ranked.into_iter().take(most) {
        let runs = values.len().to_string();
        let middle = format!("{:.3}", mean_of_known(&values));

        let spread = if values.len() > 1 {
            format!("{:.3}", deviation(&values))
        } else {
            String::new()
        };

        lines.push(vec![
            features,
            geo_dim.to_string(),
            charts.to_string(),
            lr,
            loss,
            runs,
            middle,
            spread,
        ]);
    }

    lines
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
            key: format!("{room}{seed}"),
            room: room.to_owned(),
            room_revision: 1,
            format: "tum".to_owned(),
            frames: 200,
            features: "f".to_owned(),
            preset: "paper-base".to_owned(),
            split: "time".to_owned(),
            stride: 40,
            geo_dim: 20,
            charts: 1,
            mixing: "gate".to_owned(),
            pairs: "stride 40".to_owned(),
            lr: 1e-3,
            loss: "mse".to_owned(),
            epochs: 10,
            batch: 512,
            weight_decay: 1e-2,
            hidden: 64,
            seed,
            n: 40,
            overall,
            translation: overall,
            rotation: overall,
            direction: None,
            magnitude: overall,
            train_overall: overall,
            seconds: 0.1,
            failure: String::new(),
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
            success_rows(&rows)[1],
            ["tum", "f", "2", "0.400", "50", "50"]
        );

        assert_eq!(
            difficulty_rows(&rows)[1],
            ["tum", "2", "200", "40", "50", "0.400"]
        );

        // The seeds of room a deviate by 1.4/√2; room b has only one successful seed.
        assert_eq!(
            parts_rows(&rows)[1],
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

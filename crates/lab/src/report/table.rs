//! Tables of plain text.

use crate::experiments::seeds::TrainingRun;
use seese3_core::eval::{Report, Row};
use seese3_core::statistics::{Rate, deviation, mean};

/// Two tables with one line per navigator: first Hit@ε with 95 % intervals beside the scores of the
/// latents, then median pose errors and joint recalls.
pub fn evaluation_table(report: &Report) -> String {
    let mut head: Vec<String> = ["navigator", "n", "MSE", "R²", "Top-1"]
        .map(str::to_owned)
        .to_vec();

    head.extend(
        report
            .protocol
            .thresholds
            .iter()
            .map(|epsilon| format!("Hit@{epsilon} [95 %]")),
    );

    let mut lines = vec![head];
    lines.extend(report.rows.iter().map(hit_cells));

    let mut second = vec![
        [
            "navigator",
            "median m",
            "median °",
            "5 cm 5°",
            "10 cm 5°",
            "50 cm 5°",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];

    second.extend(report.rows.iter().map(pose_cells));
    format!("{}\n{}", aligned(&lines), aligned(&second))
}

fn hit_cells(row: &Row) -> Vec<String> {
    let latent = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
    let mut cells = vec![
        row.name.clone(),
        row.n.to_string(),
        latent(row.latent.map(|latent| latent.mse)),
        latent(row.latent.map(|latent| latent.r2)),
        format!("{:.3}", row.retrieval.top1.rate),
    ];

    cells.extend(row.retrieval.hits.iter().map(|(_, rate)| interval(rate)));
    cells
}

fn pose_cells(row: &Row) -> Vec<String> {
    let mut cells = vec![
        row.name.clone(),
        format!("{:.3}", row.retrieval.translation_m_median),
        format!("{:.2}", row.retrieval.rotation_rad_median.to_degrees()),
    ];

    // The protocol may hold more recalls; these are the ones that the head of the table names.
    let shown = [(0.05, 5.0), (0.1, 5.0), (0.5, 5.0)];
    for recall in &row.retrieval.pose_recalls {
        if shown.contains(&(recall.translation_m, recall.rotation_deg)) {
            cells.push(format!("{:.3}", recall.rate.rate));
        }
    }

    cells
}

fn interval(rate: &Rate) -> String {
    format!("{:.3} [{:.3}, {:.3}]", rate.rate, rate.low, rate.high)
}

/// R² by part of the motion, one line per seed; with several seeds also their mean and sample
/// standard deviation.
pub fn training_table(runs: &[TrainingRun]) -> String {
    let head = [
        "seed",
        "overall",
        "transl.",
        "rotation",
        "direct.",
        "magnit.",
        "train R²",
        "mean R²",
        "Hit@0.1",
        "s",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];

    // In the order of the head, from `overall` on.
    let numbers = |run: &TrainingRun| {
        let test = &run.record.test;
        let hit = run.hit_rate.rate;

        [
            test.overall,
            test.translation,
            test.rotation,
            test.direction,
            test.magnitude,
            run.record.train.overall,
            run.record.train_mean_r2,
            hit,
            run.seconds,
        ]
    };

    for run in runs {
        let mut cells = vec![run.record.config.seed.to_string()];
        cells.extend(numbers(run).iter().map(|value| format!("{value:.3}")));
        lines.push(cells);
    }

    // A single seed has no standard deviation.
    if runs.len() > 1 {
        for (label, of) in [("mean", mean as fn(&[f64]) -> f64), ("± sd", deviation)] {
            let mut cells = vec![label.to_owned()];
            cells.extend((0..9).map(|column| {
                let values: Vec<f64> = runs.iter().map(|run| numbers(run)[column]).collect();
                format!("{:.3}", of(&values))
            }));

            lines.push(cells);
        }
    }

    aligned(&lines)
}

/// The table as text: every column is as wide as its widest cell, the first is aligned to the left,
/// the others to the right. Lines may have fewer cells than the first.
pub fn aligned(lines: &[Vec<String>]) -> String {
    let columns = lines.iter().map(Vec::len).max().unwrap_or(0);

    // Widths are counted in characters, not in bytes: cells hold letters such as ², ° and –.
    let width = |column: usize| {
        lines
            .iter()
            .filter_map(|line| line.get(column))
            .map(|cell| cell.chars().count())
            .max()
            .unwrap_or(0)
    };

    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for line in lines {
        for (column, cell) in line.iter().enumerate() {
            let padding = " ".repeat(widths[column] - cell.chars().count());
            let cell = if column == 0 {
                format!("{cell}{padding}")
            } else {
                format!("  {padding}{cell}")
            };
            text.push_str(&cell);
        }

        // A left-aligned last cell or an empty one leaves blanks at the end of the line.
        text.truncate(text.trim_end().len());
        text.push('\n');
    }

    text
}

//! Files of navigator scores: Hit@ε curves as SVG, tables as CSV and LaTeX.

use super::figure::{Figure, Series};
use super::table::Table;
use seese3_core::eval::{Report, Row};
use seese3_core::statistics::Rate;

/// The largest ε of a curve.
const LARGEST: f64 = 1.0;
/// The number of intervals of a curve: one every 0.02.
const STEPS: u32 = 50;

/// The thresholds ε of a curve, ascending.
pub fn curve_thresholds() -> Vec<f64> {
    let step = LARGEST / f64::from(STEPS);
    (1..=STEPS).map(|count| f64::from(count) * step).collect()
}

/// Returns a copy of the report with only the hits at the given thresholds.
pub fn report_at(report: &Report, thresholds: &[f64]) -> Report {
    let mut narrowed = report.clone();
    narrowed.protocol.thresholds = thresholds.to_vec();
    for row in &mut narrowed.rows {
        row.retrieval
            .hits
            .retain(|(epsilon, _)| thresholds.contains(epsilon));
        row.hits_over_identity
            .retain(|(epsilon, _)| thresholds.contains(epsilon));
    }
    narrowed
}

/// Plots Hit@ε over ε, one curve per navigator.
pub fn hit_curves(report: &Report, title: String) -> Figure {
    let curve = |row: &Row| {
        let hits = row.retrieval.hits.iter();
        Series::line(
            row.label(),
            hits.map(|(epsilon, rate)| [*epsilon, rate.rate]).collect(),
        )
    };
    let series = report.rows.iter().map(curve).collect();
    Figure::new(title, "ε, meters and radians mixed", "Hit@ε", series)
}

/// CSV with one line per navigator and the bounds of the 95 % intervals; undefined values are
/// empty.
pub fn evaluation_csv(report: &Report) -> String {
    let hits = over_thresholds(report, |e| {
        format!(" | hit@{e} | hit@{e}_low | hit@{e}_high")
    });
    let mut table = Table::new(&format!(
        "navigator | leak | n | latent_mse | latent_r2 | top1 | top1_low | top1_high{hits} | median_m | median_deg"
    ));

    let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    for row in &report.rows {
        let latent = [
            if row.leaks { "LEAK" } else { "" }.to_owned(),
            row.n.to_string(),
            number(row.latent.map(|latent| latent.mse)),
            number(row.latent.map(|latent| latent.r2)),
        ];
        let rates = std::iter::once(&row.retrieval.top1)
            .chain(row.retrieval.hits.iter().map(|(_, rate)| rate))
            .flat_map(|rate| [rate.rate, rate.low, rate.high]);
        let rates = rates.chain(medians(row)).map(|value| value.to_string());
        table.row(&row.name, latent.into_iter().chain(rates));
    }

    table.csv()
}

/// LaTeX table for the package `booktabs`: Hit@ε with its 95 % interval in small print.
pub fn evaluation_latex(report: &Report) -> String {
    let hits = over_thresholds(report, |epsilon| format!(" | Hit@{epsilon}"));
    let mut table = Table::new(&format!(
        "navigator | latent $R^2${hits} | median m | median $^\\circ$"
    ));

    for row in &report.rows {
        let r2 = row.latent.map(|latent| format!("{:.3}", latent.r2));
        let hits = row.retrieval.hits.iter().map(|(_, hit)| {
            let Rate {
                rate, low, high, ..
            } = hit;
            format!("{rate:.3} {{\\scriptsize [{low:.3}, {high:.3}]}}")
        });
        let [meters, degrees] = medians(row);

        let cells = std::iter::once(r2.unwrap_or("--".to_owned()))
            .chain(hits)
            .chain([format!("{meters:.3}"), format!("{degrees:.2}")]);
        table.row(row.label(), cells);
    }

    format!(
        "% {} test pairs, {} candidate frames, split {}, stride {}\n{}",
        report.n,
        report.candidate_count,
        report.protocol.split,
        report.protocol.stride,
        table.latex()
    )
}

fn over_thresholds(report: &Report, title: fn(&f64) -> String) -> String {
    report.protocol.thresholds.iter().map(title).collect()
}

/// Median errors of the retrieved poses, meters and degrees.
fn medians(row: &Row) -> [f64; 2] {
    let scores = &row.retrieval;
    [
        scores.translation_m_median,
        scores.rotation_rad_median.to_degrees(),
    ]
}

//! Files of navigator scores: Hit@ε curves as SVG, tables as CSV and LaTeX.

use std::fmt::Write;

use super::curves::{Curves, Series};
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
    }
    narrowed
}

/// Plots Hit@ε over ε, one curve per navigator.
pub fn hit_curves(report: &Report, title: String) -> Curves {
    let curve = |row: &Row| Series {
        name: row.name.clone(),
        points: row
            .retrieval
            .hits
            .iter()
            .map(|(epsilon, rate)| [*epsilon, rate.rate])
            .collect(),
        joined: true,
    };

    Curves {
        title,
        x: "ε, metres and radians mixed".to_owned(),
        y: "Hit@ε".to_owned(),
        series: report.rows.iter().map(curve).collect(),
        diagonal: false,
    }
}

/// CSV with one line per navigator and the bounds of the 95 % intervals; undefined values are
/// empty.
pub fn evaluation_csv(report: &Report) -> String {
    let mut text = "navigator,n,mse,r2,top1,top1_low,top1_high".to_owned();
    for epsilon in &report.protocol.thresholds {
        let _ = write!(text, ",hit@{epsilon},hit@{epsilon}_low,hit@{epsilon}_high");
    }
    text.push_str(",median_m,median_deg\n");

    let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let rate = |rate: &Rate| format!("{},{},{}", rate.rate, rate.low, rate.high);
    for row in &report.rows {
        let mse = number(row.latent.map(|latent| latent.mse));
        let r2 = number(row.latent.map(|latent| latent.r2));
        let top1 = rate(&row.retrieval.top1);
        let _ = write!(text, "{},{},{mse},{r2},{top1}", row.name, row.n);
        for (_, hit) in &row.retrieval.hits {
            let _ = write!(text, ",{}", rate(hit));
        }

        let degrees = row.retrieval.rotation_rad_median.to_degrees();
        let metres = row.retrieval.translation_m_median;
        let _ = writeln!(text, ",{metres},{degrees}");
    }
    text
}

/// LaTeX table for the package `booktabs`: Hit@ε with its 95 % interval in small print.
pub fn evaluation_latex(report: &Report) -> String {
    let columns = "r".repeat(3 + report.protocol.thresholds.len());
    let mut head = "navigator & $R^2$".to_owned();
    for epsilon in &report.protocol.thresholds {
        let _ = write!(head, " & Hit@{epsilon}");
    }

    let mut text = format!(
        "% {} test pairs, {} candidate frames, split {}, stride {}\n\
         \\begin{{tabular}}{{l{columns}}}\n\\toprule\n{head} & median m & median $^\\circ$ \\\\\n\\midrule\n",
        report.n, report.candidate_count, report.protocol.split, report.protocol.stride
    );

    for row in &report.rows {
        let r2 = row
            .latent
            .map_or("--".to_owned(), |latent| format!("{:.3}", latent.r2));
        let _ = write!(text, "{} & {r2}", row.name);
        for (_, hit) in &row.retrieval.hits {
            let Rate {
                rate, low, high, ..
            } = hit;
            let _ = write!(text, " & {rate:.3} {{\\scriptsize [{low:.3}, {high:.3}]}}");
        }

        let _ = writeln!(
            text,
            " & {:.3} & {:.2} \\\\",
            row.retrieval.translation_m_median,
            row.retrieval.rotation_rad_median.to_degrees()
        );
    }

    text.push_str("\\bottomrule\n\\end{tabular}\n");
    text
}

//! Scores of submissions to a benchmark, as a table and as a page.

use super::cross_room::{room_difference_text, room_mean_text};
use super::table::Table;
use crate::benchmark::{Benchmark, BenchmarkScores};

/// One line per submission, in the order given.
pub fn benchmark_table(scores: &[BenchmarkScores]) -> Table {
    let thresholds = scores.first().map_or(&[][..], |scores| &scores.hits);
    let hits: String = thresholds
        .iter()
        .map(|hits| format!(" | Hit@{} [95 %]", hits.threshold))
        .collect();
    let least = thresholds.first().map_or(0.0, |hits| hits.threshold);
    let mut table = Table::new(&format!(
        "method{hits} | Hit@{least} over Identity [95 %] | median m | median °"
    ));

    for scores in scores {
        let hits = scores.hits.iter().map(|hits| room_mean_text(&hits.hit));
        let over = scores.hits.first();
        let over = over.map(|hits| room_difference_text(&hits.over_identity));
        let medians = [
            format!("{:.3}", scores.median_m),
            format!("{:.2}", scores.median_deg),
        ];
        table.row(&scores.name, hits.chain(over).chain(medians));
    }
    table
}

/// A page of results: the benchmark, the table, and what each submission is.
pub fn benchmark_page(benchmark: &Benchmark, scores: &[BenchmarkScores]) -> String {
    let pairs: usize = benchmark.rooms.iter().map(|room| room.pair_count()).sum();
    let mut page = format!(
        "# Benchmark {}\n\n{} rooms, {pairs} pairs of stride {}, split {}. SHA-256 `{}`.\n\n\
         Means over rooms, with 95 % intervals of resampled rooms; medians are means over rooms of each room's median.\n\n{}\n",
        benchmark.name,
        benchmark.rooms.len(),
        benchmark.stride,
        benchmark.split,
        benchmark.sha256(),
        benchmark_table(scores).markdown(),
    );

    for scores in scores {
        page += &format!("- **{}**: {}", scores.name, scores.about);
        if let Some(url) = &scores.url {
            page += &format!(" <{url}>");
        }
        page.push('\n');
    }
    page
}

//! Scores of submissions to a benchmark, and metrics of features in its rooms, as tables and pages.

use super::cross_room::{room_difference_text, room_mean_text};
use super::table::Table;
use crate::benchmark::{Benchmark, BenchmarkScores, MetricMeans};

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
        page += &description(&scores.name, &scores.about, scores.url.as_deref());
    }
    page
}

/// One line per feature set, in the order given.
pub fn metrics_table(means: &[MetricMeans]) -> Table {
    let mut table = Table::new(
        "features | columns | M1 [95 %] | M2, TwoNN [95 %] | M2, MLE [95 %] | M3 R² [95 %] | M4 R² [95 %] | M4 R² over the constant [95 %]",
    );
    for means in means {
        let metrics = [
            &means.m1,
            &means.m2_twonn,
            &means.m2_mle,
            &means.m3,
            &means.m4,
        ];
        let cells = std::iter::once(means.columns.to_string())
            .chain(metrics.map(room_mean_text))
            .chain([room_difference_text(&means.m4_over_constant)]);
        table.row(&means.name, cells);
    }
    table
}

/// A page of metrics: the benchmark, the table, and what each feature set is.
pub fn metrics_page(benchmark: &Benchmark, means: &[MetricMeans]) -> String {
    let mut page = format!(
        "# Features in the rooms of benchmark {}\n\n{} rooms, stride {} for M3 and M4. SHA-256 `{}`.\n\n\
         Means over rooms, with 95 % intervals of resampled rooms; an R² counts as max(R², −1). M4 is an adapter trained in each \
         room alone and tested on the parts that it was not trained on. The constant always answers the mean training motion.\n\n{}\n",
        benchmark.name,
        benchmark.rooms.len(),
        benchmark.stride,
        benchmark.sha256(),
        metrics_table(means).markdown(),
    );

    for means in means {
        page += &description(&means.name, &means.about, means.url.as_deref());
    }
    page
}

/// A line of a list.
fn description(name: &str, about: &str, url: Option<&str>) -> String {
    let url = url.map_or_else(String::new, |url| format!(" <{url}>"));
    format!("- **{name}**: {about}{url}\n")
}

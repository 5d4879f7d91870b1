//! Section: one adapter per room with one, two and four charts. It reports the fraction of rooms
//! where training succeeds, and the difficulty of the rooms.

use std::collections::BTreeMap;

use rayon::prelude::*;

use seese3_core::adapter::Preset;
use seese3_core::splits::Split;
use seese3_core::statistics::median;
use seese3_core::training::RoomData;

use super::claims::{Case, Claim, encoders_and_control};
use super::{Error, FeatureSet, Found, Reproduction, paper};
use crate::experiments::adapter_sweep::{SweepRow, content, row, run};
use crate::report::{
    Section, Table, configurations_table, difficulty_table, parts_table, success_table,
};

/// Numbers of charts K, as in the paper's mixtures.
const CHARTS: [usize; 3] = [1, 2, 4];

/// Builds the section with the paper's Table 2 and the tables of difficulty, mixtures and parts of
/// the motion.
pub fn section(given: &Reproduction<'_>) -> Result<Found<Vec<SweepRow>>, Error> {
    let mut section = Section::new("Each room by itself: success, difficulty, mixtures of charts");

    let rows: Vec<SweepRow> = given
        .sets
        .iter()
        .flat_map(|set| of_set(given, set))
        .collect();

    section.text(
        "Best run of each room over all strides, chosen by its test score as the paper's \"Max R²\" is:",
    );

    // Our rows come first, then the paper's, grouped by its recordings and encoders.
    let mut success = success_table(&rows);
    for (recordings, encoder, [best, above_0, above_0_3]) in paper::SUCCESS {
        let cells = [
            encoder.to_owned(),
            recordings.rooms.to_string(),
            format!("{best:.3}"),
            format!("{above_0:.0}"),
            format!("{above_0_3:.0}"),
        ];
        success.row(format!("paper: {}", recordings.name), cells);
    }

    section.table(success);
    section.text("How hard the recordings are, over all features:");
    section.table(difficulty_table(&rows));
    section.text(
        "By the number of training pairs, with each stride of a room by itself, over all features:",
    );
    section.table(pairs_table(&rows));
    section.text(
        "Difficulty by contrast, over all features. The contrast of a room is the median over frames of the standard \
         deviation of a frame's control feature (for pixels: over cells and color channels). Thirds of the rooms:",
    );
    section.table(contrast_table(given, &rows));
    section.text("By charts (K), mean over rooms and strides:");

    // Show every configuration: each number of charts with each feature set.
    section.table(configurations_table(&rows, CHARTS.len() * given.sets.len()));

    section.text("By part of the motion, over all runs:");
    section.table(parts_table(&rows));

    section.text(format!(
        "{} runs: every held-out and in-room room, with K of {CHARTS:?}, strides {:?}, time split, {} seeds \
         for K = 1 and one for the others. {} The best of several runs, chosen by its test score, is biased upward: the means are what to expect.",
        rows.len(),
        given.options.strides,
        given.options.seeds,
        given.training_words()
    ));

    // Runs of a room are adjacent; report a shared reason once.
    let mut failures: Vec<(&str, &str)> = rows
        .iter()
        .filter(|row| !row.failure.is_empty())
        .map(|row| (&*row.room, &*row.failure))
        .collect();
    failures.dedup();

    for (room, why) in failures {
        section.text(format!("Room {room} has no scores: {why}."));
    }

    // The control has no trained encoder, so it is no evidence for the paper's order.
    let (encoders, _) = encoders_and_control(&given.sets);
    let is_of_encoder = |row: &&SweepRow| encoders.iter().any(|set| set.features == row.features);
    let of_encoders: Vec<SweepRow> = rows.iter().filter(is_of_encoder).cloned().collect();
    Ok(Found {
        section,
        claims: vec![order_of_parts(&of_encoders)],
        record: rows,
    })
}

/// Success rate and median best R² for three groups of rooms by contrast.
fn contrast_table(given: &Reproduction<'_>, rows: &[SweepRow]) -> Table {
    let control = given.sets.last();
    let mut rooms: Vec<(f64, f64)> = control
        .into_iter()
        .flat_map(|set| set.test.iter().chain(&set.in_room))
        .map(|data| (contrast(data), best_r2(rows, data.room.id().as_str())))
        .collect();
    // Skip rooms where all runs failed; they are named below the tables.
    rooms.retain(|room| room.1.is_finite());
    rooms.sort_by(|a, b| a.0.total_cmp(&b.0));

    let mut table = Table::new("contrast | rooms | % > 0 | median best R²");
    let third = |k: usize| rooms.len() * k / 3;
    let parts = (0..3).map(|k| &rooms[third(k)..third(k + 1)]);
    for part in parts.filter(|part| !part.is_empty()) {
        let best: Vec<f64> = part.iter().map(|room| room.1).collect();
        let above = best.iter().filter(|&&r2| r2 > 0.0).count();

        let cells = [
            part.len().to_string(),
            format!("{:.0}", 100.0 * above as f64 / part.len() as f64),
            format!("{:.2}", median(&best)),
        ];
        let range = format!("{:.3} to {:.3}", part[0].0, part[part.len() - 1].0);
        table.row(range, cells);
    }

    table
}

/// The paper's order of difficulty: rotation is read more often than translation, translation more
/// often than direction, direction more often than magnitude.
fn order_of_parts(rows: &[SweepRow]) -> Claim {
    type Part = fn(&SweepRow) -> Option<f64>;
    const PARTS: [(&str, Part); 4] = [
        ("rotation", |row| row.rotation),
        ("translation", |row| row.translation),
        ("direction", |row| row.direction),
        ("magnitude", |row| row.magnitude),
    ];

    let mut rooms: Vec<&str> = rows.iter().map(|row| &*row.room).collect();
    rooms.sort_unstable();
    rooms.dedup();

    let share_above_zero = |room: &str, part: Part| {
        let scores: Vec<f64> = rows
            .iter()
            .filter(|row| row.room == room)
            .filter_map(part)
            .collect();
        let above = scores.iter().filter(|&&r2| r2 > 0.0).count();
        above as f64 / scores.len() as f64
    };
    let shares = |part: Part| -> Vec<f64> {
        let of_room = |room: &&str| share_above_zero(room, part);
        rooms.iter().map(of_room).collect()
    };

    let case = |pair: &[(&str, Part)]| {
        let [(easier, a), (harder, b)] = [pair[0], pair[1]];
        let name = format!("{easier} over {harder}");
        Case::of_difference(name, &shares(a), &shares(b))
    };
    Claim::new(
        "rotation is estimated more often than translation, translation than direction, direction than magnitude",
        "share of the room's runs with R² > 0 of a part minus that of the next one",
        PARTS.windows(2).map(case).collect(),
    )
}

/// Success by the number of training pairs at one stride.
fn pairs_table(rows: &[SweepRow]) -> Table {
    /// First and last number of pairs; the paper speaks of recordings with more than 1,000.
    const BINS: [(usize, usize); 4] = [(0, 199), (200, 499), (500, 999), (1_000, usize::MAX)];

    let mut table =
        Table::new("training pairs, about | rooms and strides | % > 0 | median best R²");
    let mut best: BTreeMap<(&str, u32), (usize, f64)> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.failure.is_empty()) {
        // Under the time split, four fifths of the frames train.
        let pairs = (row.frames * 4 / 5).saturating_sub(row.stride as usize);
        let entry = best
            .entry((&row.room, row.stride))
            .or_insert((pairs, f64::NEG_INFINITY));
        entry.1 = entry.1.max(row.overall.unwrap_or(f64::NEG_INFINITY));
    }

    for (low, high) in BINS {
        let of_bin = best
            .values()
            .filter(|(pairs, _)| (low..=high).contains(pairs));
        let scores: Vec<f64> = of_bin.map(|(_, r2)| *r2).collect();
        if scores.is_empty() {
            continue;
        }
        let above = scores.iter().filter(|&&r2| r2 > 0.0).count();
        let range = match high {
            usize::MAX => format!("{low} and more"),
            _ => format!("{low} to {high}"),
        };
        let cells = [
            scores.len().to_string(),
            format!("{:.0}", 100.0 * above as f64 / scores.len() as f64),
            format!("{:.2}", median(&scores)),
        ];
        table.row(range, cells);
    }

    table
}

/// The best R² of a room's runs; −∞ if all runs failed.
fn best_r2(rows: &[SweepRow], room: &str) -> f64 {
    rows.iter()
        .filter(|row| row.room == room)
        .filter_map(|row| row.overall)
        .fold(f64::NEG_INFINITY, f64::max)
}

/// The median over frames of the standard deviation of a frame's feature.
fn contrast(data: &RoomData<'_>) -> f64 {
    let of_frames: Vec<f64> = data
        .features
        .rows()
        .outer_iter()
        .map(|row| row.mapv(f64::from).std(0.0))
        .collect();
    median(&of_frames)
}

fn of_set(given: &Reproduction<'_>, set: &FeatureSet<'_>) -> Vec<SweepRow> {
    // Held-out rooms are included: each adapter is trained and tested within one room.
    let rooms: Vec<&RoomData<'_>> = set.test.iter().chain(&set.in_room).collect();

    let of_room = |room: &&RoomData<'_>| {
        let content = content(room);
        let mut rows = Vec::new();
        for &stride in &given.options.strides {
            for charts in CHARTS {
                let seeds = if charts == 1 { given.options.seeds } else { 1 };
                for seed in 0..seeds {
                    let mut plan = given.plan(Preset::Base, Split::Time, stride, seed, None);
                    plan.config.charts = charts;
                    rows.push(run(room, &plan, row(room, &content, &plan)));
                }
            }
        }

        rows
    };

    rooms.par_iter().flat_map(of_room).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(room: &str, stride: u32, frames: usize, scores: [f64; 5]) -> SweepRow {
        let [overall, rotation, translation, direction, magnitude] = scores.map(Some);
        SweepRow {
            room: room.to_owned(),
            stride,
            frames,
            overall,
            rotation,
            translation,
            direction,
            magnitude,
            ..SweepRow::default()
        }
    }

    /// Oracle: by hand. Room a: rotation above 0 in 2 of 2 runs, translation in 1, direction and
    /// magnitude in 0. Room b: the same but direction in 1.
    #[test]
    fn parts_are_ordered_by_their_share_above_zero() {
        let rows = [
            row("a", 10, 100, [0.0, 0.5, 0.1, -1.0, -1.0]),
            row("a", 20, 100, [0.0, 0.5, -0.1, -1.0, -1.0]),
            row("b", 10, 100, [0.0, 0.5, 0.1, 0.1, -1.0]),
            row("b", 20, 100, [0.0, 0.5, -0.1, -1.0, -1.0]),
        ];
        let claim = order_of_parts(&rows);
        let means = claim
            .cases
            .iter()
            .map(|case| (case.case.as_str(), case.mean.unwrap().mean));
        let expected = [
            ("rotation over translation", 0.5),
            ("translation over direction", 0.25),
            ("direction over magnitude", 0.25),
        ];
        assert_eq!(means.collect::<Vec<_>>(), expected);
    }

    /// Oracle: by hand. Four fifths of 100 frames less the stride are 70 pairs, of 600 frames 470.
    /// The best of the runs of a room and a stride counts.
    #[test]
    fn rooms_are_grouped_by_their_pairs() {
        let scores = |overall: f64| [overall, 0.0, 0.0, 0.0, 0.0];
        let rows = [
            row("a", 10, 100, scores(-0.5)),
            row("a", 10, 100, scores(0.25)),
            row("b", 10, 100, scores(-0.75)),
            row("c", 10, 600, scores(-0.5)),
        ];
        let lines = pairs_table(&rows).csv();
        let lines: Vec<&str> = lines.lines().skip(1).collect();
        assert_eq!(lines, ["0 to 199,2,50,-0.25", "200 to 499,1,0,-0.50"]);
    }
}

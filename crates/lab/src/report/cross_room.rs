//! Results of an adapter in held-out rooms, for `seese3 cross-room`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::json::{BaselinesJson, MotionJson, RateJson, RoomMeanJson};
use super::table::aligned;
use crate::experiments::cross_room::{CrossRoomRun, MotionSummary, RoomOutcome, wins};
use seese3_core::statistics::{RoomMean, bootstrap_mean, paired_difference};

/// One line per navigator: the number of rooms in which it beats Identity, its mean hit rate, and
/// the difference to the hit rate of `baseline`. The first has Wilson's interval; the intervals of
/// the other two are bootstrapped over rooms.
pub fn cross_room_table(run: &CrossRoomRun, baseline: &str, threshold: f64) -> String {
    let head = [
        "navigator".to_owned(),
        "beats Identity in".to_owned(),
        format!("Hit@{threshold}"),
        format!("over {baseline}"),
    ];
    let mut lines = vec![head.to_vec()];

    let theirs = run.hit_rates(baseline);
    for name in run.navigators() {
        let ours = run.hit_rates(name);

        let won = wins(&run.outcomes, name).map_or_else(String::new, |rate| {
            format!(
                "{}/{} ({:.0} %, {:.3}–{:.3})",
                rate.successes(),
                rate.n,
                100.0 * rate.rate,
                rate.low,
                rate.high
            )
        });

        // The difference is paired by room, so both navigators need a hit rate in every room.
        let over = match theirs.len() == ours.len() && name != baseline {
            true => room_difference_text(&paired_difference(&ours, &theirs, 0)),
            false => String::new(),
        };

        lines.push(vec![
            name.to_owned(),
            won,
            room_mean_text(&bootstrap_mean(&ours, 0)),
            over,
        ]);
    }

    aligned(&lines)
}

/// One line per run: the number of training rooms and R² over the held-out rooms.
pub fn scaling_table(runs: &[CrossRoomRun], baseline: &str, threshold: f64) -> String {
    let mut head = [
        "rooms",
        "seed",
        "R² > 0",
        "R² > 0.3",
        "best R²",
        "mean max(R², −1)",
        "mean max(R², 0)",
    ]
    .map(str::to_owned)
    .to_vec();

    head.push(format!("Hit@{threshold}, {baseline}"));
    let mut lines = vec![head];
    for run in runs {
        // Skip a run without evaluated rooms.
        let Some(summary) = MotionSummary::of(&run.r2(), 0) else {
            continue;
        };

        let MotionSummary {
            positive,
            above_0_3,
            best,
            clipped,
            clipped_at_zero,
        } = summary;

        lines.push(vec![
            run.training_rooms.len().to_string(),
            run.seed.to_string(),
            format!(
                "{:.0} % ({}/{})",
                100.0 * positive.rate,
                positive.successes(),
                positive.n
            ),
            format!("{:.0} %", 100.0 * above_0_3.rate),
            format!("{best:.3}"),
            room_mean_text(&clipped),
            room_mean_text(&clipped_at_zero),
            room_mean_text(&bootstrap_mean(&run.hit_rates(baseline), 0)),
        ]);
    }

    aligned(&lines)
}

/// One line per room: the number of pairs, R², R² of the constant, and each navigator's hit rate.
pub fn rooms_table(run: &CrossRoomRun) -> String {
    let names = run.navigators();
    let mut lines = vec![
        ["room", "n", "R²", "constant's R²"]
            .into_iter()
            .chain(names.iter().copied())
            .map(str::to_owned)
            .collect::<Vec<_>>(),
    ];

    for outcome in &run.outcomes {
        let mut cells = vec![
            outcome.room.to_string(),
            outcome.motion.n.to_string(),
            format!("{:.3}", outcome.motion.overall),
            format!("{:.3}", outcome.baselines.constant_r2),
        ];

        let rate = |name: &&str| {
            outcome
                .hit_rate(name)
                .map_or_else(String::new, |rate| format!("{:.3}", rate.rate))
        };
        cells.extend(names.iter().map(rate));

        lines.push(cells);
    }

    aligned(&lines)
}

/// The JSON record of `seese3 cross-room`: for each run a summary and the scores of every room.
#[derive(Debug, Serialize)]
pub struct CrossRoomJson {
    baseline: String,
    runs: Vec<RunJson>,
}

#[derive(Debug, Serialize)]
struct RunJson {
    learned_rooms: Vec<String>,
    calibration_rooms: Vec<String>,
    seed: u64,
    r2: Option<SummaryJson>,
    /// Medians over the rooms.
    baselines: Option<BaselinesJson>,
    navigators: Vec<NavigatorJson>,
    rooms: Vec<RoomJson>,
    skipped: Vec<SkippedJson>,
}

#[derive(Debug, Serialize)]
struct SummaryJson {
    positive: RateJson,
    #[serde(rename = "above_0.3")]
    above_0_3: RateJson,
    best: f64,
    /// The mean of max(R², −1).
    clipped_mean: RoomMeanJson,
    /// The mean of max(R², 0), as in the paper.
    clipped_mean_at_0: RoomMeanJson,
}

#[derive(Debug, Serialize)]
struct NavigatorJson {
    name: String,
    beats_identity: Option<RateJson>,
    hit: RoomMeanJson,
    over_baseline: RoomMeanJson,
}

#[derive(Debug, Serialize)]
struct RoomJson {
    room: String,
    candidates: usize,
    motion: MotionJson,
    baselines: BaselinesJson,
    /// Hit rates by navigator.
    hit: BTreeMap<String, RateJson>,
}

#[derive(Debug, Serialize)]
struct SkippedJson {
    room: String,
    why: String,
}

/// Builds the JSON record of cross-room runs; differences are relative to navigator `baseline`.
pub fn cross_room_json(runs: &[CrossRoomRun], baseline: &str) -> CrossRoomJson {
    CrossRoomJson {
        baseline: baseline.to_owned(),
        runs: runs.iter().map(|run| run_json(run, baseline)).collect(),
    }
}

fn run_json(run: &CrossRoomRun, baseline: &str) -> RunJson {
    let theirs = run.hit_rates(baseline);
    let navigator = |name: &str| {
        let ours = run.hit_rates(name);
        NavigatorJson {
            name: name.to_owned(),
            beats_identity: wins(&run.outcomes, name).as_ref().map(RateJson::from),
            hit: (&bootstrap_mean(&ours, 0)).into(),
            over_baseline: (&paired_difference(&ours, &theirs, 0)).into(),
        }
    };

    let summary = MotionSummary::of(&run.r2(), 0).map(|summary| SummaryJson {
        positive: (&summary.positive).into(),
        above_0_3: (&summary.above_0_3).into(),
        best: summary.best,
        clipped_mean: (&summary.clipped).into(),
        clipped_mean_at_0: (&summary.clipped_at_zero).into(),
    });

    let skipped = run.skipped.iter().map(|(room, why)| SkippedJson {
        room: room.clone(),
        why: why.clone(),
    });

    RunJson {
        learned_rooms: run.training_rooms.clone(),
        calibration_rooms: run.calibration_rooms.clone(),
        seed: run.seed,
        r2: summary,
        baselines: BaselinesJson::medians(run.outcomes.iter().map(|outcome| &outcome.baselines)),
        navigators: run.navigators().into_iter().map(navigator).collect(),
        rooms: run.outcomes.iter().map(room_json).collect(),
        skipped: skipped.collect(),
    }
}

fn room_json(outcome: &RoomOutcome) -> RoomJson {
    let rates = outcome
        .rows
        .iter()
        .filter_map(|row| Some((row.name.clone(), (&outcome.hit_rate(&row.name)?).into())));

    RoomJson {
        room: outcome.room.to_string(),
        candidates: outcome.candidate_count,
        motion: (&outcome.motion).into(),
        baselines: (&outcome.baselines).into(),
        hit: rates.collect(),
    }
}

/// A mean over rooms with its 95 % interval, as text.
pub fn room_mean_text(mean: &RoomMean) -> String {
    // A bootstrap over a single room has no spread, so there is no interval.
    if mean.rooms < 2 {
        return format!("{:.3}", mean.mean);
    }

    format!("{:.3} [{:.3}, {:.3}]", mean.mean, mean.low, mean.high)
}

/// A signed difference over rooms with its 95 % interval, as text.
pub fn room_difference_text(mean: &RoomMean) -> String {
    if mean.rooms < 2 {
        return format!("{:+.3}", mean.mean);
    }
    format!("{:+.3} [{:+.3}, {:+.3}]", mean.mean, mean.low, mean.high)
}

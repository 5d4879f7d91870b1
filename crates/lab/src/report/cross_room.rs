//! Results of an adapter in held-out rooms, for `seese3 cross-room`.

use serde::Serialize;

use super::table::Table;
use crate::experiments::cross_room::{CrossRoomRun, MotionSummary, RoomOutcome, Skipped, wins};
use crate::json;
use seese3_core::eval::Baselines;
use seese3_core::statistics::{Rate, RoomMean, bootstrap_mean, paired_difference};

/// One line per navigator: the number of rooms in which it beats Identity, its mean hit rate, and
/// the difference to the hit rate of `baseline`. The first has Wilson's interval; the intervals of
/// the other two are bootstrapped over rooms.
pub fn cross_room_table(run: &CrossRoomRun, baseline: &str, threshold: f64) -> Table {
    let mut table = Table::new(&format!(
        "navigator | beats Identity in | Hit@{threshold} | over {baseline}"
    ));

    let theirs = run.hit_rates(baseline);
    for name in run.navigators() {
        let ours = run.hit_rates(name);
        let won = wins(&run.outcomes, name).map_or_else(String::new, |rate| count_text(&rate, 3));

        // The difference is paired by room, so both navigators need a hit rate in every room.
        let is_paired = theirs.len() == ours.len() && name != baseline;
        let over = is_paired.then(|| room_difference_text(&paired_difference(&ours, &theirs, 0)));

        let hit = room_mean_text(&bootstrap_mean(&ours, 0));
        table.row(name, [won, hit, over.unwrap_or_default()]);
    }

    table
}

/// One line per run: the number of training rooms and R² over the held-out rooms.
pub fn scaling_table(runs: &[CrossRoomRun], baseline: &str, threshold: f64) -> Table {
    let mut table = Table::new(&format!(
        "rooms | seed | R² > 0 | R² > 0.3 | best R² | mean max(R², −1) | mean max(R², 0) | \
         Hit@{threshold}, {baseline}"
    ));

    for run in runs {
        // Skip a run without evaluated rooms.
        let Some(summary) = MotionSummary::of(&run.r2(), 0) else {
            continue;
        };

        let positive = &summary.positive;
        let share = 100.0 * positive.rate;
        let cells = [
            run.seed.to_string(),
            format!("{share:.0} % ({}/{})", positive.successes(), positive.n),
            format!("{:.0} %", 100.0 * summary.above_0_3.rate),
            format!("{:.3}", summary.best),
            room_mean_text(&summary.clipped),
            room_mean_text(&summary.clipped_at_zero),
            room_mean_text(&bootstrap_mean(&run.hit_rates(baseline), 0)),
        ];
        table.row(run.training_rooms.len().to_string(), cells);
    }

    table
}

/// One line per room: the number of pairs, R², R² of the constant, and each navigator's hit rate.
pub fn rooms_table(run: &CrossRoomRun) -> Table {
    let names = run.navigators();
    let mut table = Table::new(&format!(
        "room | n | R² | constant's R² | {}",
        names.join(" | ")
    ));

    for outcome in &run.outcomes {
        let rate = |name: &&str| {
            outcome
                .hit_rate(name)
                .map(|rate| format!("{:.3}", rate.rate))
        };
        let rates = names.iter().map(|name| rate(name).unwrap_or_default());
        let scores = [
            outcome.motion.n.to_string(),
            format!("{:.3}", outcome.motion.overall),
            format!("{:.3}", outcome.baselines.constant_r2),
        ];
        table.row(outcome.room.as_str(), scores.into_iter().chain(rates));
    }

    table
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
    r2: Option<MotionSummary>,
    /// Medians over the rooms.
    #[serde(serialize_with = "json::baselines")]
    baselines: Option<Baselines>,
    navigators: Vec<NavigatorJson>,
    rooms: Vec<RoomOutcome>,
    skipped: Vec<Skipped>,
}

#[derive(Debug, Serialize)]
struct NavigatorJson {
    name: String,
    beats_identity: Option<Rate>,
    hit: RoomMean,
    over_baseline: RoomMean,
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
            beats_identity: wins(&run.outcomes, name),
            hit: bootstrap_mean(&ours, 0),
            over_baseline: paired_difference(&ours, &theirs, 0),
        }
    };

    RunJson {
        learned_rooms: run.training_rooms.clone(),
        calibration_rooms: run.calibration_rooms.clone(),
        seed: run.seed,
        r2: MotionSummary::of(&run.r2(), 0),
        baselines: json::median_baselines(run.outcomes.iter().map(|room| &room.baselines)),
        navigators: run.navigators().into_iter().map(navigator).collect(),
        rooms: run.outcomes.clone(),
        skipped: run.skipped.clone(),
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

/// A count of rooms with its percentage and Wilson's interval, as text.
pub fn count_text(rate: &Rate, decimals: usize) -> String {
    let share = 100.0 * rate.rate;
    let interval = format!("{:.decimals$}–{:.decimals$}", rate.low, rate.high);
    format!("{}/{} ({share:.0} %, {interval})", rate.successes(), rate.n)
}

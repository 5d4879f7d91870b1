//! An adapter in rooms that it never saw: `seese3 cross-room`.

use serde_json::{Value, json};

use super::json::{motion_json, rate_json};
use super::table::aligned;
use crate::generalisation::{MotionSummary, RoomMean, RoomOutcome, difference, over_rooms, wins};

/// One adapter in the held-out rooms.
#[derive(Debug, Clone)]
pub struct CrossRoomRun {
    /// Rooms that it learned from.
    pub learned: Vec<String>,
    /// Rooms that its errors were measured in.
    pub aside: Vec<String>,
    /// Its seed.
    pub seed: u64,
    /// Room by room.
    pub outcomes: Vec<RoomOutcome>,
    /// Rooms that could not be evaluated, and why.
    pub skipped: Vec<(String, String)>,
}

impl CrossRoomRun {
    fn navigators(&self) -> Vec<&str> {
        self.outcomes.first().map_or(Vec::new(), |outcome| {
            outcome.rows.iter().map(|row| row.name.as_str()).collect()
        })
    }

    /// A navigator's hit rate, room by room.
    pub fn hit_rates(&self, navigator: &str) -> Vec<f64> {
        self.outcomes
            .iter()
            .filter_map(|outcome| outcome.hit_rate(navigator))
            .map(|rate| rate.rate)
            .collect()
    }

    /// Overall R², room by room.
    pub fn r2(&self) -> Vec<f64> {
        self.outcomes
            .iter()
            .map(|outcome| outcome.motion.overall)
            .collect()
    }
}

/// Navigators of one adapter over the rooms: wins over Identity with Wilson's interval, mean hit
/// rate, and how much more often than `baseline` they hit, with the interval of drawing rooms
/// again.
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

        let over = match theirs.len() == ours.len() && name != baseline {
            true => room_difference_text(&difference(&ours, &theirs, 0)),
            false => String::new(),
        };

        lines.push(vec![
            name.to_owned(),
            won,
            room_mean_text(&over_rooms(&ours, 0)),
            over,
        ]);
    }

    aligned(&lines)
}

/// A line a run: how R² over the rooms grows with the rooms that were learned from.
pub fn scaling_table(runs: &[CrossRoomRun], baseline: &str, threshold: f64) -> String {
    let mut head = [
        "rooms",
        "seed",
        "R² > 0",
        "R² > 0.3",
        "best R²",
        "mean max(R², −1)",
    ]
    .map(str::to_owned)
    .to_vec();

    head.push(format!("Hit@{threshold}, {baseline}"));
    let mut lines = vec![head];
    for run in runs {
        let Some(summary) = MotionSummary::of(&run.r2(), 0) else {
            continue;
        };

        let MotionSummary {
            positive,
            above_0_3,
            best,
            clipped,
        } = summary;

        lines.push(vec![
            run.learned.len().to_string(),
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
            room_mean_text(&over_rooms(&run.hit_rates(baseline), 0)),
        ]);
    }

    aligned(&lines)
}

/// Room by room: pairs, R², and each navigator's hit rate.
pub fn rooms_table(run: &CrossRoomRun) -> String {
    let names = run.navigators();
    let mut lines = vec![
        ["room", "n", "R²"]
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

/// Everything of the runs, room by room.
pub fn cross_room_json(runs: &[CrossRoomRun], baseline: &str) -> Value {
    let run = |run: &CrossRoomRun| {
        let theirs = run.hit_rates(baseline);
        let navigator = |name: &str| {
            let ours = run.hit_rates(name);
            json!({
                "name": name,
                "beats_identity": wins(&run.outcomes, name).map(|rate| rate_json(&rate)),
                "hit": room_mean_json(&over_rooms(&ours, 0)),
                "over_baseline": room_mean_json(&difference(&ours, &theirs, 0)),
            })
        };

        let room = |outcome: &RoomOutcome| {
            let rates = outcome.rows.iter().filter_map(|row| {
                Some((row.name.clone(), rate_json(&outcome.hit_rate(&row.name)?)))
            });

            json!({
                "room": outcome.room.as_str(),
                "candidates": outcome.candidate_count,
                "motion": motion_json(&outcome.motion),
                "hit": rates.collect::<serde_json::Map<_, _>>(),
            })
        };

        let summary = MotionSummary::of(&run.r2(), 0).map(|summary| {
            json!({
                "positive": rate_json(&summary.positive),
                "above_0.3": rate_json(&summary.above_0_3),
                "best": summary.best,
                "clipped_mean": room_mean_json(&summary.clipped),
            })
        });

        json!({
            "learned_rooms": run.learned,
            "calibration_rooms": run.aside,
            "seed": run.seed,
            "r2": summary,
            "navigators": run.navigators().into_iter().map(navigator).collect::<Vec<_>>(),
            "rooms": run.outcomes.iter().map(room).collect::<Vec<_>>(),
            "skipped": run.skipped.iter().map(|(room, why)| json!({ "room": room, "why": why })).collect::<Vec<_>>(),
        })
    };

    json!({ "baseline": baseline, "runs": runs.iter().map(run).collect::<Vec<_>>() })
}

/// A mean over rooms, for scripts.
pub fn room_mean_json(mean: &RoomMean) -> Value {
    json!({ "mean": mean.mean, "low": mean.low, "high": mean.high, "rooms": mean.rooms })
}

/// A mean over rooms with its interval.
pub fn room_mean_text(mean: &RoomMean) -> String {
    // Of one room there is nothing to draw again.
    if mean.rooms < 2 {
        return format!("{:.3}", mean.mean);
    }

    format!("{:.3} [{:.3}, {:.3}]", mean.mean, mean.low, mean.high)
}

/// A difference over rooms with its interval.
pub fn room_difference_text(mean: &RoomMean) -> String {
    if mean.rooms < 2 {
        return format!("{:+.3}", mean.mean);
    }
    format!("{:+.3} [{:+.3}, {:+.3}]", mean.mean, mean.low, mean.high)
}

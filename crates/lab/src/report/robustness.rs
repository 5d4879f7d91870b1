//! Tracking results under disturbances, for `seese3 evaluate robustness`.

use serde::Serialize;

use super::odometry::{ScoresJson, scores_json, wrong_share};
use super::table::aligned;
use crate::experiments::robustness::{DisturbedTracking, Extent};
use crate::experiments::tracking_scores::{AnswerErrors, TrackingScores, VelocityErrors};
use seese3_core::splits::HoldOut;
use seese3_core::statistics::coverage;

/// One line per disturbance, over all rooms, in the order of `found`.
pub fn robustness_table(found: &[DisturbedTracking]) -> String {
    let head = [
        "disturbance",
        "n",
        "fused m",
        "nearest frame m",
        "standing still m",
        "TRACKING",
        "DEGRADED",
        "LOST",
        "TRACKING wrong",
        "within 68 %",
        "within 95 %",
        "velocity error m/s",
        "zero-velocity error m/s",
        "detected after",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    lines.extend(by_disturbance(found).iter().map(|rooms| line(rooms)));
    aligned(&lines)
}

/// Groups the results by disturbance, in order of first appearance.
fn by_disturbance(found: &[DisturbedTracking]) -> Vec<Vec<&DisturbedTracking>> {
    let mut groups: Vec<Vec<&DisturbedTracking>> = Vec::new();
    for one in found {
        let group = groups
            .iter_mut()
            .find(|group| group[0].disturbance == one.disturbance);
        match group {
            Some(group) => group.push(one),
            None => groups.push(vec![one]),
        }
    }

    groups
}

fn line(rooms: &[&DisturbedTracking]) -> Vec<String> {
    let scores = scores_of(rooms);
    let ape = AnswerErrors::mean(scores.iter().map(|scores| &scores.ape));
    let velocity = VelocityErrors::mean(scores.iter().map(|scores| &scores.velocity));
    let surprises: Vec<f64> = scores
        .iter()
        .flat_map(|scores| &scores.tracking_surprises)
        .copied()
        .collect();
    let covered = coverage(&surprises);
    let status = StatusJson::of(rooms);

    vec![
        rooms[0].disturbance.name(),
        frames(rooms).to_string(),
        format!("{:.3}", ape.fused),
        format!("{:.3}", ape.nearest_frame),
        format!("{:.3}", ape.standing_still),
        format!("{:.3}", status.tracking),
        format!("{:.3}", status.degraded),
        format!("{:.3}", status.lost),
        format!("{:.3}", wrong_share(&scores)),
        format!("{:.3}", covered.within_68),
        format!("{:.3}", covered.within_95),
        format!("{:.3}", velocity.error_m_s),
        format!("{:.3}", velocity.zero_m_s),
        match (rooms[0].disturbance.extent(), noticed_after(rooms)) {
            (Extent::Whole, _) => String::new(),
            (Extent::Part, Some(frames)) => frames.to_string(),
            (Extent::Part, None) => "not always".to_owned(),
        },
    ]
}

fn scores_of<'a>(rooms: &[&'a DisturbedTracking]) -> Vec<&'a TrackingScores> {
    rooms.iter().map(|room| &room.scores).collect()
}

fn frames(rooms: &[&DisturbedTracking]) -> usize {
    rooms.iter().map(|room| room.frames).sum()
}

/// The largest frame count over rooms; `None` if a room did not detect the disturbance.
fn noticed_after(rooms: &[&DisturbedTracking]) -> Option<usize> {
    rooms
        .iter()
        .try_fold(0, |most, room| Some(most.max(room.noticed_after?)))
}

/// The file of `seese3 evaluate robustness --json`.
#[derive(Debug, Serialize)]
pub struct RobustnessJson {
    /// One row per disturbance, over all rooms.
    rows: Vec<RowJson>,
    /// One row per disturbance and room.
    rooms: Vec<RowJson>,
    adapter: String,
    hold_out: &'static str,
}

#[derive(Debug, Serialize)]
struct RowJson {
    disturbance: String,
    /// The room; absent in rows over all rooms.
    #[serde(skip_serializing_if = "Option::is_none")]
    room: Option<String>,
    /// Number of scored frames.
    n: usize,
    #[serde(flatten)]
    scores: ScoresJson,
    status: StatusJson,
    /// Number of disturbed frames until the status left TRACKING. Null if it stayed TRACKING, or
    /// if the disturbance covers whole streams.
    noticed_after: Option<usize>,
}

/// Fractions of the scored frames by status.
#[derive(Debug, Serialize)]
struct StatusJson {
    tracking: f64,
    degraded: f64,
    lost: f64,
    relocalizing: f64,
}

/// Builds the JSON record of an evaluation with the named adapter.
pub fn robustness_json(
    found: &[DisturbedTracking],
    adapter: &str,
    hold_out: HoldOut,
) -> RobustnessJson {
    let one = |room: &DisturbedTracking| RowJson {
        room: Some(room.room.clone()),
        ..RowJson::of(&[room])
    };

    RobustnessJson {
        rows: by_disturbance(found)
            .iter()
            .map(|rooms| RowJson::of(rooms))
            .collect(),
        rooms: found.iter().map(one).collect(),
        adapter: adapter.to_owned(),
        hold_out: hold_out.name(),
    }
}

impl RowJson {
    fn of(rooms: &[&DisturbedTracking]) -> Self {
        Self {
            disturbance: rooms[0].disturbance.name(),
            room: None,
            n: frames(rooms),
            scores: scores_json(&scores_of(rooms)),
            status: StatusJson::of(rooms),
            noticed_after: match rooms[0].disturbance.extent() {
                Extent::Whole => None,
                Extent::Part => noticed_after(rooms),
            },
        }
    }
}

impl StatusJson {
    fn of(rooms: &[&DisturbedTracking]) -> Self {
        let count = frames(rooms) as f64;
        let share = |of: fn(&DisturbedTracking) -> f64| {
            let counted = rooms.iter().map(|room| of(room) * room.frames as f64);
            counted.sum::<f64>() / count
        };

        Self {
            tracking: share(|room| room.statuses.tracking),
            degraded: share(|room| room.statuses.degraded),
            lost: share(|room| room.statuses.lost),
            relocalizing: share(|room| room.statuses.relocalizing),
        }
    }
}

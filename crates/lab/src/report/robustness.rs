//! Tracking results under disturbances, for `seese3 evaluate robustness`.

use serde::Serialize;

use super::table::Column::{self, Number, Text};
use super::table::{Table, grouped};
use crate::experiments::robustness::{DisturbedTracking, Extent};
use crate::json::covered;
use seese3_core::splits::HoldOut;

/// One line per disturbance, over all rooms, in the order of `found`.
pub fn robustness_table(found: &[DisturbedTracking]) -> Table {
    let columns: [Column<DisturbedTracking>; 14] = [
        Text("disturbance", |line| line.disturbance.name()),
        Text("n", |line| line.frames.to_string()),
        Number("fused m", 3, |line| line.scores.ape.fused),
        Number("nearest frame m", 3, |line| line.scores.ape.nearest_frame),
        Number("standing still m", 3, |line| line.scores.ape.standing_still),
        Number("TRACKING", 3, |line| line.statuses.tracking),
        Number("DEGRADED", 3, |line| line.statuses.degraded),
        Number("LOST", 3, |line| line.statuses.lost),
        Number("TRACKING wrong", 3, |line| {
            line.scores.tracking_wrong.into()
        }),
        Number("within 68 %", 3, |line| {
            covered(&line.scores.tracking_surprises)[0]
        }),
        Number("within 95 %", 3, |line| {
            covered(&line.scores.tracking_surprises)[1]
        }),
        Number("velocity error m/s", 3, |line| {
            line.scores.velocity.error_m_s
        }),
        Number("zero-velocity error m/s", 3, |line| {
            line.scores.velocity.zero_m_s
        }),
        Text("detected after", |line| {
            match (line.disturbance.extent(), line.noticed_after) {
                (Extent::Whole, _) => String::new(),
                (Extent::Part, Some(frames)) => frames.to_string(),
                (Extent::Part, None) => "not always".to_owned(),
            }
        }),
    ];

    Table::of(&by_disturbance(found), &columns)
}

/// The results over all rooms by disturbance, in order of first appearance.
fn by_disturbance(found: &[DisturbedTracking]) -> Vec<DisturbedTracking> {
    let groups = grouped(found, |one| one.disturbance);
    let together = groups
        .iter()
        .map(|rooms| DisturbedTracking::together(rooms));
    together.collect()
}

/// The file of `seese3 evaluate robustness --json`.
#[derive(Debug, Serialize)]
pub struct RobustnessJson {
    /// One row per disturbance, over all rooms.
    rows: Vec<DisturbedTracking>,
    /// One row per disturbance and room.
    rooms: Vec<DisturbedTracking>,
    adapter: Option<String>,
    hold_out: &'static str,
}

/// Builds the JSON record of an evaluation with the named adapter, or without one.
pub fn robustness_json(
    found: &[DisturbedTracking],
    adapter: Option<&str>,
    hold_out: HoldOut,
) -> RobustnessJson {
    let one = |room: &DisturbedTracking| DisturbedTracking {
        room: room.room.clone(),
        ..DisturbedTracking::together(&[room])
    };

    RobustnessJson {
        rows: by_disturbance(found),
        rooms: found.iter().map(one).collect(),
        adapter: adapter.map(str::to_owned),
        hold_out: hold_out.name(),
    }
}

//! Comparison of planners, for `seese3 evaluate planning`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::table::Column::{self, Number, Text};
use super::table::Table;
use crate::experiments::planning::{Planner, PlannerScores, PlanningProtocol, RoomPlanning};
use seese3_core::statistics::Rate;

/// One line per planner, over the queries of all rooms. The interval of several rooms is over
/// rooms.
pub fn planning_table(rooms: &[RoomPlanning]) -> Table {
    let columns: [Column<Line>; 8] = [
        Text("planner", |line| line.planner.title().to_owned()),
        Number("says reached", 3, |Line { all, .. }| {
            share(all.says_reached, all.questions)
        }),
        Number("truly there", 3, |line| line.truly_there.rate),
        Text("95 %", |line| {
            format!(
                "[{:.3}, {:.3}]",
                line.truly_there.low, line.truly_there.high
            )
        }),
        Number("says reached, not there", 3, |Line { all, .. }| {
            share(all.says_reached - all.truly_there, all.questions)
        }),
        Number("steps", 1, |Line { all, .. }| {
            share(all.steps, all.truly_there)
        }),
        Number("longest hop", 2, |line| line.all.longest_hop),
        Text("other rooms: says reached", |Line { all, .. }| {
            match all.other_questions {
                0 => String::new(),
                questions => format!("{:.3}", share(all.other_says_reached, questions)),
            }
        }),
    ];

    Table::of(
        &Planner::ALL.map(|planner| Line::of(rooms, planner)),
        &columns,
    )
}

/// The scores of a planner.
struct Line {
    planner: Planner,
    /// Over the queries of all rooms.
    all: PlannerScores,
    truly_there: Rate,
}

impl Line {
    fn of(rooms: &[RoomPlanning], planner: Planner) -> Self {
        let counts: Vec<(usize, usize)> = rooms
            .iter()
            .filter_map(|room| room.scores.get(&planner))
            .map(|scores| (scores.truly_there, scores.questions))
            .collect();

        Self {
            planner,
            all: all(rooms, planner),
            truly_there: match counts[..] {
                // Queries of one room are drawn independently.
                [(there, questions)] => Rate::of(there, questions),
                _ => Rate::of_blocks(&counts),
            },
        }
    }
}

fn all(rooms: &[RoomPlanning], planner: Planner) -> PlannerScores {
    PlannerScores::sum(rooms.iter().filter_map(|room| room.scores.get(&planner)))
}

fn share(part: usize, whole: usize) -> f64 {
    part as f64 / whole as f64
}

impl Planner {
    /// Its name in tables.
    fn title(self) -> &'static str {
        match self {
            Self::Ours => "ours",
            Self::Latent => "latent way",
            Self::Greedy => "greedy nearest pose",
            Self::PoseGraph => "pose graph",
            Self::Topological => "topological graph",
            Self::StandingStill => "standing still",
        }
    }
}

/// The file of `seese3 evaluate planning --json`.
#[derive(Debug, Serialize)]
pub struct PlanningJson<'a> {
    /// Scores by planner, over the queries of all rooms.
    #[serde(flatten)]
    all: BTreeMap<Planner, PlannerScores>,
    rooms: &'a [RoomPlanning],
    protocol: ProtocolJson<'a>,
}

#[derive(Debug, Serialize)]
struct ProtocolJson<'a> {
    hold_out: &'static str,
    questions_per_room: usize,
    seed: u64,
    adapter: &'a str,
    /// Whether an adapter was fitted to the mapped frames.
    fit: bool,
    /// The requested longest hop; null for the adapter's own.
    step: Option<f64>,
}

/// Builds the JSON record of an evaluation with the named adapter.
pub fn planning_json<'a>(
    rooms: &'a [RoomPlanning],
    protocol: &PlanningProtocol,
    adapter: &'a str,
) -> PlanningJson<'a> {
    PlanningJson {
        all: Planner::ALL
            .map(|planner| (planner, all(rooms, planner)))
            .into(),
        rooms,
        protocol: ProtocolJson {
            hold_out: protocol.hold_out.name(),
            questions_per_room: protocol.questions,
            seed: protocol.seed,
            adapter,
            fit: protocol.is_fitted,
            step: protocol.longest_hop,
        },
    }
}

//! Comparison of planners, for `seese3 evaluate planning`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::table::Column::{self, Number, Text};
use super::table::Table;
use crate::experiments::planning::{Planner, PlannerScores, PlanningProtocol, RoomPlanning};
use seese3_core::statistics::Rate;

/// One line per planner, over the queries of all rooms.
pub fn planning_table(rooms: &[RoomPlanning]) -> Table {
    type Row = (Planner, PlannerScores);
    let of_all_rooms = |planner| (planner, all(rooms, planner));

    let columns: [Column<Row>; 8] = [
        Text("planner", |(planner, _)| planner.title().to_owned()),
        Number("says reached", 3, |(_, all)| {
            share(all.says_reached, all.questions)
        }),
        Number("truly there", 3, |(_, all)| {
            share(all.truly_there, all.questions)
        }),
        Text("95 %", |(_, all)| {
            let there = Rate::of(all.truly_there, all.questions);
            format!("[{:.3}, {:.3}]", there.low, there.high)
        }),
        Number("says reached, not there", 3, |(_, all)| {
            share(all.says_reached - all.truly_there, all.questions)
        }),
        Number("steps", 1, |(_, all)| share(all.steps, all.truly_there)),
        Number("longest hop", 2, |(_, all)| all.longest_hop),
        Text("other rooms: says reached", |(_, all)| {
            match all.other_questions {
                0 => String::new(),
                questions => format!("{:.3}", share(all.other_says_reached, questions)),
            }
        }),
    ];

    Table::of(&Planner::ALL.map(of_all_rooms), &columns)
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

//! Comparison of planners, for `seese3 evaluate planning`.

use std::collections::BTreeMap;

use serde::Serialize;
use strum::VariantArray;

use super::table::aligned;
use crate::experiments::planning::{Planner, PlannerScores, PlanningProtocol, RoomPlanning};
use seese3_core::statistics::Rate;

/// One line per planner, over the queries of all rooms.
pub fn planning_table(rooms: &[RoomPlanning]) -> String {
    let head = [
        "planner",
        "says reached",
        "truly there",
        "95 %",
        "says reached, not there",
        "steps",
        "longest hop",
        "other rooms: says reached",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for &planner in Planner::VARIANTS {
        let scores = all(rooms, planner);
        let there = Rate::of(scores.truly_there, scores.questions);
        let wrong = scores.says_reached - scores.truly_there;
        lines.push(vec![
            planner.title().to_owned(),
            format!("{:.3}", share(scores.says_reached, scores.questions)),
            format!("{:.3}", there.rate),
            format!("[{:.3}, {:.3}]", there.low, there.high),
            format!("{:.3}", share(wrong, scores.questions)),
            format!("{:.1}", share(scores.steps, scores.truly_there)),
            format!("{:.2}", scores.longest_hop),
            if scores.other_questions == 0 {
                String::new()
            } else {
                format!(
                    "{:.3}",
                    share(scores.other_says_reached, scores.other_questions)
                )
            },
        ]);
    }

    aligned(&lines)
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
pub struct PlanningJson {
    /// Scores by planner, over the queries of all rooms.
    #[serde(flatten)]
    all: BTreeMap<&'static str, PlannerJson>,
    rooms: Vec<RoomJson>,
    protocol: ProtocolJson,
}

#[derive(Debug, Serialize)]
struct RoomJson {
    room: String,
    mapped_frames: usize,
    /// The longest allowed hop, metres and radians mixed.
    allowed_hop: f64,
    #[serde(flatten)]
    planners: BTreeMap<&'static str, PlannerJson>,
}

#[derive(Debug, Serialize)]
struct PlannerJson {
    n: usize,
    /// Fraction of queries for which the planner reported success.
    says_reached: f64,
    /// Fraction of queries with reported success and the robot at the goal.
    truly_there: f64,
    /// Fraction of queries with the robot at the goal, whatever the planner reported.
    there_anyway: f64,
    /// Mean arrival probability over all queries, 0 where nothing was planned; null for planners
    /// without probabilities.
    expected_there: Option<f64>,
    /// Mean number of hops of the queries counted in `truly_there`; null without any.
    steps: Option<f64>,
    longest_hop: f64,
    other_rooms: OtherRoomsJson,
}

/// Scores of queries with views of other rooms.
#[derive(Debug, Serialize)]
struct OtherRoomsJson {
    n: usize,
    /// Fraction of queries with reported success; null without any query.
    says_reached: Option<f64>,
}

#[derive(Debug, Serialize)]
struct ProtocolJson {
    hold_out: &'static str,
    questions_per_room: usize,
    seed: u64,
    adapter: String,
    /// Whether an adapter was fitted to the mapped frames.
    fit: bool,
    /// The requested longest hop; null for the adapter's own.
    step: Option<f64>,
}

/// Builds the JSON record of an evaluation with the named adapter.
pub fn planning_json(
    rooms: &[RoomPlanning],
    protocol: &PlanningProtocol,
    adapter: &str,
) -> PlanningJson {
    let by_planner = |scores: &dyn Fn(Planner) -> PlannerScores| {
        Planner::VARIANTS
            .iter()
            .map(|&planner| (planner.into(), PlannerJson::of(&scores(planner))))
            .collect()
    };

    let room = |room: &RoomPlanning| RoomJson {
        room: room.room.clone(),
        mapped_frames: room.mapped_frames,
        allowed_hop: room.longest_hop,
        planners: by_planner(&|planner| all(std::slice::from_ref(room), planner)),
    };

    PlanningJson {
        all: by_planner(&|planner| all(rooms, planner)),
        rooms: rooms.iter().map(room).collect(),
        protocol: ProtocolJson {
            hold_out: protocol.hold_out.name(),
            questions_per_room: protocol.questions,
            seed: protocol.seed,
            adapter: adapter.to_owned(),
            fit: protocol.is_fitted,
            step: protocol.longest_hop,
        },
    }
}

impl PlannerJson {
    fn of(scores: &PlannerScores) -> Self {
        let known = |part: usize, whole: usize| (whole > 0).then(|| share(part, whole));
        Self {
            n: scores.questions,
            says_reached: share(scores.says_reached, scores.questions),
            truly_there: share(scores.truly_there, scores.questions),
            there_anyway: share(scores.there_anyway, scores.questions),
            expected_there: (scores.expected_there > 0.0)
                .then(|| scores.expected_there / scores.questions as f64),
            steps: known(scores.steps, scores.truly_there),
            longest_hop: scores.longest_hop,
            other_rooms: OtherRoomsJson {
                n: scores.other_questions,
                says_reached: known(scores.other_says_reached, scores.other_questions),
            },
        }
    }
}

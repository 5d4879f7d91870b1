//! Compares planners: from an unmapped view to a mapped goal, driven open-loop.
//!
//! A planner knows only the mapped frames of a room: every second frame, or those of another
//! hold-out. A query is the view of an unmapped frame, with a mapped frame as the goal. The planner
//! returns its estimate of the camera pose and a sequence of poses to drive to. A simulated robot
//! executes these motions from the true camera pose. The planner succeeds if the robot ends within
//! the tolerance of the goal.
//!
//! Views of other rooms are queried too; there a planner should find no path.

use std::collections::BTreeMap;
use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::ser::SerializeStruct;
use serde::{Serialize, Serializer};
use serde_json::json;

use seese3_core::adapter::{Adapter, Reading};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Pose, PoseError, body_twist};
use seese3_core::navigation::{self, Outcome, Start, Stepper, pursue};
use seese3_core::room::FrameId;
use seese3_core::training::RoomData;
use seese3_robot::localization::AdapterLocalizer;
use seese3_robot::planning::{BelievedStart, Planned, plan};
use seese3_robot::tracking::{MapQuery, PoseReader};

use super::Error;
pub use super::mapped_room::{MappedRoom, PlannedWay, PlanningProtocol, PlanningQuestion};
use super::simple_planners::{greedy, pose_graph, topological};

/// Number of query views from each other room.
const OTHER_ROOM_VIEWS: usize = 5;

/// A planner that is evaluated, by its key in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Planner {
    /// Each hop moves to the reachable frame nearest to the goal.
    Greedy,
    /// The paper's latent navigation: each step retrieves a frame near the predicted latent.
    Latent,
    /// The server's planner: the shortest path over the room's frames from the estimated pose.
    Ours,
    /// The shortest path over the frames' poses, from the pose of the nearest frame.
    PoseGraph,
    /// The robot does not move.
    StandingStill,
    /// The shortest path over visually similar frames.
    Topological,
}

impl Planner {
    /// Every planner, in the order of tables.
    pub const ALL: [Self; 6] = [
        Self::Ours,
        Self::Latent,
        Self::Greedy,
        Self::PoseGraph,
        Self::Topological,
        Self::StandingStill,
    ];
}

/// Scores of one planner. In JSON, fractions of the queries.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PlannerScores {
    /// Number of queries with views of the room.
    pub questions: usize,
    /// Number of queries for which the planner reported success.
    pub says_reached: usize,
    /// Number of reported successes with the robot within the tolerance of the goal.
    pub truly_there: usize,
    /// Number of queries with the robot within the tolerance, whatever the planner reported.
    pub there_anyway: usize,
    /// Sum of the planner's arrival probabilities; 0 for planners without them.
    pub expected_there: f64,
    /// Total number of hops in the queries counted in `truly_there`.
    pub steps: usize,
    /// The longest hop, ‖(v, ω)‖ with meters and radians mixed.
    pub longest_hop: f64,
    /// Number of queries with views of other rooms.
    pub other_questions: usize,
    /// Number of those queries for which the planner reported success.
    pub other_says_reached: usize,
}

impl Serialize for PlannerScores {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let share = |part: usize| part as f64 / self.questions as f64;
        let known = |part: usize, whole: usize| (whole > 0).then(|| part as f64 / whole as f64);

        // Null for planners without probabilities.
        let expected_there =
            (self.expected_there > 0.0).then(|| self.expected_there / self.questions as f64);
        let other_rooms = json!({
            "n": self.other_questions,
            "says_reached": known(self.other_says_reached, self.other_questions),
        });

        let mut record = to.serialize_struct("PlannerScores", 8)?;
        record.serialize_field("n", &self.questions)?;
        record.serialize_field("says_reached", &share(self.says_reached))?;
        record.serialize_field("truly_there", &share(self.truly_there))?;
        record.serialize_field("there_anyway", &share(self.there_anyway))?;
        record.serialize_field("expected_there", &expected_there)?;
        record.serialize_field("steps", &known(self.steps, self.truly_there))?;
        record.serialize_field("longest_hop", &self.longest_hop)?;
        record.serialize_field("other_rooms", &other_rooms)?;
        record.end()
    }
}

/// The scores in one room, by planner.
#[derive(Debug, Clone, Serialize)]
pub struct RoomPlanning {
    /// The room.
    pub room: String,
    /// Number of mapped frames.
    pub mapped_frames: usize,
    /// The longest allowed hop, ‖(v, ω)‖ with meters and radians mixed.
    #[serde(rename = "allowed_hop")]
    pub longest_hop: f64,
    /// Scores by planner.
    #[serde(flatten)]
    pub scores: BTreeMap<Planner, PlannerScores>,
}

fn answer(
    room: &MappedRoom,
    planner: Planner,
    question: &PlanningQuestion,
) -> Result<PlannedWay, Error> {
    match planner {
        Planner::Ours => ours(room, question),
        Planner::Latent => latent(room, question),
        Planner::Greedy => Ok(greedy(room, question)),
        Planner::PoseGraph => Ok(pose_graph(room, question)),
        Planner::Topological => Ok(topological(room, question)),
        Planner::StandingStill => Ok(PlannedWay {
            start: Pose::identity(),
            poses: Vec::new(),
            says_reached: true,
            probability: None,
        }),
    }
}

fn ours(room: &MappedRoom, question: &PlanningQuestion) -> Result<PlannedWay, Error> {
    let localizer = AdapterLocalizer {
        navigator: &room.navigator,
        map: room.map.as_ref(),
        reader: room.reader.as_ref().map(|reader| reader as &dyn PoseReader),
    };
    let start = BelievedStart::of_adapter(localizer.estimate(MapQuery {
        latent: question.latent.view(),
        feature: Some(question.feature.as_slice()),
    }));
    let goal = room.poses()[question.goal.row()];
    let planned = plan(
        &room.navigator,
        &start,
        &goal,
        room.bounds,
        &Cancellation::default(),
    );

    let nothing = PlannedWay {
        start: start.pose,
        poses: Vec::new(),
        says_reached: false,
        probability: None,
    };
    Ok(match planned.map_err(navigation::Error::from)? {
        Planned::Way {
            route,
            arrival_probability,
        } => PlannedWay {
            poses: room.poses_of(&route),
            says_reached: true,
            probability: arrival_probability,
            ..nothing
        },
        Planned::StartUnknown(_) | Planned::NoRoute(_) => nothing,
    })
}

fn latent(room: &MappedRoom, question: &PlanningQuestion) -> Result<PlannedWay, Error> {
    let pose = room.navigator.nearest(question.latent.view(), 1)[0].pose;
    let start = Start {
        latent: question.latent.clone(),
        frame: None,
        pose: Some(pose),
    };

    let mut poses: Vec<Pose> = Vec::new();
    let outcome = pursue(
        &room.navigator,
        &Stepper::InversePoincare(Reading::Homogeneous),
        start,
        &room.poses()[question.goal.row()],
        room.pursuit,
        &Cancellation::default(),
        &mut |feedback| {
            // A step without a new frame repeats the last frame; skip it.
            let at = feedback.frame.map(|frame| frame.pose);
            if let Some(at) = at.filter(|at| poses.last() != Some(at)) {
                poses.push(at);
            }
        },
    )?;

    Ok(PlannedWay {
        start: pose,
        poses,
        says_reached: outcome == Outcome::Reached,
        probability: None,
    })
}

/// Evaluates every planner in every room; `done` is called after each room.
///
/// # Errors
/// [`Error`] when a room is too small, or its features do not match the adapter.
pub fn evaluate(
    rooms: &[RoomData<'_>],
    adapter: &Arc<Adapter>,
    protocol: &PlanningProtocol,
    done: &(dyn Fn() + Sync),
) -> Result<Vec<RoomPlanning>, Error> {
    let one = |(place, data): (usize, &RoomData<'_>)| {
        let mapped = MappedRoom::new(data, adapter, protocol)?;
        let mut random = ChaCha8Rng::seed_from_u64(protocol.seed);
        random.set_stream(place as u64);
        let mut scores: BTreeMap<Planner, PlannerScores> = BTreeMap::new();

        let asked = protocol.hold_out.tracked(data.room.timeline());
        for _ in 0..protocol.questions {
            let frame = asked[random.random_range(0..asked.len())];
            let goal = mapped.any_frame(&mut random);
            let question = question(data, adapter, frame, goal)?;
            let truth = &data.room.poses()[frame.row()];
            for planner in Planner::ALL {
                let way = answer(&mapped, planner, &question)?;
                scores
                    .entry(planner)
                    .or_default()
                    .add(&way, truth, &mapped, goal);
            }
        }

        for other in rooms
            .iter()
            .filter(|other| other.room.id() != data.room.id())
        {
            for _ in 0..OTHER_ROOM_VIEWS {
                let frame = FrameId(random.random_range(0..other.room.frame_count() as u32));
                let goal = mapped.any_frame(&mut random);
                let question = question(other, adapter, frame, goal)?;
                for planner in Planner::ALL {
                    let says_reached = answer(&mapped, planner, &question)?.says_reached;
                    let scores = scores.entry(planner).or_default();
                    scores.other_questions += 1;
                    scores.other_says_reached += usize::from(says_reached);
                }
            }
        }

        done();
        Ok(RoomPlanning {
            room: data.room.id().to_string(),
            mapped_frames: mapped.poses().len(),
            longest_hop: mapped.pursuit.step,
            scores,
        })
    };

    rooms.par_iter().enumerate().map(one).collect()
}

impl MappedRoom {
    fn any_frame(&self, random: &mut ChaCha8Rng) -> FrameId {
        FrameId(random.random_range(0..self.poses().len() as u32))
    }
}

fn question(
    data: &RoomData<'_>,
    adapter: &Adapter,
    frame: FrameId,
    goal: FrameId,
) -> Result<PlanningQuestion, Error> {
    let feature = data.features.rows().row(frame.row()).to_vec();

    Ok(PlanningQuestion {
        latent: adapter.embed_one(&feature)?,
        feature,
        goal,
    })
}

impl PlannerScores {
    /// Adds one answer: executes its motions from the true camera pose.
    fn add(&mut self, way: &PlannedWay, truth: &Pose, room: &MappedRoom, goal: FrameId) {
        let end = way.poses.last().unwrap_or(&way.start);
        let driven = truth * way.start.inv_mul(end);
        let left = PoseError::between(&driven, &room.poses()[goal.row()]);
        let is_there = room.pursuit.is_reached(&left);

        self.questions += 1;
        self.says_reached += usize::from(way.says_reached);
        self.there_anyway += usize::from(is_there);
        self.expected_there += way.probability.unwrap_or(0.0);
        if way.says_reached && is_there {
            self.truly_there += 1;
            self.steps += way.poses.len();
        }

        let mut at = &way.start;
        for pose in &way.poses {
            self.longest_hop = self.longest_hop.max(body_twist(at, pose).norm());
            at = pose;
        }
    }

    /// Sums the scores of several rooms.
    pub fn sum<'a>(rooms: impl Iterator<Item = &'a Self>) -> Self {
        rooms.fold(Self::default(), |sum, room| Self {
            questions: sum.questions + room.questions,
            says_reached: sum.says_reached + room.says_reached,
            truly_there: sum.truly_there + room.truly_there,
            there_anyway: sum.there_anyway + room.there_anyway,
            expected_there: sum.expected_there + room.expected_there,
            steps: sum.steps + room.steps,
            longest_hop: sum.longest_hop.max(room.longest_hop),
            other_questions: sum.other_questions + room.other_questions,
            other_says_reached: sum.other_says_reached + room.other_says_reached,
        })
    }
}

//! Baseline planners. Each starts from the pose of a stored frame and does not check whether the
//! camera is there.

use std::collections::BTreeSet;

use ndarray::{Array1, ArrayView1, Axis};

use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Pose, PoseError, body_twist};
use seese3_core::room::FrameId;
use seese3_robot::planning::PoseGraph;

use super::mapped_room::{MappedRoom, PlannedWay, PlanningQuestion};

/// Number of most similar frames to which the topological graph connects each frame.
const LOOK_ALIKE: usize = 10;

/// Greedy planner. It starts at the frame with the nearest latent and moves, among the frames
/// within one hop, to the one nearest to the goal. It stops when no frame is nearer.
pub(super) fn greedy(room: &MappedRoom, question: &PlanningQuestion) -> PlannedWay {
    let start = room.navigator.nearest(question.latent.view(), 1)[0].pose;
    let goal = room.poses()[question.goal.row()];
    let bounds = room.pursuit();

    let mut poses = Vec::new();
    let mut at = start;
    loop {
        let left = body_twist(&at, &goal).norm();
        let next = room
            .poses()
            .iter()
            .filter(|pose| body_twist(&at, pose).norm() <= bounds.step)
            .map(|pose| (body_twist(pose, &goal).norm(), pose))
            .min_by(|a, b| a.0.total_cmp(&b.0));

        match next {
            Some((nearer, pose)) if nearer < left => {
                at = *pose;
                poses.push(at);
            }
            _ => break,
        }
    }

    PlannedWay {
        start,
        poses,
        says_reached: bounds.is_reached(&PoseError::between(&at, &goal)),
        probability: None,
    }
}

/// Pose-graph planner: the shortest path over the poses of all frames, from the frame with the
/// nearest latent.
pub(super) fn pose_graph(room: &MappedRoom, question: &PlanningQuestion) -> PlannedWay {
    let start = room.navigator.nearest(question.latent.view(), 1)[0].pose;
    let goal = room.poses()[question.goal.row()];
    let frames: Vec<FrameId> = (0..room.poses().len() as u32).map(FrameId).collect();

    let route = PoseGraph::new(room.poses(), &frames).route(
        &start,
        &goal,
        room.bounds(),
        &Cancellation::default(),
    );
    let route = route.ok().and_then(Result::ok);
    let poses = route
        .as_ref()
        .map_or_else(Vec::new, |route| room.poses_of(route));

    PlannedWay {
        start,
        poses,
        says_reached: route.is_some(),
        probability: None,
    }
}

/// Topological planner: the shortest path over similar frames, by the cosine of their raw
/// features. Each frame has edges to its ten most similar frames and to the rows before and after
/// it. Poses are used only to drive from frame to frame.
pub(super) fn topological(room: &MappedRoom, question: &PlanningQuestion) -> PlannedWay {
    let directions = Directions::of(room);
    let view = direction(ArrayView1::from(&question.feature));
    let distances = directions.distances(view.view());
    let first = nearest(&distances, 1)[0];

    let mut cost = vec![f64::INFINITY; distances.len()];
    let mut before = vec![usize::MAX; distances.len()];
    cost[first] = 0.0;
    let mut open: BTreeSet<usize> = (0..distances.len()).collect();
    while let Some(&at) = open.iter().min_by(|a, b| cost[**a].total_cmp(&cost[**b])) {
        open.remove(&at);
        for (next, distance) in directions.joined(at) {
            if cost[at] + distance < cost[next] {
                cost[next] = cost[at] + distance;
                before[next] = at;
            }
        }
    }

    let goal = question.goal.row();
    let mut way = vec![goal];
    while way[way.len() - 1] != first && before[way[way.len() - 1]] != usize::MAX {
        way.push(before[way[way.len() - 1]]);
    }

    let poses: Vec<Pose> = way.iter().rev().map(|&row| room.poses()[row]).collect();
    PlannedWay {
        start: room.poses()[first],
        says_reached: cost[goal].is_finite(),
        poses: poses[1..].to_vec(),
        probability: None,
    }
}

/// Raw features, normalized to length one, row by frame.
struct Directions {
    rows: Vec<Array1<f64>>,
}

impl Directions {
    fn of(room: &MappedRoom) -> Self {
        let rows = room.features.rows();
        Self {
            rows: rows.axis_iter(Axis(0)).map(direction).collect(),
        }
    }

    fn distances(&self, to: ArrayView1<'_, f64>) -> Vec<f64> {
        self.rows.iter().map(|row| 1.0 - row.dot(&to)).collect()
    }

    /// The frames connected to a frame, with their cosine distances.
    fn joined(&self, row: usize) -> Vec<(usize, f64)> {
        let distances = self.distances(self.rows[row].view());
        let mut joined = nearest(&distances, LOOK_ALIKE + 1);
        joined.extend([row.saturating_sub(1), (row + 1).min(self.rows.len() - 1)]);

        joined
            .into_iter()
            .filter(|other| *other != row)
            .map(|other| (other, distances[other].max(0.0)))
            .collect()
    }
}

fn direction(feature: ArrayView1<'_, f32>) -> Array1<f64> {
    let feature = feature.mapv(f64::from);
    let length = feature.dot(&feature).sqrt().max(f64::MIN_POSITIVE);
    feature / length
}

/// Indices of the `count` smallest distances, smallest first.
fn nearest(distances: &[f64], count: usize) -> Vec<usize> {
    let mut places: Vec<usize> = (0..distances.len()).collect();
    places.sort_by(|&a, &b| distances[a].total_cmp(&distances[b]));
    places.truncate(count);
    places
}

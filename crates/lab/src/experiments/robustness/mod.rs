//! Evaluates a tracker under disturbances of its images, beside simple baselines on the same
//! frames. The images are rolled, blurred, darkened, occluded, frozen or subsampled.
//!
//! The map uses the undisturbed images; each stream starts with its true pose. A disturbance of
//! part of a stream is scored on the disturbed frames only.

mod disturbance;

use nalgebra::{Unit, Vector3};
use serde::{Serialize, Serializer};

use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_robot::tracking::Status;

pub use disturbance::{Disturbance, Extent};

use super::replay::{Replay, joined, period_ns};
use super::tracking_scores::{StatusShares, TrackingScores};

/// Maximum number of frames for which a camera is frozen or blank.
const MOST_DISTURBED: usize = 60;

/// Tracking results under one disturbance, of one room or of several rooms together.
#[derive(Debug, Clone, Serialize)]
pub struct DisturbedTracking {
    /// The disturbance.
    #[serde(serialize_with = "disturbance_name")]
    pub disturbance: Disturbance,
    /// The room; `None` for several rooms together.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub room: Option<String>,
    /// Number of scored frames.
    #[serde(rename = "n")]
    pub frames: usize,
    /// Errors of the tracker and of its baselines.
    #[serde(flatten)]
    pub scores: TrackingScores,
    /// Fractions of the scored frames by status.
    #[serde(rename = "status")]
    pub statuses: StatusShares,
    /// Number of disturbed frames until the status left TRACKING, in the slowest stream. `None` if
    /// a stream stayed TRACKING, or if the disturbance covers whole streams.
    pub noticed_after: Option<usize>,
}

fn disturbance_name<S: Serializer>(which: &Disturbance, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&which.name())
}

impl DisturbedTracking {
    /// Results of rooms under one disturbance together; at least one room.
    pub fn together(rooms: &[&Self]) -> Self {
        let frames = rooms.iter().map(|room| room.frames).sum();
        let share = |of: fn(&StatusShares) -> f64| {
            let counted = rooms
                .iter()
                .map(|room| of(&room.statuses) * room.frames as f64);
            counted.sum::<f64>() / frames as f64
        };

        Self {
            disturbance: rooms[0].disturbance,
            room: None,
            frames,
            scores: TrackingScores::together(rooms.iter().map(|room| &room.scores)),
            statuses: StatusShares {
                tracking: share(|shares| shares.tracking),
                degraded: share(|shares| shares.degraded),
                lost: share(|shares| shares.lost),
                relocalizing: share(|shares| shares.relocalizing),
            },
            noticed_after: slowest(rooms.iter().map(|room| room.noticed_after)),
        }
    }
}

/// The largest number of frames; `None` if one is `None`.
fn slowest(mut noticed: impl Iterator<Item = Option<usize>>) -> Option<usize> {
    noticed.try_fold(0, |most, frames| Some(most.max(frames?)))
}

/// Range of scored frames in one stream, from `begin` up to `end` (exclusive).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Part {
    begin: usize,
    end: usize,
}

impl Part {
    fn of(extent: Extent, count: usize) -> Self {
        match extent {
            Extent::Whole => Self {
                begin: 0,
                end: count,
            },
            Extent::Part => Self {
                begin: count / 3,
                end: count / 3 + (count / 3).min(MOST_DISTURBED),
            },
        }
    }

    fn holds(self, number: usize) -> bool {
        (self.begin..self.end).contains(&number)
    }
}

/// The down direction in a recording's world frame: the signed world axis nearest to the mean
/// y axis of the camera, which points down when the camera is level.
pub(super) fn down_of(poses: &[Pose]) -> Unit<Vector3<f64>> {
    let sum: Vector3<f64> = poses.iter().map(|pose| pose.rotation * Vector3::y()).sum();
    let axis = sum.iamax();
    Unit::new_unchecked(Vector3::ith(axis, sum[axis].signum()))
}

/// The tracked frames of a room under a hold-out, one list per stream.
fn streams(room: &Room, hold_out: HoldOut) -> Vec<Vec<FrameId>> {
    let timeline = room.timeline();
    hold_out
        .tracked(timeline)
        .chunk_by(|a, b| timeline.joins(*a, *b))
        .map(<[FrameId]>::to_vec)
        .collect()
}

/// A stream of a disturbed camera.
pub(super) struct PlannedStream {
    /// The frames that the camera takes.
    pub frames: Vec<PlannedFrame>,
    /// Mean frame period of the recording, nanoseconds.
    pub period_ns: i64,
    /// Whether frames are scored: a stream of two frames may have no disturbed one.
    is_scored: bool,
}

/// A frame of a disturbed stream.
#[derive(Debug, Clone, Copy)]
pub(super) struct PlannedFrame {
    /// The true pose of the disturbed camera, `world_from_camera`.
    pub truth: Pose,
    /// Row of the view among the tracked frames of the room.
    pub view: usize,
    pub time_ns: i64,
    pub sequence: u64,
    pub is_disturbed: bool,
    is_scored: bool,
}

/// The disturbed streams of a room.
pub(super) fn plan(room: &Room, hold_out: HoldOut, disturbance: Disturbance) -> Vec<PlannedStream> {
    let mut planned = Vec::new();
    let mut first_row = 0;
    for frames in streams(room, hold_out) {
        let part = Part::of(disturbance.extent(), frames.len());
        let period_ns = period_ns(room, &frames);

        let of_frame = |(number, frame): (usize, &FrameId)| {
            let taken = taken(disturbance, part, number)?;
            let since_first = frame.0 - frames[0].0;
            Some(PlannedFrame {
                truth: disturbance.truth(&room.poses()[frame.row()]),
                view: first_row + taken.view,
                time_ns: i64::from(since_first) * period_ns,
                sequence: taken.own_number.unwrap_or(u64::from(since_first)),
                is_disturbed: taken.is_disturbed,
                is_scored: part.holds(number),
            })
        };
        planned.push(PlannedStream {
            frames: frames.iter().enumerate().filter_map(of_frame).collect(),
            period_ns,
            is_scored: part.begin < part.end,
        });
        first_row += frames.len();
    }
    planned
}

/// Scores the replays of planned streams. `nearest` returns the pose of the mapped frame that is
/// most similar to a view, by its row among the tracked frames.
pub(super) fn scored(
    room: &Room,
    disturbance: Disturbance,
    replayed: Vec<(PlannedStream, Replay)>,
    nearest: &dyn Fn(usize) -> Pose,
) -> DisturbedTracking {
    let mut replays = Vec::new();
    let mut scored_rows = Vec::new();
    let mut view_rows = Vec::new();
    let mut noticed = Vec::new();
    for (stream, replay) in replayed {
        let is_scored: Vec<bool> = stream.frames.iter().map(|frame| frame.is_scored).collect();
        if stream.is_scored {
            noticed.push(noticed_after(&replay, &is_scored));
        }
        scored_rows.extend(is_scored);
        view_rows.extend(stream.frames.iter().map(|frame| frame.view));
        replays.push((replay, stream.period_ns));
    }

    let replay = joined(replays.into_iter());
    let keep = |row: usize| scored_rows[row];
    let share = |status| share_of(&replay, &scored_rows, status);
    DisturbedTracking {
        disturbance,
        room: Some(room.id().to_string()),
        frames: scored_rows.iter().filter(|&&scored| scored).count(),
        scores: TrackingScores::of_rows(&replay, keep, |row| nearest(view_rows[row])),
        statuses: StatusShares::of(share),
        // The result is `None` if any stream stayed TRACKING.
        noticed_after: match disturbance.extent() {
            Extent::Whole => None,
            Extent::Part => slowest(noticed.into_iter()),
        },
    }
}

/// A frame of the disturbed stream.
struct Taken {
    /// Index in the stream of the tracked frame that provides the view.
    view: usize,
    is_disturbed: bool,
    /// The sequence number assigned by the camera, if it numbers its frames itself.
    own_number: Option<u64>,
}

/// The frame taken at index `number` of a stream; `None` if the camera skips it.
fn taken(disturbance: Disturbance, part: Part, number: usize) -> Option<Taken> {
    let plain = Taken {
        view: number,
        is_disturbed: part.holds(number),
        own_number: None,
    };

    match disturbance {
        Disturbance::Rate { every } => number.is_multiple_of(every).then_some(Taken {
            own_number: Some((number / every) as u64),
            ..plain
        }),
        Disturbance::Frozen if part.holds(number) => Some(Taken {
            view: part.begin,
            ..plain
        }),
        _ => Some(plain),
    }
}

/// Number of scored frames until the status leaves TRACKING; `None` if it never does.
fn noticed_after(replay: &Replay, is_scored: &[bool]) -> Option<usize> {
    let mut scored = replay
        .updates
        .iter()
        .zip(is_scored)
        .filter(|(_, scored)| **scored);
    let noticed = scored.position(|(update, _)| update.status != Status::Tracking);
    noticed.map(|frames| frames + 1)
}

fn share_of(replay: &Replay, is_scored: &[bool], status: Status) -> f64 {
    let scored = || {
        replay
            .updates
            .iter()
            .zip(is_scored)
            .filter(|(_, scored)| **scored)
    };
    let with_status = scored().filter(|(update, _)| update.status == status);
    with_status.count() as f64 / scored().count() as f64
}

/// The tracked frames with images changed by a disturbance. Each entry is the index among all
/// tracked frames of the room and the index in the frame's stream.
pub fn changed_images(
    room: &Room,
    hold_out: HoldOut,
    disturbance: Disturbance,
) -> Vec<(usize, usize)> {
    if disturbance.keeps_images() {
        return Vec::new();
    }

    let mut changed = Vec::new();
    let mut first_row = 0;
    for frames in streams(room, hold_out) {
        let part = Part::of(disturbance.extent(), frames.len());
        changed.extend((part.begin..part.end).map(|number| (first_row + number, number)));
        first_row += frames.len();
    }

    changed
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. In a world with z up, a level camera that looks along x has its y axis
    /// along −z. Small pitch angles do not change the result.
    #[test]
    fn down_is_where_cameras_have_their_feet() {
        let half = std::f64::consts::FRAC_PI_2;
        let ahead = Pose::rotation(Vector3::z() * -half) * Pose::rotation(Vector3::x() * -half);
        assert!((ahead.rotation * Vector3::z() - Vector3::x()).norm() < 1e-12);

        let tilted = [-0.3, 0.1, 0.5].map(|angle| ahead * Pose::rotation(Vector3::x() * angle));
        assert_eq!(down_of(&tilted).into_inner(), -Vector3::z());
    }
}

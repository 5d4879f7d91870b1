//! Evaluates a tracker on held-out frames: path errors, covariances, and detection of being lost.
//!
//! Start reading at [`evaluate`]. Every room is mapped and tracked under one hold-out. Frames of
//! the other rooms are then replayed through its tracker, which should report LOST.

use std::sync::Arc;

use ndarray::{ArrayView1, ArrayView2};
use rayon::prelude::*;
use serde::{Serialize, Serializer};

use seese3_core::adapter::Adapter;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Pose, PoseError};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_core::statistics::root_mean_square;
use seese3_core::training::RoomData;
use seese3_core::trajectory::{Relation, RpePairs, Statistics, Trajectory, ape, rpe};
use seese3_robot::fitting::{RoomReader, fit};
use seese3_robot::tracking::{
    InitialPose, Map, MapMatch, MapQuery, MotionSurprise, Replay, Segment, Status, Tracker,
    TrackerSettings, relocalize, replay, replay_streams,
};

use super::odometry_scenarios::Scenarios;
use super::tracking_scores::TrackingScores;
use super::{Error, Within, check_hold_out};
use crate::json;

/// Frame period of replays that contain frames of another room, nanoseconds: 30 Hz.
pub(super) const PERIOD_NS: i64 = 33_333_333;
/// Maximum number of frames of each other room replayed through a room's tracker.
pub(super) const OTHER_ROOM_FRAMES: usize = 60;
/// Stride of the tracked frames that are relocalized in all rooms.
const RELOCALISED_STEP: usize = 5;

/// Settings of an evaluation, besides the rooms and the adapter.
#[derive(Debug, Clone, Copy)]
pub struct OdometryProtocol {
    /// Which frames are mapped and which are tracked.
    pub hold_out: HoldOut,
    /// Settings of the trackers.
    pub settings: TrackerSettings,
    /// Whether an adapter is fitted to each room's mapped frames, starting from the given
    /// adapter's weights. The fitted adapter then provides the anchors.
    pub is_fitted: bool,
}

/// A tracker over one room.
pub struct TrackedRoom<'a> {
    room: Arc<Room>,
    /// Raw features, row by frame, shape (n, d).
    features: ArrayView2<'a, f32>,
    mapped: Vec<FrameId>,
    map: Arc<Map>,
    tracker: Tracker,
}

/// Tracking results of one room.
#[derive(Debug, Clone, Serialize)]
pub struct RoomOdometry {
    /// The room.
    pub room: String,
    /// Errors of the tracker and of its baselines on the same frames.
    #[serde(flatten)]
    pub scores: TrackingScores,
    /// Source format of the recording.
    pub format: String,
    /// Number of mapped frames.
    #[serde(rename = "mapped")]
    pub mapped_frames: usize,
    /// Number of tracked frames.
    #[serde(rename = "followed")]
    pub tracked_frames: usize,
    /// Errors of both paths.
    #[serde(flatten)]
    pub paths: PathErrors,
    /// Errors of the map poses.
    #[serde(rename = "coverage_places")]
    pub map_poses: MapPoseErrors,
    /// Errors of the estimated motions, with the lengths of the motions.
    #[serde(rename = "coverage_motions", serialize_with = "coverage_of_motions")]
    pub motions: Vec<MotionSurprise>,
    /// Fractions of frames by status.
    #[serde(flatten)]
    pub statuses: StatusShares,
    /// Results of the same streams without an initial pose.
    #[serde(flatten)]
    pub unknown_start: UnknownStart,
    /// LOST counts for frames of other rooms: replayed as the start of a stream, and after this
    /// room's own frames.
    #[serde(rename = "foreign")]
    pub other_rooms: [LostFrames; 2],
    /// Parts without a map, kidnaps and wheels; absent for streams of an adapter.
    #[serde(flatten)]
    pub scenarios: Option<Scenarios>,
}

/// Squared Mahalanobis lengths of map pose errors; in JSON, their coverage.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(into = "[f64; 2]")]
pub struct MapPoseErrors {
    /// Of frames with mapped neighbors in time.
    pub mapped: Vec<f64>,
    /// Of frames without mapped neighbors in time.
    pub unmapped: Vec<f64>,
}

impl MapPoseErrors {
    /// The errors of all frames.
    pub fn all(&self) -> Vec<f64> {
        [&self.mapped[..], &self.unmapped].concat()
    }
}

impl From<MapPoseErrors> for [f64; 2] {
    fn from(errors: MapPoseErrors) -> Self {
        json::covered(&errors.all())
    }
}

fn coverage_of_motions<S: Serializer>(found: &[MotionSurprise], to: S) -> Result<S::Ok, S::Error> {
    json::covered(&squared_errors(found)).serialize(to)
}

/// The squared Mahalanobis lengths of motion errors.
pub fn squared_errors(motions: &[MotionSurprise]) -> Vec<f64> {
    motions.iter().map(|motion| motion.squared_error).collect()
}

/// Root-mean-square errors of both paths, without alignment; NaN for a path with fewer than two
/// poses.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PathErrors {
    /// Absolute translation errors, metres.
    #[serde(rename = "ape_translation_rmse_m")]
    pub ape_m: BothPaths,
    /// Absolute rotation errors, radians.
    #[serde(rename = "ape_rotation_rmse_rad")]
    pub ape_rad: BothPaths,
    /// Relative translation errors over one frame, metres.
    #[serde(rename = "rpe_translation_rmse_m")]
    pub rpe_m: BothPaths,
}

/// A figure of both paths.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BothPaths {
    /// Dead reckoning, aligned to the true first pose.
    pub odom: f64,
    /// The fused path, over the frames with a map pose.
    pub fused: f64,
}

/// Fractions of frames by reported status.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StatusShares {
    /// TRACKING.
    pub tracking: f64,
    /// DEGRADED.
    pub degraded: f64,
    /// LOST.
    pub lost: f64,
    /// RELOCALIZING.
    pub relocalizing: f64,
}

impl StatusShares {
    /// The shares by a function of the status.
    pub fn of(share: impl Fn(Status) -> f64) -> Self {
        Self {
            tracking: share(Status::Tracking),
            degraded: share(Status::Degraded),
            lost: share(Status::Lost),
            relocalizing: share(Status::Relocalizing),
        }
    }
}

/// Results of a stream without an initial pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct UnknownStart {
    /// Fraction of frames reported LOST.
    #[serde(rename = "lost_without_initial_pose")]
    pub lost: f64,
    /// Number of frames until the tracker was TRACKING near the true pose; `None` if it never was.
    pub frames_to_relocalise: Option<usize>,
}

/// Number of frames of other rooms, and of those reported LOST.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct LostFrames {
    /// Number of replayed frames.
    pub frames: usize,
    /// Number of frames reported LOST.
    pub lost: usize,
}

/// Results of relocalizing single views among several rooms.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Relocalisation {
    /// Number of candidate rooms.
    pub rooms: usize,
    /// Number of views located in the right room.
    pub right: usize,
    /// Number of views located in a wrong room.
    pub wrong: usize,
    /// Number of views with an ambiguous result.
    pub ambiguous: usize,
    /// Number of views located in some room when the right room was not among the candidates.
    pub named_without_own: usize,
    /// Translation errors of the poses in the right room, metres; in JSON, their root mean square.
    #[serde(rename = "pose_m", serialize_with = "rms")]
    pub pose_errors_m: Vec<f64>,
    /// Translation errors of the nearest frames' poses, metres.
    #[serde(rename = "nearest_frame_m", serialize_with = "rms")]
    pub nearest_errors_m: Vec<f64>,
    /// Squared Mahalanobis lengths of the pose errors in the right room.
    #[serde(rename = "coverage", serialize_with = "json::coverages")]
    pub pose_surprises: Vec<f64>,
}

fn rms<S: Serializer>(errors: &[f64], to: S) -> Result<S::Ok, S::Error> {
    root_mean_square(errors).serialize(to)
}

impl TrackedRoom<'_> {
    /// The room, with all its frames.
    pub fn room(&self) -> &Room {
        &self.room
    }

    /// A tracker over its mapped frames.
    pub fn tracker(&self) -> &Tracker {
        &self.tracker
    }

    /// The pose of the mapped frame most similar to a raw feature of shape (d,), by the cosine:
    /// the retrieval baseline.
    pub fn most_alike(&self, feature: ArrayView1<'_, f32>) -> &Pose {
        let cosine = |frame: &&FrameId| {
            let row = self.features.row(frame.row());
            row.dot(&feature) / row.dot(&row).sqrt()
        };
        let best = self
            .mapped
            .iter()
            .max_by(|a, b| cosine(a).total_cmp(&cosine(b)));

        // A map has at least one frame.
        let row = best.map_or(0, |frame| frame.row());
        &self.room.poses()[row]
    }

    /// Raw features, row by frame, shape (n, d).
    pub fn features(&self) -> ArrayView2<'_, f32> {
        self.features
    }
}

/// Builds one tracker per room, with the frames mapped under the protocol's hold-out.
///
/// # Errors
/// [`Error`] when a room is too small or the adapter has no error model.
pub fn trackers<'a>(
    rooms: &[RoomData<'a>],
    adapter: &Arc<Adapter>,
    protocol: &OdometryProtocol,
) -> Result<Vec<TrackedRoom<'a>>, Error> {
    let tracker = |data: &RoomData<'a>| {
        check_hold_out(data.room, protocol.hold_out)?;
        let room = Arc::new(data.room.clone());
        let mapped = protocol.hold_out.mapped(room.timeline());
        let navigator = Navigator::new(
            room.clone(),
            data.features,
            adapter.clone(),
            IndexKind::Exact,
        )?;

        let what = || format!("room '{}'", room.id());
        let map = Map::new(Arc::new(navigator), &mapped).within(what)?;
        let mut map = map.with_features(data.features.rows(), &mapped);
        if protocol.is_fitted {
            let fitted = fit(data, &mapped, Some(adapter), 0, &|_| ()).within(what)?;
            let reader = RoomReader::new(data, &mapped, Some(adapter.clone()), &fitted);
            map = map.with_pose_reader(Arc::new(reader.within(what)?));
        }

        let map = Arc::new(map);
        let tracker = Tracker::new(vec![map.clone()], protocol.settings).within(what)?;
        Ok(TrackedRoom {
            room,
            features: data.features.rows(),
            mapped,
            map,
            tracker,
        })
    };

    rooms.iter().map(tracker).collect()
}

/// Tracks the held-out frames of every room. `done` is called with the result and the replay of
/// each room.
///
/// # Errors
/// [`Error`] when a room's path cannot be compared with the true path.
pub fn evaluate(
    rooms: &[TrackedRoom<'_>],
    hold_out: HoldOut,
    done: &(dyn Fn(&RoomOdometry, &Replay) + Sync),
) -> Result<Vec<RoomOdometry>, Error> {
    let one = |room: &TrackedRoom<'_>| {
        let given = own_replay(room, hold_out, InitialPose::Given);
        let replays = RoomReplays {
            room: &room.room,
            hold_out,
            given: &given,
            unknown: &own_replay(room, hold_out, InitialPose::Unknown),
            other_rooms: [None, Some(hold_out)].map(|own| lost_frames(room, rooms, own)),
            nearest: &|frame| *room.most_alike(room.features.row(frame.row())),
        };

        let found = room_odometry(&replays)?;
        done(&found, &given);
        Ok(found)
    };

    rooms.par_iter().map(one).collect()
}

/// Relocalizes every fifth tracked frame, as a single view, among all rooms.
///
/// # Errors
/// [`Error`] when a view cannot be matched.
pub fn relocalisation(
    rooms: &[TrackedRoom<'_>],
    hold_out: HoldOut,
) -> Result<Relocalisation, Error> {
    let maps: Vec<Arc<Map>> = rooms.iter().map(|room| room.map.clone()).collect();

    let of_room = |(place, room): (usize, &TrackedRoom<'_>)| {
        let mut others = maps.clone();
        others.remove(place);
        let mut found = Relocalisation::default();
        let tracked = hold_out.tracked(room.room.timeline());

        for frame in tracked.into_iter().step_by(RELOCALISED_STEP) {
            let feature = room.features.row(frame.row()).to_vec();
            let latents = room.map.navigator().latents();
            let view = MapQuery {
                latent: latents.row(frame.row()),
                feature: Some(&feature),
            };
            let answer = relocalize(&maps, &[view], 1, &Cancellation::default())?;

            if !others.is_empty() {
                let answer = relocalize(&others, &[view], 1, &Cancellation::default())?;
                found.named_without_own += usize::from(!answer.ambiguous);
            }

            if answer.ambiguous {
                found.ambiguous += 1;
            } else if answer.rooms[0].map == place {
                found.right += 1;
                found.add_pose(&answer.rooms[0].last, room, frame);
            } else {
                found.wrong += 1;
            }
        }

        Ok(found)
    };

    let by_room: Vec<Relocalisation> = rooms
        .par_iter()
        .enumerate()
        .map(of_room)
        .collect::<Result<_, Error>>()?;
    let sum = |of: fn(&Relocalisation) -> usize| by_room.iter().map(of).sum();
    let all = |of: fn(&Relocalisation) -> &Vec<f64>| by_room.iter().flat_map(of).copied().collect();

    Ok(Relocalisation {
        right: sum(|found| found.right),
        wrong: sum(|found| found.wrong),
        ambiguous: sum(|found| found.ambiguous),
        named_without_own: sum(|found| found.named_without_own),
        rooms: rooms.len(),
        pose_surprises: all(|found| &found.pose_surprises),
        pose_errors_m: all(|found| &found.pose_errors_m),
        nearest_errors_m: all(|found| &found.nearest_errors_m),
    })
}

impl Relocalisation {
    /// Adds the pose errors of a view that was located in the right room.
    fn add_pose(&mut self, matched: &MapMatch, room: &TrackedRoom<'_>, frame: FrameId) {
        let poses = room.room.poses();
        let truth = &poses[frame.row()];
        let found = &matched.anchor.belief;
        let nearest = &poses[matched.nearest[0].frame.row()];

        self.pose_surprises.extend(found.squared_error(truth));
        let error_m = |pose| PoseError::between(pose, truth).translation_m;
        self.pose_errors_m.push(error_m(&found.pose));
        self.nearest_errors_m.push(error_m(nearest));
    }
}

/// The replays of a room's tracked frames.
pub(super) struct RoomReplays<'a> {
    pub room: &'a Room,
    pub hold_out: HoldOut,
    /// With the true initial pose.
    pub given: &'a Replay,
    /// Without an initial pose.
    pub unknown: &'a Replay,
    /// LOST counts for frames of other rooms, see [`RoomOdometry::other_rooms`].
    pub other_rooms: [LostFrames; 2],
    /// The pose of the mapped frame most similar to a frame.
    pub nearest: &'a dyn Fn(FrameId) -> Pose,
}

pub(super) fn room_odometry(replays: &RoomReplays<'_>) -> Result<RoomOdometry, Error> {
    let RoomReplays {
        room,
        hold_out,
        given: own,
        unknown,
        other_rooms,
        nearest,
    } = *replays;
    let frame_count = room.frame_count();
    let what = || format!("room '{}'", room.id());

    let odom = path_errors(&own.odom_path(), &own.truth).within(what)?;
    let fused_path = own.map_path();
    let fused = if fused_path.rows.len() < 2 {
        [f64::NAN; 3]
    } else {
        path_errors(&fused_path.path, &own.truth.select(&fused_path.rows))?
    };
    let both = |place: usize| BothPaths {
        odom: odom[place],
        fused: fused[place],
    };

    let tracked = hold_out.tracked(room.timeline());
    let has_mapped_neighbours =
        |row: usize| hold_out.has_mapped_neighbours(tracked[row], frame_count);

    Ok(RoomOdometry {
        room: room.id().to_string(),
        scores: TrackingScores::of(own, |row| nearest(tracked[row])),
        format: room.provenance().format.clone(),
        mapped_frames: hold_out.mapped(room.timeline()).len(),
        tracked_frames: own.updates.len(),
        paths: PathErrors {
            ape_m: both(0),
            ape_rad: both(1),
            rpe_m: both(2),
        },
        map_poses: MapPoseErrors {
            mapped: own.map_pose_surprises_where(has_mapped_neighbours),
            unmapped: own.map_pose_surprises_where(|row| !has_mapped_neighbours(row)),
        },
        motions: own.motion_surprises(),
        statuses: StatusShares::of(|status| own.share(status)),
        unknown_start: UnknownStart {
            lost: unknown.share(Status::Lost),
            frames_to_relocalise: unknown.frames_to_relocalise(),
        },
        other_rooms,
        scenarios: None,
    })
}

/// Absolute translation and rotation errors, and relative translation errors.
fn path_errors(estimate: &Trajectory, reference: &Trajectory) -> Result<[f64; 3], Error> {
    let absolute = |relation| -> Result<f64, Error> {
        Ok(Statistics::of(&ape(reference, estimate, relation)?).rmse)
    };
    let relative = rpe(
        reference,
        estimate,
        Relation::Translation,
        1,
        RpePairs::Consecutive,
    )?;

    Ok([
        absolute(Relation::Translation)?,
        absolute(Relation::Rotation)?,
        Statistics::of(&relative).rmse,
    ])
}

/// Replays the tracked frames of a room through its own tracker.
fn own_replay(room: &TrackedRoom<'_>, hold_out: HoldOut, initial_pose: InitialPose) -> Replay {
    let segment = Segment {
        latents: room.map.navigator().latents(),
        features: Some(room.features),
        poses: room.room.poses(),
        frames: &hold_out.tracked(room.room.timeline()),
    };

    replay_streams(&room.tracker, segment, &room.room, initial_pose)
}

/// Replays frames of every other room through a room's tracker, and counts the LOST answers. With
/// `own`, the last tracked frames of the room itself come first in the stream. A perfect tracker
/// reports LOST for all frames of other rooms.
fn lost_frames(
    room: &TrackedRoom<'_>,
    all: &[TrackedRoom<'_>],
    own: Option<HoldOut>,
) -> LostFrames {
    let own_frames = own.map(|hold_out| {
        let mut frames = hold_out.tracked(room.room.timeline());
        frames.split_off(frames.len().saturating_sub(OTHER_ROOM_FRAMES))
    });

    let mut found = LostFrames::default();
    for other in all.iter().filter(|other| other.room.id() != room.room.id()) {
        let mut frames = HoldOut::Interleaved.tracked(other.room.timeline());
        frames.truncate(OTHER_ROOM_FRAMES);
        let theirs = Segment {
            latents: other.map.navigator().latents(),
            features: Some(other.features),
            poses: other.room.poses(),
            frames: &frames,
        };

        let replayed = match &own_frames {
            None => replay(&room.tracker, &[theirs], PERIOD_NS, InitialPose::Unknown),
            Some(own_frames) => {
                let ours = Segment {
                    latents: room.map.navigator().latents(),
                    features: Some(room.features),
                    poses: room.room.poses(),
                    frames: own_frames,
                };
                replay(
                    &room.tracker,
                    &[ours, theirs],
                    PERIOD_NS,
                    InitialPose::Given,
                )
            }
        };

        // The other room's frames are the last ones of the replay.
        let updates = &replayed.updates[replayed.updates.len() - frames.len()..];
        let is_lost = |update: &&seese3_robot::tracking::Update| update.status == Status::Lost;
        found.frames += updates.len();
        found.lost += updates.iter().filter(is_lost).count();
    }

    found
}

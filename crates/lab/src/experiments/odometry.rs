//! Evaluates a tracker on held-out frames: path errors, covariances, and detection of being lost.
//!
//! Start reading at [`evaluate`]. Every room is mapped and tracked under one hold-out. Frames of
//! the other rooms are then replayed in it, which should be reported LOST.

use std::sync::Arc;

use rayon::prelude::*;
use serde::{Serialize, Serializer};

use seese3_core::cancel::Cancellation;
use seese3_core::geometry::PoseError;
use seese3_core::room::FrameId;
use seese3_core::statistics::root_mean_square;
use seese3_core::trajectory::{Relation, RpePairs, Statistics, Trajectory, ape, rpe};
use seese3_robot::tracking::{Map, MapMatch, MapQuery, Status, relocalize};

use super::odometry_scenarios::Scenarios;
use super::replay::{InitialPose, MotionSurprise, Replay};
use super::tracked_room::TrackedRoom;
use super::tracking_intervals::{BlockSums, TrackingIntervals, blocks_of};
use super::tracking_scores::{LostFrames, StatusShares, TrackingScores};
use super::{Error, Within};
use crate::json;

/// Stride of the tracked frames that are relocalized in all rooms.
const RELOCALISED_STEP: usize = 5;

/// Tracking results of one room.
#[derive(Debug, Clone, Serialize)]
pub struct RoomOdometry {
    /// The room.
    pub room: String,
    /// Errors of the tracker and of its baselines on the same frames.
    #[serde(flatten)]
    pub scores: TrackingScores,
    /// Sums over blocks of time, for intervals over several rooms.
    #[serde(skip)]
    pub blocks: Vec<BlockSums>,
    /// 95 % intervals of the scores; `None` without frames.
    pub intervals_95: Option<TrackingIntervals>,
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
    /// Parts without a map, kidnaps and wheels.
    #[serde(flatten)]
    pub scenarios: Scenarios,
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
    /// Absolute translation errors, meters.
    #[serde(rename = "ape_translation_rmse_m")]
    pub ape_m: BothPaths,
    /// Absolute rotation errors, radians.
    #[serde(rename = "ape_rotation_rmse_rad")]
    pub ape_rad: BothPaths,
    /// Relative translation errors over one frame, meters.
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

/// Results of a stream without an initial pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct UnknownStart {
    /// Fraction of frames reported LOST.
    #[serde(rename = "lost_without_initial_pose")]
    pub lost: f64,
    /// Number of frames until the tracker was TRACKING near the true pose; `None` if it never was.
    pub frames_to_relocalize: Option<usize>,
}

/// Results of relocalizing single views among several rooms.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Relocalization {
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
    /// Translation errors of the poses in the right room, meters; in JSON, their root mean square.
    #[serde(rename = "pose_m", serialize_with = "rms")]
    pub pose_errors_m: Vec<f64>,
    /// Translation errors of the nearest frames' poses, meters.
    #[serde(rename = "nearest_frame_m", serialize_with = "rms")]
    pub nearest_errors_m: Vec<f64>,
    /// Squared Mahalanobis lengths of the pose errors in the right room.
    #[serde(rename = "coverage", serialize_with = "json::coverages")]
    pub pose_surprises: Vec<f64>,
}

fn rms<S: Serializer>(errors: &[f64], to: S) -> Result<S::Ok, S::Error> {
    root_mean_square(errors).serialize(to)
}

/// Tracks the held-out frames of every room. `done` is called with the result and the replay of
/// each room.
///
/// # Errors
/// [`Error`] when a room's path cannot be compared with the true path.
pub fn evaluate<'a>(
    rooms: &[TrackedRoom<'a>],
    done: &(dyn Fn(&RoomOdometry, &Replay) + Sync),
) -> Result<Vec<RoomOdometry>, Error> {
    let one = |room: &TrackedRoom<'a>| {
        let given = room.own_replay(InitialPose::Given);
        let found = room_odometry(room, rooms, &given)?;
        done(&found, &given);
        Ok(found)
    };
    rooms.par_iter().map(one).collect()
}

/// Relocalizes every fifth tracked frame, as a single view, among all rooms.
///
/// # Errors
/// [`Error`] when a view cannot be matched.
pub fn relocalization(rooms: &[TrackedRoom<'_>]) -> Result<Relocalization, Error> {
    let maps: Vec<Arc<Map>> = rooms
        .iter()
        .filter_map(|room| room.map().cloned())
        .collect();

    let of_room = |(place, room): (usize, &TrackedRoom<'_>)| {
        let mut others = maps.clone();
        let own = others.remove(place);
        let latents = own.navigator().latents();
        let mut found = Relocalization::default();

        for frame in room.tracked().iter().step_by(RELOCALISED_STEP) {
            let feature = room.features().row(frame.row()).to_vec();
            let view = MapQuery {
                latent: latents.row(frame.row()),
                feature: Some(&feature),
            };
            let answer = relocalize(&maps, &[view], &Cancellation::default())?;

            if !others.is_empty() {
                let answer = relocalize(&others, &[view], &Cancellation::default())?;
                found.named_without_own += usize::from(!answer.ambiguous);
            }

            if answer.ambiguous {
                found.ambiguous += 1;
            } else if answer.rooms[0].map == place {
                found.right += 1;
                found.add_pose(&answer.best, room, *frame);
            } else {
                found.wrong += 1;
            }
        }

        Ok(found)
    };

    let by_room: Vec<Relocalization> = rooms
        .par_iter()
        .enumerate()
        .map(of_room)
        .collect::<Result<_, Error>>()?;
    let sum = |of: fn(&Relocalization) -> usize| by_room.iter().map(of).sum();
    let all = |of: fn(&Relocalization) -> &Vec<f64>| by_room.iter().flat_map(of).copied().collect();

    Ok(Relocalization {
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

impl Relocalization {
    /// Adds the pose errors of a view that was located in the right room.
    fn add_pose(&mut self, matched: &MapMatch, room: &TrackedRoom<'_>, frame: FrameId) {
        let poses = room.room().poses();
        let truth = &poses[frame.row()];
        let found = &matched.pose;
        let nearest = &poses[matched.nearest[0].frame.row()];

        self.pose_surprises.extend(found.squared_error(truth));
        let error_m = |pose| PoseError::between(pose, truth).translation_m;
        self.pose_errors_m.push(error_m(&found.pose));
        self.nearest_errors_m.push(error_m(nearest));
    }
}

fn room_odometry<'a>(
    tracked_room: &TrackedRoom<'a>,
    all: &[TrackedRoom<'a>],
    own: &Replay,
) -> Result<RoomOdometry, Error> {
    let (room, hold_out) = (tracked_room.room(), tracked_room.hold_out());
    let unknown = tracked_room.own_replay(InitialPose::Unknown);
    let baselines = tracked_room.baselines();
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

    let tracked = tracked_room.tracked();
    let has_mapped_neighbors =
        |row: usize| hold_out.has_mapped_neighbors(tracked[row], frame_count);

    let streams = tracked_room.streams();
    let example = streams.first().and_then(|stream| stream.views.first());
    let views: Vec<_> = streams.iter().map(|stream| &stream.views[..]).collect();
    let scenarios = Scenarios::of(&views, &|first| tracked_room.player(first, example));

    let nearest_frame = |row: usize| baselines.poses_of(tracked[row].row()).0;
    let blocks = blocks_of(own, nearest_frame);
    Ok(RoomOdometry {
        room: room.id().to_string(),
        scores: TrackingScores::of(own, nearest_frame),
        intervals_95: TrackingIntervals::of(&[&blocks]),
        blocks,
        format: room.provenance().format.clone(),
        mapped_frames: hold_out.mapped(room.timeline()).len(),
        tracked_frames: own.updates.len(),
        paths: PathErrors {
            ape_m: both(0),
            ape_rad: both(1),
            rpe_m: both(2),
        },
        map_poses: MapPoseErrors {
            mapped: own.map_pose_surprises_where(has_mapped_neighbors),
            unmapped: own.map_pose_surprises_where(|row| !has_mapped_neighbors(row)),
        },
        motions: own.motion_surprises(),
        statuses: StatusShares::of(|status| own.share(status)),
        unknown_start: UnknownStart {
            lost: unknown.share(Status::Lost),
            frames_to_relocalize: unknown.frames_to_relocalize(),
        },
        other_rooms: [false, true].map(|is_after_own| tracked_room.lost_frames(all, is_after_own)),
        scenarios,
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

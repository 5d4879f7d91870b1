//! Evaluates the filter of located views on held-out frames: no adapter, keypoints alone.
//!
//! Every room is mapped and tracked under one hold-out, as in [`super::odometry`]. Its frames are
//! located near the last pose while TRACKING, as the service does it. A [`DisturbedRoom`] is tracked by
//! a camera with disturbed images.

use ndarray::ArrayView2;
use rayon::prelude::*;

use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_core::trajectory::Trajectory;
use seese3_robot::front_end::{FrontEnd, StreamCamera};
use seese3_robot::localization::KeypointRoom;
use seese3_robot::pose_filter::{FilterParameters, FilterRoom, PoseFilter};
use seese3_robot::tracking::{InitialPose, PoseWithCovariance, Replay, Status, joined, period_ns};
use seese3_robot::visual_odometry::OdometryParameters;

use super::keypoint_player::{PlayedView, Player, Sight};
use super::matched_localization::{Baselines, PosedRecording, mapped_room};
use super::odometry::{
    LostFrames, OTHER_ROOM_FRAMES, PERIOD_NS, RoomOdometry, RoomReplays, room_odometry,
};
use super::odometry_scenarios::Scenarios;
use super::robustness::{Disturbance, DisturbedTracking, PlannedFrame, plan, scored};
use super::{Error, Within, check_hold_out};

/// A recording with the keypoints of all its frames.
#[derive(Clone, Copy)]
pub struct KeypointRecording<'a> {
    /// The room.
    pub room: &'a Room,
    /// Features of all frames, shape (n, d), for the nearest frame.
    pub features: ArrayView2<'a, f32>,
    /// The keypoints of all frames.
    pub keypoints: &'a [Keypoints],
    /// The camera of all frames.
    pub camera: CameraIntrinsics,
}

/// A room with its mapped part.
struct TrackedRoom<'a> {
    recording: KeypointRecording<'a>,
    mapped: Vec<FrameId>,
    tracked: Vec<FrameId>,
    map: KeypointRoom,
    filter: PoseFilter,
}

/// Maps a part of each recording and tracks the frames of the other part. `done` is called with the
/// result and the replay of each room.
///
/// # Errors
/// [`Error`] if a recording is too small for the hold-out, or has no mapped keypoint.
pub fn evaluate<'a>(
    recordings: &[KeypointRecording<'a>],
    hold_out: HoldOut,
    parameters: FilterParameters,
    done: &(dyn Fn(&RoomOdometry, &Replay) + Sync),
) -> Result<Vec<RoomOdometry>, Error> {
    let rooms: Vec<TrackedRoom<'a>> = recordings
        .par_iter()
        .map(|recording| TrackedRoom::new(recording, hold_out, parameters))
        .collect::<Result<_, Error>>()?;

    let one = |room: &TrackedRoom<'a>| {
        let given = room.own_replay(InitialPose::Given);
        let features = room.recording.features;
        let baselines = Baselines::new(room.recording.room.poses(), features, &room.mapped);
        let replays = RoomReplays {
            room: room.recording.room,
            hold_out,
            given: &given,
            unknown: &room.own_replay(InitialPose::Unknown),
            other_rooms: [false, true].map(|is_after_own| room.lost_frames(&rooms, is_after_own)),
            nearest: &|frame| baselines.poses_of(frame.row()).0,
        };

        let camera = room.recording.camera;
        let streams: Vec<_> = room
            .streams()
            .into_iter()
            .map(|stream| stream.views)
            .collect();
        let scenarios = Scenarios::of(&streams, &|first| room.player(first, Some(camera)));
        let found = RoomOdometry {
            scenarios: Some(scenarios),
            ..room_odometry(&replays)?
        };
        done(&found, &given);
        Ok(found)
    };
    rooms.par_iter().map(one).collect()
}

impl<'a> TrackedRoom<'a> {
    fn new(
        recording: &KeypointRecording<'a>,
        hold_out: HoldOut,
        parameters: FilterParameters,
    ) -> Result<Self, Error> {
        let room = recording.room;
        check_hold_out(room, hold_out)?;
        let mapped = hold_out.mapped(room.timeline());
        let trials = PosedRecording {
            poses: room.poses(),
            keypoints: recording.keypoints,
            camera: recording.camera,
        };
        let map = mapped_room(trials, &mapped).within(|| format!("room '{}'", room.id()))?;

        let filter = PoseFilter::new(vec![FilterRoom::of(room, &mapped)], parameters);
        Ok(Self {
            recording: *recording,
            tracked: hold_out.tracked(room.timeline()),
            mapped,
            map,
            filter: filter.ok_or_else(|| Error::Input("no room".to_owned()))?,
        })
    }

    /// Replays the tracked frames, one stream per sequence.
    fn own_replay(&self, initial: InitialPose) -> Replay {
        let streams = self.streams().into_iter().map(|stream| {
            let period_ns = stream.period_ns;
            (self.play(&stream.views, initial), period_ns)
        });
        joined(streams)
    }

    /// The tracked frames, one stream per sequence.
    fn streams(&self) -> Vec<Stream<'a>> {
        let room = self.recording.room;
        let same_sequence = |a: &FrameId, b: &FrameId| room.timeline().joins(*a, *b);
        let streams = self.tracked.chunk_by(same_sequence).map(|frames| {
            let period_ns = period_ns(room, frames);
            let frames: Vec<_> = frames
                .iter()
                .map(|frame| (self.recording, *frame))
                .collect();
            Stream {
                views: played(&frames, period_ns),
                period_ns,
            }
        });
        streams.collect()
    }

    /// Replays frames of every other room, and counts the LOST answers. The last tracked frames of
    /// this room come first if `is_after_own`.
    fn lost_frames(&self, all: &[TrackedRoom<'a>], is_after_own: bool) -> LostFrames {
        let mut found = LostFrames::default();
        let mut own = self.tracked.clone();
        let own = own.split_off(own.len().saturating_sub(OTHER_ROOM_FRAMES));
        for other in all {
            if other.recording.room.id() == self.recording.room.id() {
                continue;
            }

            let mut theirs = HoldOut::Interleaved.tracked(other.recording.room.timeline());
            theirs.truncate(OTHER_ROOM_FRAMES);
            let ours = own.iter().filter(|_| is_after_own);
            let ours = ours.map(|frame| (self.recording, *frame));
            let count = theirs.len();
            let theirs = theirs.into_iter().map(|frame| (other.recording, frame));
            let frames: Vec<_> = ours.chain(theirs).collect();

            let replayed = self.play(&played(&frames, PERIOD_NS), InitialPose::Unknown);
            let updates = &replayed.updates[replayed.updates.len() - count..];
            let lost = updates
                .iter()
                .filter(|update| update.status == Status::Lost);
            found.frames += count;
            found.lost += lost.count();
        }
        found
    }

    /// Replays views through the filter.
    fn play(&self, views: &[PlayedView<'_>], initial: InitialPose) -> Replay {
        let first = views.first().filter(|_| initial == InitialPose::Given);
        let camera = views.first().and_then(|view| view.camera);
        let mut player = self.player(first.map(|view| view.truth), camera);
        let mut replay = Replay {
            truth: Trajectory::default(),
            sequences: Vec::new(),
            updates: Vec::new(),
            beginnings: vec![0],
        };
        for view in views {
            let Some(update) = player.step(view, Sight::Mapped, None) else {
                continue;
            };
            replay.truth.times_ns.push(view.time_ns);
            replay.truth.poses.push(view.truth);
            replay.sequences.push(view.sequence);
            replay.updates.push(update);
        }
        replay
    }

    /// A player of a new stream, which starts at a known pose, `world_from_camera`, if there is one.
    /// An unknown camera is estimated.
    fn player<'b>(&'b self, first: Option<Pose>, camera: Option<CameraIntrinsics>) -> Player<'b> {
        let first = first.map(|pose| PoseWithCovariance::known(pose, 1e-3, 1e-3));
        let camera = camera.map_or_else(StreamCamera::unknown, StreamCamera::Stated);
        Player {
            filter: &self.filter,
            map: &self.map,
            mapped: &self.mapped,
            height: self.recording.camera.height(),
            state: self.filter.start(first.as_ref()),
            front_end: FrontEnd::new(camera, Some(OdometryParameters::default())),
            predicted: None,
        }
    }
}

/// A stream that is replayed.
struct Stream<'a> {
    views: Vec<PlayedView<'a>>,
    /// Mean frame period, nanoseconds.
    period_ns: i64,
}

/// The views of frames of some recordings.
fn played<'a>(frames: &[(KeypointRecording<'a>, FrameId)], period_ns: i64) -> Vec<PlayedView<'a>> {
    let mut sequence: u64 = 0;
    let mut before: Option<FrameId> = None;
    let view = |(recording, frame): &(KeypointRecording<'a>, FrameId)| {
        // Rows left out leave gaps in the numbers; there is none between recordings.
        let step = before.filter(|before| before.0 < frame.0);
        sequence += step.map_or(1, |before| u64::from(frame.0 - before.0));
        before = Some(*frame);
        PlayedView {
            time_ns: sequence as i64 * period_ns,
            sequence,
            keypoints: &recording.keypoints[frame.row()],
            camera: Some(recording.camera),
            // Frames of a recording differ from each other.
            fingerprint: sequence,
            truth: recording.room.poses()[frame.row()],
        }
    };
    frames.iter().map(view).collect()
}

/// Views of a disturbed camera, one per tracked frame of a room.
#[derive(Debug, Clone, Copy)]
pub struct DisturbedKeypoints<'a> {
    /// Features, shape (tracked frames, d), for the nearest frame.
    pub features: ArrayView2<'a, f32>,
    /// Keypoints; none for a blank image.
    pub keypoints: &'a [Keypoints],
}

/// A room with its mapped part, to be tracked by a disturbed camera.
pub struct DisturbedRoom<'a>(TrackedRoom<'a>, HoldOut);

impl<'a> DisturbedRoom<'a> {
    /// Maps a part of a recording.
    ///
    /// # Errors
    /// As [`evaluate`].
    pub fn new(recording: &KeypointRecording<'a>, hold_out: HoldOut) -> Result<Self, Error> {
        let parameters = FilterParameters::default();
        Ok(Self(
            TrackedRoom::new(recording, hold_out, parameters)?,
            hold_out,
        ))
    }

    /// Tracks the disturbed streams. The camera is that of the map, stated, except for a narrower
    /// field of view: then it is unknown, and estimated from the first views.
    pub fn track(
        &self,
        disturbance: Disturbance,
        views: DisturbedKeypoints<'_>,
    ) -> DisturbedTracking {
        let Self(tracked, hold_out) = self;
        let room = tracked.recording.room;
        let is_known = !matches!(disturbance, Disturbance::FieldOfView { .. });
        let played = |frame: &PlannedFrame| PlayedView {
            time_ns: frame.time_ns,
            sequence: frame.sequence,
            keypoints: &views.keypoints[frame.view],
            camera: is_known.then_some(tracked.recording.camera),
            fingerprint: frame.view as u64,
            truth: frame.truth,
        };

        let streams = plan(room, *hold_out, disturbance).into_iter();
        let replayed = streams.map(|stream| {
            let played: Vec<PlayedView<'_>> = stream.frames.iter().map(played).collect();
            let replay = tracked.play(&played, InitialPose::Given);
            (stream, replay)
        });
        let replayed = replayed.collect();

        let baselines = Baselines::new(room.poses(), tracked.recording.features, &tracked.mapped);
        let nearest = |view: usize| baselines.poses_for(views.features.row(view)).0;
        scored(room, disturbance, replayed, &nearest)
    }
}

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
use seese3_robot::localization::{FocalSearch, KeypointRoom, LocatedView, NotLocated};
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::pose_filter::{FilterParameters, FilterRoom, PoseFilter, ViewObservation};
use seese3_robot::tracking::{
    InitialPose, MatchedPose, PoseWithCovariance, Replay, Status, joined, period_ns,
};

use super::matched_localization::{Baselines, PosedRecording, mapped_room};
use super::odometry::{
    LostFrames, OTHER_ROOM_FRAMES, PERIOD_NS, RoomOdometry, RoomReplays, room_odometry,
};
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

        let found = room_odometry(&replays)?;
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
        let room = self.recording.room;
        let same_sequence = |a: &FrameId, b: &FrameId| room.timeline().joins(*a, *b);
        let streams = self.tracked.chunk_by(same_sequence).map(|frames| {
            let period_ns = period_ns(room, frames);
            let frames: Vec<(&KeypointRecording<'_>, FrameId)> = frames
                .iter()
                .map(|frame| (&self.recording, *frame))
                .collect();
            (self.replay(&frames, period_ns, initial), period_ns)
        });
        joined(streams)
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
            let ours = ours.map(|frame| (&self.recording, *frame));
            let count = theirs.len();
            let theirs = theirs.into_iter().map(|frame| (&other.recording, frame));
            let frames: Vec<_> = ours.chain(theirs).collect();

            let replayed = self.replay(&frames, PERIOD_NS, InitialPose::Unknown);
            let updates = &replayed.updates[replayed.updates.len() - count..];
            let lost = updates
                .iter()
                .filter(|update| update.status == Status::Lost);
            found.frames += count;
            found.lost += lost.count();
        }
        found
    }

    /// Replays frames of this or another recording through the filter of this room.
    fn replay(
        &self,
        frames: &[(&KeypointRecording<'_>, FrameId)],
        period_ns: i64,
        initial: InitialPose,
    ) -> Replay {
        let mut sequence: u64 = 0;
        let mut before: Option<FrameId> = None;
        let played = frames.iter().map(|(recording, frame)| {
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
        });
        self.play(&played.collect::<Vec<_>>(), initial)
    }

    /// Replays views through the filter.
    fn play(&self, views: &[PlayedView<'_>], initial: InitialPose) -> Replay {
        let first = views.first().filter(|_| initial == InitialPose::Given);
        let first = first.map(|view| PoseWithCovariance::known(view.truth, 1e-3, 1e-3));
        let mut state = self.filter.start(first.as_ref());
        let mut replay = Replay {
            truth: Trajectory::default(),
            sequences: Vec::new(),
            updates: Vec::new(),
            beginnings: vec![0],
        };

        let mut predicted: Option<Pose> = None;
        let mut search = FocalSearch::default();
        for view in views {
            let camera = view.camera.or_else(|| {
                let height = self.recording.camera.height();
                search.camera(view.keypoints, height, std::iter::once(&self.map))
            });
            let located = camera.map(|camera| {
                let matched = ViewKeypoints {
                    keypoints: view.keypoints,
                    camera: &camera,
                };
                let located = self.map.locate_from(matched, predicted.as_ref());
                match (view.camera, located) {
                    (None, Ok(located)) => Ok(search.with_focal_of(&camera, located)),
                    (None, Err(why)) if why.is_of_camera() => {
                        search.contradict();
                        Err(why)
                    }
                    (_, located) => located,
                }
            });
            let observation = self.observation(view, located);
            let Ok(update) = self.filter.observe(&mut state, &observation) else {
                continue;
            };
            let tracked = update
                .map_pose
                .filter(|_| update.status == Status::Tracking);
            predicted = tracked.map(|tracked| tracked.pose);

            replay.truth.times_ns.push(observation.time_ns);
            replay.truth.poses.push(view.truth);
            replay.sequences.push(view.sequence);
            replay.updates.push(update);
        }
        replay
    }

    fn observation(
        &self,
        view: &PlayedView<'_>,
        located: Option<Result<LocatedView, NotLocated>>,
    ) -> ViewObservation {
        let (novelty, unlocated) = match &located {
            Some(Ok(found)) => (found.novelty, String::new()),
            Some(Err(why)) => (why.novelty().unwrap_or(f64::INFINITY), why.to_string()),
            None => (f64::INFINITY, "the camera is unknown".to_owned()),
        };
        let located = located.and_then(Result::ok);
        ViewObservation {
            time_ns: view.time_ns,
            sequence: view.sequence,
            matched: located.map(|found| MatchedPose {
                room: 0,
                pose: found.pose,
                novelty: found.novelty,
                best_frame: self.mapped[found.matched.best_frame()],
            }),
            novelty,
            unlocated,
            fingerprint: (!view.keypoints.is_empty()).then_some(view.fingerprint),
            measured: None,
        }
    }
}

/// A view of a stream.
struct PlayedView<'a> {
    time_ns: i64,
    sequence: u64,
    keypoints: &'a Keypoints,
    /// `None` if the service has to estimate it.
    camera: Option<CameraIntrinsics>,
    /// Equal for identical images.
    fingerprint: u64,
    /// `world_from_camera`.
    truth: Pose,
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

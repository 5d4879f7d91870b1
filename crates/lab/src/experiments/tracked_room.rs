//! A room with a mapped part, in which streams are tracked by keypoints or by an adapter.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2, Axis};

use seese3_core::adapter::Adapter;
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_core::trajectory::Trajectory;
use seese3_robot::fitting::{FitRun, RoomReader, fit};
use seese3_robot::front_end::{FrontEnd, RetrievalFrontEnd, StreamCamera};
use seese3_robot::localization::KeypointRoom;
use seese3_robot::pose_filter::{FilterParameters, FilterRoom, PoseFilter, ViewObservation};
use seese3_robot::tracking::{Map, PoseWithCovariance, Status};
use seese3_robot::visual_odometry::OdometryParameters;

use super::matched_localization::{Baselines, PosedRecording, mapped_room};
use super::player::{PlayedView, Player, Reader, Sensed, Sight, ViewInput};
use super::replay::{InitialPose, Replay, joined, period_ns};
use super::robustness::{Disturbance, DisturbedTracking, PlannedFrame, down_of, plan, scored};
use super::tracking_scores::LostFrames;
use super::{Error, Within, check_hold_out};

/// Frame period of replays that contain frames of another room, nanoseconds: 30 Hz.
const PERIOD_NS: i64 = 33_333_333;
/// Maximum number of frames of each other room replayed in a room.
const OTHER_ROOM_FRAMES: usize = 60;
/// Standard deviation per axis of a given initial pose, meters and radians.
const INITIAL_DEVIATION: f64 = 1e-3;

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

/// How to track, besides the room.
#[derive(Debug, Clone, Copy)]
pub struct TrackingProtocol {
    /// Which frames are mapped and which are tracked.
    pub hold_out: HoldOut,
    /// Parameters of the filter.
    pub parameters: FilterParameters,
    /// Whether an adapter is fitted to the mapped frames, starting from the given adapter's
    /// weights. The fitted adapter then locates the views. For tracking by an adapter alone.
    pub is_fitted: bool,
}

/// A room with its mapped part.
pub struct TrackedRoom<'a> {
    room: &'a Room,
    /// Features, row by frame, shape (n, d).
    features: ArrayView2<'a, f32>,
    hold_out: HoldOut,
    mapped: Vec<FrameId>,
    tracked: Vec<FrameId>,
    filter: PoseFilter,
    method: Method<'a>,
}

/// How views are located.
enum Method<'a> {
    Keypoints {
        map: Box<KeypointRoom>,
        keypoints: &'a [Keypoints],
        camera: CameraIntrinsics,
    },
    Retrieval {
        map: Arc<Map>,
    },
}

/// A stream of tracked frames.
pub(super) struct Stream<'a> {
    pub views: Vec<PlayedView<'a>>,
    /// Mean frame period, nanoseconds.
    pub period_ns: i64,
}

/// The observations of a stream, with the true poses.
pub(super) struct RecordedStream {
    /// The initial pose.
    pub start: Option<PoseWithCovariance>,
    pub frames: Vec<(ViewObservation, Pose)>,
}

fn initial(pose: Pose) -> PoseWithCovariance {
    PoseWithCovariance::known(pose, INITIAL_DEVIATION, INITIAL_DEVIATION)
}

/// Views of a disturbed camera, one per tracked frame of a room.
#[derive(Debug, Clone, Copy)]
pub struct DisturbedViews<'a> {
    /// Features, shape (tracked frames, d).
    pub features: ArrayView2<'a, f32>,
    /// Whether each disturbed image is blank.
    pub is_blank: &'a [bool],
    /// Keypoints of each image; empty for tracking by an adapter.
    pub keypoints: &'a [Keypoints],
}

impl<'a> TrackedRoom<'a> {
    /// Maps a part of a recording by its keypoints.
    ///
    /// # Errors
    /// [`Error`] if the recording is too small for the hold-out, or has no mapped keypoint.
    pub fn by_keypoints(
        recording: &KeypointRecording<'a>,
        protocol: &TrackingProtocol,
    ) -> Result<Self, Error> {
        let room = recording.room;
        check_hold_out(room, protocol.hold_out)?;
        let mapped = protocol.hold_out.mapped(room.timeline());
        let trials = PosedRecording {
            poses: room.poses(),
            keypoints: recording.keypoints,
            camera: recording.camera,
        };
        let map = mapped_room(trials, &mapped).within(|| format!("room '{}'", room.id()))?;
        let method = Method::Keypoints {
            map: Box::new(map),
            keypoints: recording.keypoints,
            camera: recording.camera,
        };
        Self::new(room, recording.features, protocol, method)
    }

    /// Maps a part of a room by an adapter.
    ///
    /// # Errors
    /// [`Error`] if the room is too small or the adapter has no error model.
    pub fn by_adapter(
        data: &RoomData<'a>,
        adapter: &Arc<Adapter>,
        protocol: &TrackingProtocol,
    ) -> Result<Self, Error> {
        check_hold_out(data.room, protocol.hold_out)?;
        let room = Arc::new(data.room.clone());
        let mapped = protocol.hold_out.mapped(room.timeline());
        let what = || format!("room '{}'", data.room.id());
        let kind = IndexKind::Exact;
        let navigator = Navigator::new(room, data.features, adapter.clone(), kind)?;
        let map = Map::new(Arc::new(navigator), &mapped).within(what)?;
        let mut map = map.with_features(data.features.rows(), &mapped);
        if protocol.is_fitted {
            let fitted = fit(data, &mapped, Some(adapter), 0, FitRun::UNWATCHED).within(what)?;
            let reader = RoomReader::new(data, &mapped, Some(adapter.clone()), &fitted);
            map = map.with_pose_reader(Arc::new(reader.within(what)?));
        }
        let method = Method::Retrieval { map: Arc::new(map) };
        Self::new(data.room, data.features.rows(), protocol, method)
    }

    fn new(
        room: &'a Room,
        features: ArrayView2<'a, f32>,
        protocol: &TrackingProtocol,
        method: Method<'a>,
    ) -> Result<Self, Error> {
        let mapped = protocol.hold_out.mapped(room.timeline());
        let rooms = vec![FilterRoom::of(room, &mapped)];
        let filter = PoseFilter::new(rooms, protocol.parameters);
        Ok(Self {
            tracked: protocol.hold_out.tracked(room.timeline()),
            filter: filter.ok_or_else(|| Error::Input("no room".to_owned()))?,
            hold_out: protocol.hold_out,
            room,
            features,
            mapped,
            method,
        })
    }

    /// The filter of its streams.
    pub(super) fn filter(&self) -> &PoseFilter {
        &self.filter
    }

    /// Diagonal of the bounding box of the mapped camera positions, meters.
    pub(super) fn extent_m(&self) -> f64 {
        self.filter.rooms()[0].extent_m
    }

    /// The tracked streams, each from its true first pose, as the front end reads them.
    pub(super) fn recorded(&self) -> Vec<RecordedStream> {
        let streams = self.streams();
        let recorded = streams.iter().map(|stream| {
            let first = stream.views.first().map(|view| view.truth);
            let mut player = self.player(first, stream.views.first());
            let frames = stream.views.iter().map(|view| {
                let observation = player.observation(view, Sight::Mapped, &Sensed::default());
                // A frame that the filter refuses is refused again in a trial.
                let _ = player.observe(&observation);
                (observation, view.truth)
            });
            RecordedStream {
                start: first.map(initial),
                frames: frames.collect(),
            }
        });
        recorded.collect()
    }

    /// The room, with all its frames.
    pub fn room(&self) -> &'a Room {
        self.room
    }

    /// Features, row by frame, shape (n, d).
    pub fn features(&self) -> ArrayView2<'a, f32> {
        self.features
    }

    /// Which frames are mapped and which are tracked.
    pub fn hold_out(&self) -> HoldOut {
        self.hold_out
    }

    /// The tracked frames.
    pub(super) fn tracked(&self) -> &[FrameId] {
        &self.tracked
    }

    /// The map of an adapter; `None` for keypoints.
    pub(super) fn map(&self) -> Option<&Arc<Map>> {
        match &self.method {
            Method::Keypoints { .. } => None,
            Method::Retrieval { map } => Some(map),
        }
    }

    /// The nearest frames by feature: the retrieval baselines.
    pub(super) fn baselines(&self) -> Baselines<'_> {
        Baselines::new(self.room.poses(), self.features, &self.mapped)
    }

    /// Replays the tracked frames, one stream per sequence.
    pub(super) fn own_replay(&self, initial: InitialPose) -> Replay {
        let streams = self.streams().into_iter().map(|stream| {
            let period_ns = stream.period_ns;
            (self.play(&stream.views, initial), period_ns)
        });
        joined(streams)
    }

    /// The tracked frames, one stream per sequence.
    pub(super) fn streams(&self) -> Vec<Stream<'_>> {
        let same_sequence = |a: &FrameId, b: &FrameId| self.room.timeline().joins(*a, *b);
        let streams = self.tracked.chunk_by(same_sequence).map(|frames| {
            let period_ns = period_ns(self.room, frames);
            let frames: Vec<_> = frames.iter().map(|frame| (self, *frame)).collect();
            Stream {
                views: played(&frames, period_ns),
                period_ns,
            }
        });
        streams.collect()
    }

    /// Replays frames of every other room, and counts the LOST answers. The last tracked frames of
    /// this room come first if `is_after_own`.
    pub(super) fn lost_frames(&self, all: &[Self], is_after_own: bool) -> LostFrames {
        let mut found = LostFrames::default();
        let mut own = self.tracked.clone();
        let own = own.split_off(own.len().saturating_sub(OTHER_ROOM_FRAMES));
        for other in all.iter().filter(|other| other.room.id() != self.room.id()) {
            let mut theirs = HoldOut::Interleaved.tracked(other.room.timeline());
            theirs.truncate(OTHER_ROOM_FRAMES);
            let ours = own.iter().filter(|_| is_after_own);
            let ours = ours.map(|frame| (self, *frame));
            let count = theirs.len();
            let theirs = theirs.into_iter().map(|frame| (other, frame));
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

    /// What a stream sends of a frame.
    fn input(&self, frame: FrameId, number: u64) -> ViewInput<'_> {
        match &self.method {
            Method::Keypoints {
                keypoints, camera, ..
            } => ViewInput::Keypoints {
                keypoints: &keypoints[frame.row()],
                camera: Some(*camera),
                // Frames of a recording differ from each other.
                fingerprint: number,
            },
            Method::Retrieval { map } => ViewInput::Feature {
                latent: map
                    .navigator()
                    .latents()
                    .index_axis_move(Axis(0), frame.row()),
                feature: self.features.row(frame.row()),
                is_blank: false,
            },
        }
    }

    /// Replays views through the filter.
    fn play(&self, views: &[PlayedView<'_>], initial: InitialPose) -> Replay {
        let first = views.first().filter(|_| initial == InitialPose::Given);
        let mut player = self.player(first.map(|view| view.truth), views.first());
        let mut replay = Replay {
            truth: Trajectory::default(),
            sequences: Vec::new(),
            updates: Vec::new(),
            beginnings: vec![0],
        };
        for view in views {
            let Some(update) = player.step(view, Sight::Mapped, &Sensed::default()) else {
                continue;
            };
            replay.truth.times_ns.push(view.time_ns);
            replay.truth.poses.push(view.truth);
            replay.sequences.push(view.sequence);
            replay.updates.push(update);
        }
        replay
    }

    /// A player of a new stream, which starts at a known pose, `world_from_camera`, if there is
    /// one. A camera that the `example` view does not state is estimated.
    pub(super) fn player(
        &self,
        first: Option<Pose>,
        example: Option<&PlayedView<'_>>,
    ) -> Player<'_> {
        Player {
            filter: &self.filter,
            state: self.filter.start(first.map(initial).as_ref()),
            reader: match &self.method {
                Method::Keypoints { map, camera, .. } => {
                    let stated = example.and_then(|view| match view.input {
                        ViewInput::Keypoints { camera, .. } => camera,
                        ViewInput::Feature { .. } => None,
                    });
                    let of_stream = stated.map_or_else(StreamCamera::unknown, StreamCamera::Stated);
                    let odometry = Some(OdometryParameters::default());
                    Reader::Keypoints {
                        map,
                        mapped: &self.mapped,
                        height: camera.height(),
                        front_end: Box::new(FrontEnd::new(of_stream, odometry)),
                    }
                }
                Method::Retrieval { map } => Reader::Retrieval {
                    map,
                    front_end: RetrievalFrontEnd::default(),
                },
            },
            predicted: None,
        }
    }

    /// Tracks disturbed streams, each from its true first pose. The camera is that of the map,
    /// stated, except for a narrower field of view: then it is unknown, and estimated from the
    /// first views.
    ///
    /// # Errors
    /// [`Error::Adapter`] if the features are not those of the adapter.
    pub fn track_disturbed(
        &self,
        disturbance: Disturbance,
        views: DisturbedViews<'_>,
    ) -> Result<DisturbedTracking, Error> {
        let latents = match &self.method {
            Method::Keypoints { .. } => Array2::zeros((0, 0)),
            Method::Retrieval { map } => map.navigator().adapter().embed(views.features)?,
        };
        let is_known = !matches!(disturbance, Disturbance::FieldOfView { .. });
        let down = down_of(self.room.poses());
        let played = |frame: &PlannedFrame| PlayedView {
            time_ns: frame.time_ns,
            sequence: frame.sequence,
            input: match &self.method {
                Method::Keypoints { camera, .. } => ViewInput::Keypoints {
                    keypoints: &views.keypoints[frame.view],
                    camera: is_known.then_some(*camera),
                    fingerprint: frame.view as u64,
                },
                Method::Retrieval { .. } => ViewInput::Feature {
                    latent: latents.row(frame.view),
                    feature: views.features.row(frame.view),
                    is_blank: frame.is_disturbed && views.is_blank[frame.view],
                },
            },
            gravity: disturbance.gravity(&frame.truth, down),
            truth: frame.truth,
        };

        let streams = plan(self.room, self.hold_out, disturbance).into_iter();
        let replayed = streams.map(|stream| {
            let played: Vec<PlayedView<'_>> = stream.frames.iter().map(played).collect();
            let replay = self.play(&played, InitialPose::Given);
            (stream, replay)
        });
        let replayed = replayed.collect();

        let baselines = self.baselines();
        let nearest = |view: usize| baselines.poses_for(views.features.row(view)).0;
        Ok(scored(self.room, disturbance, replayed, &nearest))
    }
}

/// The views of frames of some rooms.
fn played<'r, 'a: 'r>(
    frames: &[(&'r TrackedRoom<'a>, FrameId)],
    period_ns: i64,
) -> Vec<PlayedView<'r>> {
    let mut sequence: u64 = 0;
    let mut before: Option<FrameId> = None;
    let view = |(room, frame): &(&'r TrackedRoom<'a>, FrameId)| {
        // Rows left out leave gaps in the numbers; there is none between rooms.
        let step = before.filter(|before| before.0 < frame.0);
        sequence += step.map_or(1, |before| u64::from(frame.0 - before.0));
        before = Some(*frame);
        PlayedView {
            time_ns: sequence as i64 * period_ns,
            sequence,
            input: room.input(*frame, sequence),
            gravity: None,
            truth: room.room.poses()[frame.row()],
        }
    };
    frames.iter().map(view).collect()
}

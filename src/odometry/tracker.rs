//! Following a camera, frame by frame: dead reckoning from keyframes, corrected by places of the room that look alike.
//!
//! - A tracker keeps nothing: all that it knows of a stream is its [`State`], and the same state and frame give the same
//!   answer to the bit.
//! - `odom` is continuous: motions are added up and never corrected. `map` is corrected and may jump.

use std::sync::Arc;

use ndarray::{Array1, ArrayView1, Axis, s};

use super::chain::Chain;
use super::{Belief, Error, Map, Sighting, Status};
use crate::adapter::{Adapter, Calibration};
use crate::geometry::{Twist, body_twist};
use crate::index::Neighbour;

/// χ² with six degrees of freedom: 99 % of right matches are below it.
const GATE: f64 = 16.81;
/// Anchors of neighbouring keyframes err alike: each counts as this many times less sure.
const ANCHOR_INFLATION: f64 = 3.0;
/// Keyframes whose anchors must agree on a place before it is taken against what was believed, or without belief.
const AGREEING: u32 = 3;
/// Latents that a jump is told from.
const RECENT: usize = 5;
/// Frames without a mapped place after which the place is in doubt.
const UNSEEN: u32 = 10;
/// The nearest frame of the best room must be this much nearer than that of any other.
const ROOM_RATIO: f64 = 0.9;
/// How surely a stream's own origin is known, metres and radians: it is where it is by definition.
const ORIGIN: f64 = 1e-6;

/// How a tracker follows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Frames after which a new keyframe is taken, at least 1.
    pub keyframe_frames: u32,
    /// Displacement after which one is taken, ‖(v, ω)‖, metres and radians mixed, above 0.
    pub keyframe_displacement: f64,
    /// Whether places that look alike correct the pose.
    pub fuse: bool,
}

/// Keyframes this often: few enough to drift little in between, tried on the studio's calibration rooms.
pub const KEYFRAME_FRAMES: u32 = 3;

impl Settings {
    /// What fits an adapter: a keyframe every [`KEYFRAME_FRAMES`] frames, or once the displacement is past the root mean
    /// square of those that it was trained for.
    pub fn of(adapter: &Adapter) -> Self {
        let scale = adapter.scale();
        let displacement = (scale.mean.norm_squared() + scale.deviation.norm_squared()).sqrt();
        Self { keyframe_frames: KEYFRAME_FRAMES, keyframe_displacement: displacement, fuse: true }
    }
}

/// Follows cameras through rooms of one adapter.
pub struct Tracker {
    maps: Vec<Arc<Map>>,
    settings: Settings,
    calibration: Arc<Calibration>,
}

/// A frame as it comes.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// The sender's number.
    pub sequence: u64,
    /// Of the tracker's adapter.
    pub latent: Array1<f64>,
}

/// All that is known of a stream.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct State {
    /// The map that the camera is thought to be in.
    pub room: Option<usize>,
    /// The last frame that was taken.
    pub last: Option<Last>,
    /// What motions are read from.
    pub keyframe: Option<Keyframe>,
    /// Where the camera was put from outside, until the first frame comes: `world_from_camera`.
    pub initial: Option<Belief>,
    /// Whitened latents of the last frames, the newest last.
    pub recent: Vec<Vec<f64>>,
    /// Whether the frames hang together, and with the room.
    pub chain: Chain,
    /// A place that recent anchors speak for.
    pub candidate: Option<Candidate>,
    /// Frames since the last that looked like a mapped place.
    pub unseen: u32,
}

/// The last frame of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Last {
    /// Nanoseconds.
    pub time_ns: i64,
    /// The sender's number.
    pub sequence: u64,
    /// `odom_from_camera`.
    pub odom: Belief,
}

/// The frame that motions are read from.
#[derive(Debug, Clone, PartialEq)]
pub struct Keyframe {
    /// The sender's number.
    pub sequence: u64,
    /// Its latent.
    pub latent: Vec<f64>,
    /// `odom_from_camera` there.
    pub odom: Belief,
    /// `map_from_camera` there, if it is known.
    pub place: Option<Belief>,
    /// Frames since.
    pub age: u32,
}

/// A place that recent anchors agree on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The map.
    pub room: usize,
    /// `map_from_camera` at the keyframe.
    pub place: Belief,
    /// Anchors that agreed.
    pub agreed: u32,
}

/// What a frame says.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    /// From the keyframe, in its body frame.
    pub motion: Twist,
    /// Of the motion's six numbers.
    pub motion_covariance: nalgebra::Matrix6<f64>,
    /// The keyframe's number.
    pub keyframe_sequence: u64,
    /// Whether this frame is a keyframe from now on.
    pub is_keyframe: bool,
    /// `odom_from_camera`.
    pub odom: Belief,
    /// `map_from_camera`, if a place is known.
    pub place: Option<Belief>,
    /// Metres and radians a second in the camera's body frame since the frame before.
    pub velocity: Option<Twist>,
    /// Whether the place is known, and confirmed.
    pub status: Status,
    /// Why, in words.
    pub reason: String,
    /// Above 1 it looks like another place.
    pub out_of_distribution: f64,
    /// The map that the camera is thought to be in.
    pub room: Option<usize>,
    /// The map and the frame that look most alike.
    pub best: (usize, Neighbour),
    /// Whether that corrected the pose.
    pub used: bool,
    /// Its squared Mahalanobis distance from the expected place, if one was expected.
    pub surprise: Option<f64>,
}

/// Why a frame was not taken.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    #[error("timestamp {time_ns} ns is not later than that of the frame before, {last_ns} ns")]
    Late { time_ns: i64, last_ns: i64 },
    #[error("sequence {sequence} is not larger than that of the frame before, {last}")]
    Duplicate { sequence: u64, last: u64 },
    #[error(transparent)]
    View(#[from] crate::adapter::Error),
}

impl Tracker {
    /// A tracker in these rooms, which share an adapter; at least one.
    ///
    /// # Errors
    /// [`Error::NoMap`], [`Error::Adapters`].
    pub fn new(maps: Vec<Arc<Map>>, settings: Settings) -> Result<Self, Error> {
        let first = maps.first().ok_or(Error::NoMap)?.navigator().adapter().clone();
        if maps.iter().any(|map| !Arc::ptr_eq(map.navigator().adapter(), &first)) {
            return Err(Error::Adapters);
        }
        let calibration = first.calibration().ok_or(Error::NotCalibrated)?.clone();
        Ok(Self { maps, settings, calibration })
    }

    /// Its rooms.
    pub fn maps(&self) -> &[Arc<Map>] {
        &self.maps
    }

    /// A stream that begins: in the only map there is, or in one that is to be found; where it is put, if that is known.
    pub fn start(&self, initial: Option<Belief>) -> State {
        let room = (self.maps.len() == 1).then_some(0);
        State { room, chain: Chain::beginning(initial.is_some()), initial, ..State::default() }
    }

    /// Puts a stream's camera somewhere, `world_from_camera`; `odom` goes on as it was.
    pub fn put(&self, state: &mut State, place: Belief) {
        state.chain = Chain::beginning(true);
        (state.candidate, state.unseen) = (None, 0);
        match &mut state.keyframe {
            Some(keyframe) => keyframe.place = Some(place),
            None => state.initial = Some(place),
        }
    }

    /// Takes a frame; the state changes only if it was taken.
    ///
    /// # Errors
    /// [`Refusal`].
    pub fn observe(&self, state: &mut State, frame: &Observation) -> Result<Update, Refusal> {
        if let Some(last) = &state.last {
            if frame.time_ns <= last.time_ns {
                return Err(Refusal::Late { time_ns: frame.time_ns, last_ns: last.time_ns });
            }
            if frame.sequence <= last.sequence {
                return Err(Refusal::Duplicate { sequence: frame.sequence, last: last.sequence });
            }
        }
        self.adapter().check_latent(frame.latent.as_slice().unwrap_or_default())?;
        let mut next = state.clone();
        let update = self.step(&mut next, frame);
        *state = next;
        Ok(update)
    }

    fn adapter(&self) -> &Arc<Adapter> {
        self.maps[0].navigator().adapter()
    }

    fn step(&self, state: &mut State, frame: &Observation) -> Update {
        let (room, sighting) = self.look(state.room, frame.latent.view());
        let best = (room.unwrap_or(0), sighting.nearest[0]);
        let on_map = sighting.out_of_distribution <= 1.0;
        let jumped = self.jumped(state, frame.latent.view());
        state.chain = state.chain.after(on_map, jumped);
        state.unseen = if on_map { 0 } else { state.unseen.saturating_add(1) };
        if state.chain.is_lost() && self.maps.len() > 1 {
            (state.room, state.candidate) = (None, None);
        }
        let read = self.read(state, frame, jumped);
        let due = self.is_due(state, &read);
        let mut moved = read.moved;
        let (mut used, mut surprise) = (false, None);
        if due && self.settings.fuse {
            let motion = (read.motion, read.covariance);
            (used, surprise) =
                self.correct(state, &mut moved, motion, room.filter(|_| on_map).map(|room| (room, &sighting)));
        }
        let Moved { odom, place } = moved;
        let keyframe_sequence = state.keyframe.as_ref().map_or(frame.sequence, |keyframe| keyframe.sequence);
        let velocity = state.last.as_ref().map(|last| {
            let seconds = (frame.time_ns - last.time_ns) as f64 * 1e-9;
            body_twist(&last.odom.pose, &odom.pose).scaled(seconds.recip())
        });
        if due {
            let (sequence, latent) = (frame.sequence, frame.latent.to_vec());
            state.keyframe = Some(Keyframe { sequence, latent, odom, place, age: 0 });
            state.initial = None;
        } else if let Some(keyframe) = &mut state.keyframe {
            keyframe.age += 1;
        }
        state.last = Some(Last { time_ns: frame.time_ns, sequence: frame.sequence, odom });
        let (status, reason) = self.status(state, place.as_ref(), jumped);
        Update {
            motion: read.motion,
            motion_covariance: read.covariance,
            keyframe_sequence,
            is_keyframe: due,
            odom,
            place,
            velocity,
            status,
            reason,
            out_of_distribution: sighting.out_of_distribution,
            room: state.room,
            best,
            used,
            surprise,
        }
    }

    /// What the frame looks like in the room, or in the one of all rooms where it looks most alike; no room when two do.
    fn look(&self, room: Option<usize>, latent: ArrayView1<'_, f64>) -> (Option<usize>, Sighting) {
        if let Some(room) = room {
            return (Some(room), self.maps[room].sighting(latent, 1));
        }
        let mut sightings: Vec<(usize, Sighting)> =
            self.maps.iter().enumerate().map(|(room, map)| (room, map.sighting(latent, 1))).collect();
        let distance = |found: &(usize, Sighting)| found.1.nearest[0].distance;
        sightings.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.0.cmp(&b.0)));
        let clear = sightings.get(1).is_none_or(|second| distance(&sightings[0]) <= ROOM_RATIO * distance(second));
        let (room, sighting) = sightings.swap_remove(0);
        (clear.then_some(room), sighting)
    }

    /// Whether the frame shows what no camera sees that was just where the frames before were. Keeps the frame's latent.
    fn jumped(&self, state: &mut State, latent: ArrayView1<'_, f64>) -> bool {
        let coordinates = latent.slice(s![..self.adapter().coordinate_count()]);
        let white = self.calibration.flicker().whitened(coordinates.insert_axis(Axis(0))).row(0).to_vec();
        let distance = |other: &Vec<f64>| other.iter().zip(&white).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        let nearest = state.recent.iter().map(distance).fold(f64::INFINITY, f64::min);
        let jumped = !state.recent.is_empty() && nearest > self.calibration.measured().jump;
        if jumped {
            state.recent.clear();
        } else if state.recent.len() == RECENT {
            state.recent.remove(0);
        }
        state.recent.push(white);
        jumped
    }

    /// The motion from the keyframe, and where it leads. What a jump hid is a motion of which nothing is known but that
    /// it is not long, and a lost camera's motions are no surer.
    fn read(&self, state: &State, frame: &Observation, jumped: bool) -> Read {
        let Some(keyframe) = &state.keyframe else {
            let odom = Belief::known(crate::geometry::Pose::identity(), ORIGIN, ORIGIN);
            let covariance = odom.covariance;
            return Read { motion: Twist::default(), covariance, moved: Moved { odom, place: state.initial } };
        };
        let from = ArrayView1::from(&keyframe.latent);
        let coordinates = s![..self.adapter().coordinate_count()];
        let difference = &frame.latent.slice(coordinates) - &from.slice(coordinates);
        let mut motion = self.adapter().displacement(from, frame.latent.view());
        let mut covariance = self.calibration.motion_errors(difference.view());
        if jumped || state.chain.is_lost() {
            covariance += self.calibration.unread_errors();
        }
        if jumped {
            // From the last frame, not by what cannot be read.
            let last = state.last.as_ref().map_or(keyframe.odom.pose, |last| last.odom.pose);
            motion = body_twist(&keyframe.odom.pose, &last);
        }
        let moved = |belief: &Belief| belief.moved(motion, &covariance);
        let moved = Moved { odom: moved(&keyframe.odom), place: keyframe.place.as_ref().map(moved) };
        Read { motion, covariance, moved }
    }

    fn is_due(&self, state: &State, read: &Read) -> bool {
        let Settings { keyframe_frames, keyframe_displacement, .. } = self.settings;
        let aged = state.keyframe.as_ref().is_none_or(|keyframe| keyframe.age + 1 >= keyframe_frames);
        aged || state.chain.is_lost() || read.motion.norm() >= keyframe_displacement
    }

    /// Corrects a place by what the frame looks like: an anchor within the gate is taken; others, and those without a
    /// belief to hold them against, only once several in a row agree. Whether it was taken, and its squared Mahalanobis
    /// distance from the belief.
    fn correct(
        &self,
        state: &mut State,
        moved: &mut Moved,
        (motion, covariance): (Twist, nalgebra::Matrix6<f64>),
        seen: Option<(usize, &Sighting)>,
    ) -> (bool, Option<f64>) {
        let carried = state.candidate.take().map(|c| Candidate { place: c.place.moved(motion, &covariance), ..c });
        let Some((room, sighting)) = seen.filter(|_| !state.chain.is_lost()) else {
            state.candidate = carried.filter(|_| !state.chain.is_lost());
            return (false, None);
        };
        let Belief { pose, covariance } = sighting.anchor;
        let anchor = Belief { pose, covariance: covariance * ANCHOR_INFLATION };
        let surprise = |belief: &Belief| belief.innovation(&anchor).map_or(f64::INFINITY, |found| found.squared_length);
        let expected = moved.place.filter(|_| state.room == Some(room)).map(|place| (place, surprise(&place)));
        if let Some((place, surprise)) = expected
            && surprise <= GATE
        {
            moved.place = Some(place.corrected(&anchor));
            return (true, Some(surprise));
        }
        let fresh = Candidate { room, place: anchor, agreed: 1 };
        let candidate = match carried {
            Some(old) if old.room == room && surprise(&old.place) <= GATE => {
                Candidate { room, place: old.place.corrected(&anchor), agreed: old.agreed + 1 }
            }
            _ => fresh,
        };
        let taken = candidate.agreed >= AGREEING;
        if taken {
            (state.room, moved.place) = (Some(room), Some(candidate.place));
        } else {
            state.candidate = Some(candidate);
        }
        (taken, expected.map(|(_, surprise)| surprise))
    }

    fn status(&self, state: &State, place: Option<&Belief>, jumped: bool) -> (Status, String) {
        if state.chain.is_lost() {
            let why = if jumped { "the view jumped" } else { "the frames do not look like the room" };
            return (Status::Lost, why.to_owned());
        }
        let Some(place) = place else {
            let agreed = state.candidate.map_or(0, |candidate| candidate.agreed);
            return (Status::Relocalizing, format!("{agreed} of {AGREEING} keyframes agree on a place"));
        };
        let (deviation, extent) =
            (place.position_deviation_m(), state.room.map_or(0.0, |room| self.maps[room].extent_m()));
        if deviation > extent {
            return (
                Status::Lost,
                format!("the position is known to {deviation:.1} m, the room is {extent:.1} m wide"),
            );
        }
        match state.unseen {
            0..UNSEEN => (Status::Tracking, "recent frames look like mapped places".to_owned()),
            unseen => (Status::Degraded, format!("no mapped place for {unseen} frames")),
        }
    }
}

/// Beliefs after a motion.
#[derive(Debug, Clone, Copy)]
struct Moved {
    odom: Belief,
    place: Option<Belief>,
}

/// A motion and where it leads.
struct Read {
    motion: Twist,
    covariance: nalgebra::Matrix6<f64>,
    moved: Moved,
}

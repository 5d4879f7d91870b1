//! Following a camera, frame by frame: dead reckoning from keyframes, corrected by places of the
//! room that look alike.
//!
//! - A tracker keeps nothing: all that it knows of a stream is its [`State`], and the same state
//!   and frame give the same answer to the bit.
//! - `odom` is continuous: motions are added up and never corrected. `map` is corrected and may
//!   jump.

use std::sync::Arc;

use ndarray::{ArrayView1, Axis, s};

use super::chain::{Chain, Look};
use super::state::{Candidate, Keyframe, Last, Observation, Refusal, State, Update};
use super::{Belief, Error, Map, ROOM_RATIO, Sighting};
use crate::adapter::{Adapter, Calibration, RECENT};
use crate::geometry::{Twist, body_twist};

/// χ² with six degrees of freedom: 99 % of right matches are below it.
const GATE: f64 = 16.81;
/// Anchors of neighbouring keyframes err alike: each counts as this many times less sure.
const ANCHOR_INFLATION: f64 = 2.0;
/// Frames from one look for an anchor to the next: those in between err alike.
const ANCHOR_EVERY: u32 = 3;
/// Anchors in a row that must agree on a place before it is taken against what was believed, or
/// without belief.
pub const AGREEING: u32 = 4;
/// How surely a stream's own origin is known, metres and radians: it is where it is by definition.
const ORIGIN: f64 = 1e-6;

/// How a tracker follows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Frames after which a new keyframe is taken, by their numbers, at least 1.
    pub keyframe_frames: u32,
    /// Displacement after which one is taken, ‖(v, ω)‖, metres and radians mixed, above 0.
    pub keyframe_displacement: f64,
    /// Whether places that look alike correct the pose.
    pub fuse: bool,
}

impl Settings {
    /// What keeps motions within those that an adapter was trained for and its errors were measured
    /// over: a keyframe after as many frames as the longest of them, or twice the root mean square
    /// of their displacements.
    ///
    /// Motions of latents add up, so that many keyframes do not read a way better than few; their
    /// errors are those that were measured only while no more than one motion is read since the
    /// last place.
    pub fn of(adapter: &Adapter) -> Self {
        let scale = adapter.scale();
        let displacement =
            2.0 * (scale.mean.norm_squared() + scale.deviation.norm_squared()).sqrt();
        let longest = adapter
            .calibration()
            .map_or(1.0, |calibration| calibration.longest_frames());

        Self {
            keyframe_frames: longest as u32,
            keyframe_displacement: displacement,
            fuse: true,
        }
    }
}

/// Follows cameras through rooms of one adapter.
pub struct Tracker {
    pub(super) maps: Vec<Arc<Map>>,
    pub(super) settings: Settings,
    calibration: Arc<Calibration>,
    place_factor: f64,
}

impl Tracker {
    /// A tracker in these rooms, which share an adapter; at least one.
    ///
    /// # Errors
    /// [`Error::NoMap`], [`Error::Adapters`].
    pub fn new(maps: Vec<Arc<Map>>, settings: Settings) -> Result<Self, Error> {
        let first = maps
            .first()
            .ok_or(Error::NoMap)?
            .navigator()
            .adapter()
            .clone();

        if maps
            .iter()
            .any(|map| !Arc::ptr_eq(map.navigator().adapter(), &first))
        {
            return Err(Error::Adapters);
        }

        let calibration = first.calibration().ok_or(Error::NotCalibrated)?.clone();
        let place_factor = calibration.measured().place;

        Ok(Self {
            maps,
            settings,
            calibration,
            place_factor,
        })
    }

    /// The same with another factor of the covariances of corrected places: to find the right one.
    #[must_use]
    pub fn with_place_factor(self, place_factor: f64) -> Self {
        Self {
            place_factor,
            ..self
        }
    }

    /// Its rooms.
    pub fn maps(&self) -> &[Arc<Map>] {
        &self.maps
    }

    /// How it follows.
    pub fn settings(&self) -> Settings {
        self.settings
    }

    /// A stream that begins: in the only map there is, or in one that is to be found; where it is
    /// put, if that is known.
    pub fn start(&self, initial: Option<Belief>) -> State {
        let room = (self.maps.len() == 1).then_some(0);
        State {
            room,
            chain: Chain::beginning(initial.is_some()),
            initial,
            ..State::default()
        }
    }

    /// Puts a stream's camera somewhere, `world_from_camera`; `odom` goes on as it was.
    pub fn put(&self, state: &mut State, place: Belief) {
        state.chain = Chain::beginning(true);
        state.candidate = None;
        state.unseen = 0;

        match &state.last {
            // There is where the last frame was taken, which is a keyframe from now on.
            Some(Last {
                sequence,
                latent,
                odom,
                ..
            }) => {
                let sequence = *sequence;
                let latent = latent.clone();
                let odom = *odom;

                state.keyframe = Some(Keyframe {
                    sequence,
                    latent,
                    odom,
                    place: Some(place),
                    told: Some(place),
                });
            }
            None => state.initial = Some(place),
        }
    }

    /// Takes a frame; the state changes only if it was taken.
    ///
    /// # Errors
    /// [`Refusal`].
    pub fn observe(&self, state: &mut State, frame: &Observation) -> Result<Update, Refusal> {
        if let Some(last) = &state.last {
            if frame.sequence <= last.sequence {
                return Err(Refusal::Duplicate {
                    sequence: frame.sequence,
                    last: last.sequence,
                });
            }

            if frame.time_ns <= last.time_ns {
                return Err(Refusal::Late {
                    time_ns: frame.time_ns,
                    last_ns: last.time_ns,
                });
            }
        }

        self.adapter()
            .check_latent(frame.latent.as_slice().unwrap_or_default())?;
        let mut next = state.clone();
        let update = self.step(&mut next, frame);

        *state = next;
        Ok(update)
    }

    fn adapter(&self) -> &Arc<Adapter> {
        self.maps[0].navigator().adapter()
    }

    fn step(&self, state: &mut State, frame: &Observation) -> Update {
        let Looked {
            room,
            is_clear,
            sighting,
        } = self.look(state.room, frame.latent.view());
        let on_map = sighting.out_of_distribution <= 1.0;

        // Numbers that are missing are frames that are missing.
        let frames = state
            .last
            .as_ref()
            .map_or(1, |last| frame.sequence - last.sequence);
        let gap = frames > RECENT as u64;

        let jumped = self.jumped(state, frame.latent.view(), frames);
        state.chain = state.chain.after(Look {
            on_map,
            sure: sighting.is_sure,
            jumped,
            gap,
        });

        state.unseen = if on_map {
            0
        } else {
            state.unseen.saturating_add(1)
        };

        let unread = Unread {
            jumped: jumped || (gap && !on_map),
            gap,
        };
        let read = self.read(state, frame, unread);
        let mut moved = read.moved;

        if state.chain.is_lost() {
            // What was believed is told on, less and less surely, but anchors have to agree before
            // it is believed again.
            moved.place = None;
            state.candidate = None;
            if self.maps.len() > 1 {
                moved.told = None;
                state.room = None;
            }
        }

        let mut used = false;
        let mut surprise = None;
        state.unlooked = state.unlooked.saturating_add(1);

        if self.settings.fuse
            && on_map
            && (state.unlooked >= ANCHOR_EVERY || state.keyframe.is_none())
        {
            state.unlooked = 0;
            if is_clear {
                (used, surprise) = self.correct(state, &mut moved, frame, (room, &sighting));
            }
        }

        let due = used || self.is_due(state, frame.sequence, &read);
        let Moved { odom, place, .. } = moved;
        let told = if used {
            place.map(|place| self.told(place, &sighting.anchor))
        } else {
            moved.told
        };

        let keyframe_sequence = state
            .keyframe
            .as_ref()
            .map_or(frame.sequence, |keyframe| keyframe.sequence);

        let velocity = state.last.as_ref().map(|last| {
            let seconds = frame.time_ns.abs_diff(last.time_ns) as f64 * 1e-9;
            body_twist(&last.odom.pose, &odom.pose).scaled(seconds.recip())
        });

        let time_ns = frame.time_ns;
        let sequence = frame.sequence;
        let latent = frame.latent.to_vec();
        if due {
            state.keyframe = Some(Keyframe {
                sequence,
                latent: latent.clone(),
                odom,
                place,
                told,
            });

            state.initial = None;
        }

        state.last = Some(Last {
            time_ns,
            sequence,
            latent,
            odom,
        });

        let (status, reason) = self.status(state, place.and(told).as_ref(), &sighting);
        Update {
            motion: read.motion,
            motion_covariance: read.covariance,
            keyframe_sequence,
            is_keyframe: due,
            odom,
            place: told,
            velocity,
            status,
            reason,
            out_of_distribution: sighting.out_of_distribution,
            room: state.room,
            best: (room, sighting.nearest[0]),
            used,
            surprise,
            candidate: state.candidate.clone(),
        }
    }

    /// What the frame looks like in the room, or in the one of all rooms where it looks most alike.
    fn look(&self, room: Option<usize>, latent: ArrayView1<'_, f64>) -> Looked {
        if let Some(room) = room {
            return Looked {
                room,
                is_clear: true,
                sighting: self.maps[room].sighting(latent, 1),
            };
        }

        let mut sightings: Vec<(usize, Sighting)> = self
            .maps
            .iter()
            .enumerate()
            .map(|(room, map)| (room, map.sighting(latent, 1)))
            .collect();

        let distance = |found: &(usize, Sighting)| found.1.nearest[0].distance;
        sightings.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.0.cmp(&b.0)));
        let is_clear = sightings
            .get(1)
            .is_none_or(|second| distance(&sightings[0]) <= ROOM_RATIO * distance(second));

        let (room, sighting) = sightings.swap_remove(0);
        Looked {
            room,
            is_clear,
            sighting,
        }
    }

    /// Whether the frame shows what no camera sees that was so many frames ago where the frames
    /// before were. Keeps the frame's latent.
    fn jumped(&self, state: &mut State, latent: ArrayView1<'_, f64>, frames: u64) -> bool {
        let coordinates = latent.slice(s![..self.adapter().coordinate_count()]);
        let white = self
            .calibration
            .flicker()
            .whitened(coordinates.insert_axis(Axis(0)))
            .row(0)
            .to_vec();

        let distance = |other: &Vec<f64>| {
            other
                .iter()
                .zip(&white)
                .map(|(a, b)| (a - b) * (a - b))
                .sum::<f64>()
                .sqrt()
        };

        let nearest = state
            .recent
            .iter()
            .map(distance)
            .fold(f64::INFINITY, f64::min);

        if frames > RECENT as u64 {
            state.recent.clear();
        }

        // How far a camera's own latents lie apart grows with the frames in between, slowly: about
        // as their cube root.
        let limit = self.calibration.measured().jump * (frames as f64).cbrt();
        let jumped = !state.recent.is_empty() && nearest > limit;
        if jumped {
            state.recent.clear();
        } else if state.recent.len() == RECENT {
            state.recent.remove(0);
        }

        state.recent.push(white);
        jumped
    }

    /// The motion from the keyframe, and where it leads. What a jump hid is a motion of which
    /// nothing is known but that it is not long; a gap's and a lost camera's motions are less sure.
    fn read(&self, state: &State, frame: &Observation, unread: Unread) -> Read {
        let Some(keyframe) = &state.keyframe else {
            let odom = Belief::known(crate::geometry::Pose::identity(), ORIGIN, ORIGIN);
            let covariance = odom.covariance;

            return Read {
                motion: Twist::default(),
                covariance,
                moved: Moved {
                    odom,
                    place: state.initial,
                    told: state.initial,
                },
            };
        };

        let (mut motion, mut covariance) =
            self.between(state.room, (&keyframe.latent, keyframe.sequence), frame);
        if unread.jumped || unread.gap || state.chain.is_lost() {
            covariance += self.calibration.unread_errors();
        }

        if unread.jumped {
            // From the last frame, not by what cannot be read.
            let last = state
                .last
                .as_ref()
                .map_or(keyframe.odom.pose, |last| last.odom.pose);
            motion = body_twist(&keyframe.odom.pose, &last);
        }

        let moved = |belief: &Belief| belief.moved(motion, &covariance);
        let moved = Moved {
            odom: moved(&keyframe.odom),
            place: keyframe.place.as_ref().map(moved),
            told: keyframe.told.as_ref().map(moved),
        };

        Read {
            motion,
            covariance,
            moved,
        }
    }

    /// A corrected place as it is told: as sure as the anchor that corrected it, not as what the
    /// filter makes of many. Anchors on the same part of a way err alike, and more of them tell
    /// nothing new.
    fn told(&self, place: Belief, anchor: &Belief) -> Belief {
        Belief {
            covariance: anchor.covariance * self.place_factor,
            ..place
        }
    }

    fn is_due(&self, state: &State, sequence: u64, read: &Read) -> bool {
        let Settings {
            keyframe_frames,
            keyframe_displacement,
            ..
        } = self.settings;
        let aged = state.keyframe.as_ref().is_none_or(|keyframe| {
            sequence.saturating_sub(keyframe.sequence) >= u64::from(keyframe_frames)
        });

        aged || state.chain.is_lost() || read.motion.norm() >= keyframe_displacement
    }

    /// The motion between two frames, and the covariance of its error.
    fn between(
        &self,
        room: Option<usize>,
        from: (&[f64], u64),
        to: &Observation,
    ) -> (Twist, nalgebra::Matrix6<f64>) {
        let latent = ArrayView1::from(from.0);
        let coordinates = s![..self.adapter().coordinate_count()];
        let difference = &to.latent.slice(coordinates) - &latent.slice(coordinates);
        let errors = room.map_or(&self.calibration.measured().motion, |room| {
            self.maps[room].motion()
        });

        let length = self.calibration.spread_length(difference.view());
        let covariance = errors.at(length, to.sequence.saturating_sub(from.1));
        let motion = self.adapter().displacement(latent, to.latent.view());
        match motion.is_unique_logarithm() {
            true => (motion, covariance),
            // No camera turns by half between two frames that are compared: nothing was read.
            false => (
                Twist::default(),
                covariance + self.calibration.unread_errors(),
            ),
        }
    }

    /// Corrects a place by what the frame looks like: an anchor within the gate is taken; others,
    /// and those without a belief to hold them against, only once several in a row agree. Whether
    /// it was taken, and its squared Mahalanobis distance from the belief.
    fn correct(
        &self,
        state: &mut State,
        moved: &mut Moved,
        frame: &Observation,
        (room, sighting): (usize, &Sighting),
    ) -> (bool, Option<f64>) {
        let candidate = state.candidate.take();
        if state.chain.is_lost() {
            return (false, None);
        }

        let Belief { pose, covariance } = sighting.anchor;
        let anchor = Belief {
            pose,
            covariance: covariance * ANCHOR_INFLATION,
        };
        let surprise = |belief: &Belief| {
            belief
                .innovation(&anchor)
                .map_or(f64::INFINITY, |found| found.squared_length)
        };

        let expected = moved
            .place
            .filter(|_| state.room == Some(room))
            .map(|place| (place, surprise(&place)));

        if let Some((place, surprise)) = expected
            && surprise <= GATE
        {
            moved.place = Some(place.corrected(&anchor));
            return (true, Some(surprise));
        }

        let carried = candidate
            .filter(|candidate| candidate.room == room)
            .map(|candidate| {
                let (motion, covariance) =
                    self.between(Some(room), (&candidate.latent, candidate.sequence), frame);
                (candidate.place.moved(motion, &covariance), candidate.agreed)
            });

        let (place, agreed) = match carried {
            Some((place, agreed)) if surprise(&place) <= GATE => {
                (place.corrected(&anchor), agreed + 1)
            }
            _ => (anchor, 1),
        };
        let taken = agreed >= AGREEING;

        if taken {
            state.room = Some(room);
            moved.place = Some(place);
        } else {
            let sequence = frame.sequence;
            let latent = frame.latent.to_vec();

            state.candidate = Some(Candidate {
                room,
                sequence,
                latent,
                place,
                agreed,
            });
        }

        (taken, expected.map(|(_, surprise)| surprise))
    }
}

/// What a frame looks like.
struct Looked {
    /// The map where it looks most alike.
    room: usize,
    /// Whether no other looks nearly as much alike.
    is_clear: bool,
    sighting: Sighting,
}

/// Why a motion cannot be read as others are.
#[derive(Debug, Clone, Copy)]
struct Unread {
    /// Nothing of it was seen.
    jumped: bool,
    /// Frames of it are missing.
    gap: bool,
}

/// Beliefs after a motion.
#[derive(Debug, Clone, Copy)]
struct Moved {
    odom: Belief,
    place: Option<Belief>,
    told: Option<Belief>,
}

/// A motion and where it leads.
struct Read {
    motion: Twist,
    covariance: nalgebra::Matrix6<f64>,
    moved: Moved,
}

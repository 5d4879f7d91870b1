//! The state of a stream as bytes, for resume tokens. Every number comes back bit by bit.
//!
//! The messages are the tokens' own format and no part of the public API. A change of their layout
//! or meaning needs a new `MAGIC` in `token`.

use std::sync::Arc;

use nalgebra::{Quaternion, SMatrix, Translation3, UnitQuaternion, Vector6};
use prost::Message;

use super::super::Error;
use super::super::snapshot::{ServedNavigator, frames_content};
use seese3_core::geometry::{Pose, Twist};
use seese3_core::tracking::{
    Belief, Candidate, Driven, Keyframe, LastFrame, LastMeasured, MeasuredSince, MovingBelief,
    Place, State, TrackingHealth,
};

/// The content of a token: the configuration of the stream, what its state is made of, and the
/// state.
#[derive(Clone, PartialEq, Message)]
pub struct Sealed {
    /// The configuration as it was sent.
    #[prost(message, optional, tag = "1")]
    pub config: Option<seese3_client::proto::v1::TrackConfig>,
    /// Of `Content::adapter`.
    #[prost(bytes = "vec", tag = "2")]
    pub adapter: Vec<u8>,
    #[prost(message, optional, tag = "3")]
    pub state: Option<SealedState>,
    /// The rooms that the state names.
    #[prost(message, repeated, tag = "4")]
    pub rooms: Vec<SealedRoom>,
}

/// A room that a state names.
#[derive(Clone, PartialEq, Message)]
pub struct SealedRoom {
    /// By which number the state names it.
    #[prost(uint64, tag = "1")]
    place: u64,
    #[prost(string, tag = "2")]
    name: String,
    #[prost(uint64, tag = "3")]
    frame_count: u64,
    /// Of `Content::frames`.
    #[prost(bytes = "vec", tag = "4")]
    frames: Vec<u8>,
}

impl SealedRoom {
    /// The rooms that a state names, of those that its stream is answered from.
    pub fn named_by(state: &State, served: &[Arc<ServedNavigator>]) -> Vec<Self> {
        let candidate = state.candidate.as_ref().map(|candidate| candidate.room);
        let mut places: Vec<usize> = state.room.into_iter().chain(candidate).collect();
        places.dedup();

        let sealed = |place: usize| {
            let room = served[place].navigator.room();
            Self {
                place: place as u64,
                name: room.id().to_string(),
                frame_count: room.frame_count() as u64,
                frames: served[place].content.frames.to_vec(),
            }
        };
        places.into_iter().map(sealed).collect()
    }

    /// Where this room is among those that are served: one that has the same frames, maybe with
    /// others behind them. Poses and latents of a state mean the same there.
    fn place_in(&self, served: &[Arc<ServedNavigator>]) -> Option<usize> {
        let is_this = |served: &Arc<ServedNavigator>| {
            let room = served.navigator.room();
            let has_frames = usize::try_from(self.frame_count)
                .is_ok_and(|frame_count| frame_count <= room.frame_count());

            room.id().as_str() == self.name && has_frames && {
                let frame_count = self.frame_count as usize;
                let frames = if frame_count == room.frame_count() {
                    served.content.frames
                } else {
                    frames_content(&served.navigator, frame_count)
                };
                frames.as_slice() == self.frames
            }
        };

        served.iter().position(is_this)
    }
}

impl Sealed {
    /// The state, with its rooms by their numbers among those that are served here under the
    /// stream's adapter; none if the state means nothing here.
    ///
    /// # Errors
    /// [`Error::Internal`] if the numbers do not make a state.
    pub fn opened_in(self, served: &[Arc<ServedNavigator>]) -> Result<Option<State>, Error> {
        let mut state = self.state.ok_or(Error::Internal)?.state()?;
        let is_adapter = |served: &Arc<ServedNavigator>| served.content.adapter == *self.adapter;
        if !served.iter().all(is_adapter) {
            return Ok(None);
        }

        let place_here = |place: usize| {
            let mut rooms = self.rooms.iter();
            rooms
                .find(|room| room.place == place as u64)?
                .place_in(served)
        };
        if let Some(room) = state.room {
            let Some(here) = place_here(room) else {
                return Ok(None);
            };
            state.room = Some(here);
        }
        if let Some(candidate) = &mut state.candidate {
            let Some(here) = place_here(candidate.room) else {
                return Ok(None);
            };
            candidate.room = here;
        }

        Ok(Some(state))
    }
}

#[derive(Clone, PartialEq, Message)]
pub struct SealedState {
    #[prost(uint64, optional, tag = "1")]
    room: Option<u64>,
    #[prost(message, optional, tag = "2")]
    last: Option<SealedLast>,
    #[prost(message, optional, tag = "3")]
    keyframe: Option<SealedKeyframe>,
    #[prost(double, repeated, tag = "4")]
    initial_pose: Vec<f64>,
    /// The rows of `State::recent` one after another; `recent_count` says how many they are.
    #[prost(double, repeated, tag = "5")]
    recent: Vec<f64>,
    #[prost(uint32, tag = "6")]
    recent_count: u32,
    /// Tracking health: 0 fresh, 1 held, 2 held and confirmed, 3 lost.
    #[prost(uint32, tag = "7")]
    health: u32,
    #[prost(int32, tag = "8")]
    health_count: i32,
    #[prost(message, optional, tag = "9")]
    candidate: Option<SealedCandidate>,
    #[prost(uint32, tag = "10")]
    frames_off_map: u32,
    #[prost(int64, optional, tag = "11")]
    corrected_ns: Option<i64>,
    #[prost(message, optional, tag = "12")]
    place: Option<SealedPlace>,
    #[prost(uint32, tag = "13")]
    unchanged_frames: u32,
    #[prost(message, optional, tag = "14")]
    measured: Option<SealedMeasured>,
}

/// What other sensors measured; absent if none ever did.
#[derive(Clone, PartialEq, Message)]
struct SealedMeasured {
    /// Of the last frame that brought a pose.
    #[prost(int64, tag = "4")]
    time_ns: i64,
    #[prost(double, repeated, tag = "1")]
    last: Vec<f64>,
    #[prost(double, repeated, tag = "2")]
    keyframe: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    place: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct SealedLast {
    #[prost(int64, tag = "1")]
    time_ns: i64,
    #[prost(uint64, tag = "2")]
    sequence: u64,
    #[prost(double, repeated, tag = "3")]
    odom: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    latent: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct SealedKeyframe {
    #[prost(uint64, tag = "1")]
    sequence: u64,
    #[prost(double, repeated, tag = "2")]
    latent: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    odom: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    reported_pose: Vec<f64>,
    #[prost(int64, tag = "5")]
    time_ns: i64,
}

#[derive(Clone, PartialEq, Message)]
struct SealedPlace {
    #[prost(int64, tag = "1")]
    time_ns: i64,
    #[prost(double, repeated, tag = "2")]
    latent: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    belief: Vec<f64>,
    /// The upper triangle of the covariance of its lasting error.
    #[prost(double, repeated, tag = "4")]
    lasting: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
struct SealedCandidate {
    #[prost(uint64, tag = "1")]
    room: u64,
    #[prost(double, repeated, tag = "2")]
    map_pose: Vec<f64>,
    #[prost(uint32, tag = "3")]
    agreeing_anchors: u32,
    #[prost(uint64, tag = "4")]
    sequence: u64,
    #[prost(double, repeated, tag = "5")]
    latent: Vec<f64>,
    #[prost(int64, tag = "6")]
    time_ns: i64,
}

impl SealedLast {
    fn opened(self) -> Result<LastFrame, Error> {
        let Self {
            time_ns,
            sequence,
            odom,
            latent,
        } = self;

        Ok(LastFrame {
            time_ns,
            sequence,
            latent,
            odom: required(&odom)?,
        })
    }
}

impl SealedKeyframe {
    fn opened(self) -> Result<Keyframe, Error> {
        let Self {
            sequence,
            latent,
            odom,
            reported_pose,
            time_ns,
        } = self;

        Ok(Keyframe {
            time_ns,
            sequence,
            latent,
            odom: moving_of_numbers(&odom)?,
            reported_pose: belief_of_numbers(&reported_pose)?,
        })
    }
}

impl SealedPlace {
    fn opened(self) -> Result<Place, Error> {
        let Self {
            time_ns,
            latent,
            belief,
            lasting,
        } = self;

        Ok(Place {
            time_ns,
            latent,
            belief: moving_of_numbers(&belief)?,
            lasting: symmetric(&lasting)?,
        })
    }
}

impl SealedCandidate {
    fn opened(self) -> Result<Candidate, Error> {
        let Self {
            room,
            map_pose,
            agreeing_anchors,
            sequence,
            latent,
            time_ns,
        } = self;

        Ok(Candidate {
            room: index(room)?,
            time_ns,
            sequence,
            latent,
            map_pose: required(&map_pose)?,
            agreeing_anchors,
        })
    }
}

fn index(room: u64) -> Result<usize, Error> {
    usize::try_from(room).map_err(|_| Error::Internal)
}

/// The 28 numbers of a belief: those of its pose and of its covariance.
fn belief_to_numbers(belief: &Belief) -> Vec<f64> {
    let mut numbers = pose_to_numbers(&belief.pose);
    numbers.extend(upper_triangle::<6>().map(|at| belief.covariance[at]));
    numbers
}

/// The 91 numbers of a moving belief: those of its pose, six of its velocity, and those of its
/// covariance.
fn moving_to_numbers(belief: &MovingBelief) -> Vec<f64> {
    let mut numbers = pose_to_numbers(&belief.pose);
    numbers.extend(&belief.velocity.to_vector());
    numbers.extend(upper_triangle::<12>().map(|at| belief.covariance[at]));
    numbers
}

/// Translation and quaternion (x, y, z, w).
fn pose_to_numbers(pose: &Pose) -> Vec<f64> {
    let t = pose.translation.vector;
    let q = pose.rotation.coords;
    vec![t.x, t.y, t.z, q.x, q.y, q.z, q.w]
}

/// The nine numbers of what was driven; none of nothing.
fn driven_to_numbers(driven: Option<&Driven>) -> Vec<f64> {
    driven.map_or_else(Vec::new, |driven| {
        let mut numbers = pose_to_numbers(&driven.pose);
        numbers.extend([driven.way_m, driven.turns_rad]);
        numbers
    })
}

/// What was driven by such numbers; nothing if there are none.
fn driven_of_numbers(numbers: &[f64]) -> Result<Option<Driven>, Error> {
    if numbers.is_empty() {
        return Ok(None);
    }

    let (pose, rest) = pose_of_numbers(numbers)?;
    let &[way_m, turns_rad] = rest else {
        return Err(Error::Internal);
    };
    Ok(Some(Driven {
        pose,
        way_m,
        turns_rad,
    }))
}

/// The places of the upper triangle of a symmetric matrix, row by row.
fn upper_triangle<const N: usize>() -> impl Iterator<Item = (usize, usize)> {
    (0..N).flat_map(|row| (row..N).map(move |column| (row, column)))
}

/// The belief of such numbers; none if there are no numbers.
fn belief_of_numbers(numbers: &[f64]) -> Result<Option<Belief>, Error> {
    if numbers.is_empty() {
        return Ok(None);
    }

    let (pose, upper) = pose_of_numbers(numbers)?;
    Ok(Some(Belief {
        pose,
        covariance: symmetric(upper)?,
    }))
}

/// The moving belief of such numbers.
fn moving_of_numbers(numbers: &[f64]) -> Result<MovingBelief, Error> {
    let (pose, rest) = pose_of_numbers(numbers)?;
    let (velocity, upper) = rest.split_at_checked(6).ok_or(Error::Internal)?;
    Ok(MovingBelief {
        pose,
        velocity: Twist::from_vector(&Vector6::from_column_slice(velocity)),
        covariance: symmetric(upper)?,
    })
}

/// The pose of seven numbers, and those after them.
fn pose_of_numbers(numbers: &[f64]) -> Result<(Pose, &[f64]), Error> {
    let &[x, y, z, i, j, k, w, ref rest @ ..] = numbers else {
        return Err(Error::Internal);
    };

    // The quaternion is not normalised again: that could change its last bit, and answers after a
    // resume must equal those without one.
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
    let pose = Pose::from_parts(Translation3::new(x, y, z), rotation);
    Ok((pose, rest))
}

/// The symmetric matrix with this upper triangle.
fn symmetric<const N: usize>(upper: &[f64]) -> Result<SMatrix<f64, N, N>, Error> {
    if upper.len() != N * (N + 1) / 2 {
        return Err(Error::Internal);
    }

    let mut matrix = SMatrix::zeros();
    for ((row, column), value) in upper_triangle::<N>().zip(upper) {
        matrix[(row, column)] = *value;
        matrix[(column, row)] = *value;
    }
    Ok(matrix)
}

fn required(numbers: &[f64]) -> Result<Belief, Error> {
    belief_of_numbers(numbers)?.ok_or(Error::Internal)
}

/// The numbers of a belief; none of an unknown one.
fn numbers(belief: &Option<Belief>) -> Vec<f64> {
    belief.as_ref().map_or_else(Vec::new, belief_to_numbers)
}

impl From<&LastFrame> for SealedLast {
    fn from(last: &LastFrame) -> Self {
        let LastFrame {
            time_ns,
            sequence,
            latent,
            odom,
        } = last;

        Self {
            time_ns: *time_ns,
            sequence: *sequence,
            odom: belief_to_numbers(odom),
            latent: latent.clone(),
        }
    }
}

impl From<&Keyframe> for SealedKeyframe {
    fn from(keyframe: &Keyframe) -> Self {
        let Keyframe {
            time_ns,
            sequence,
            latent,
            odom,
            reported_pose,
        } = keyframe;

        Self {
            sequence: *sequence,
            latent: latent.clone(),
            odom: moving_to_numbers(odom),
            reported_pose: numbers(reported_pose),
            time_ns: *time_ns,
        }
    }
}

impl From<&Place> for SealedPlace {
    fn from(place: &Place) -> Self {
        let Place {
            time_ns,
            latent,
            belief,
            lasting,
        } = place;

        Self {
            time_ns: *time_ns,
            latent: latent.clone(),
            belief: moving_to_numbers(belief),
            lasting: upper_triangle::<6>().map(|at| lasting[at]).collect(),
        }
    }
}

impl From<&Candidate> for SealedCandidate {
    fn from(candidate: &Candidate) -> Self {
        let Candidate {
            room,
            time_ns,
            sequence,
            latent,
            map_pose,
            agreeing_anchors,
        } = candidate;

        Self {
            room: *room as u64,
            map_pose: belief_to_numbers(map_pose),
            agreeing_anchors: *agreeing_anchors,
            sequence: *sequence,
            latent: latent.clone(),
            time_ns: *time_ns,
        }
    }
}

impl From<&State> for SealedState {
    fn from(state: &State) -> Self {
        // Destructured with no `..`, so that a new field breaks the build here.
        let State {
            room,
            last,
            keyframe,
            place,
            initial_pose,
            recent,
            health,
            candidate,
            frames_off_map,
            unchanged_frames,
            corrected_ns,
            measured,
        } = state;

        // Tracking health is stored as a number for its state and the state's counter.
        let (health, health_count) = match *health {
            TrackingHealth::NotStarted => (0, 0),
            TrackingHealth::Consistent { score, confirmed } => (1 + u32::from(confirmed), score),
            TrackingHealth::Lost { certain_matches } => {
                (3, i32::try_from(certain_matches).unwrap_or(i32::MAX))
            }
        };

        Self {
            room: room.map(|room| room as u64),
            last: last.as_ref().map(SealedLast::from),
            keyframe: keyframe.as_ref().map(SealedKeyframe::from),
            place: place.as_ref().map(SealedPlace::from),
            initial_pose: numbers(initial_pose),
            recent: recent.iter().flatten().copied().collect(),
            recent_count: recent.len() as u32,
            health,
            health_count,
            candidate: candidate.as_ref().map(SealedCandidate::from),
            frames_off_map: *frames_off_map,
            corrected_ns: *corrected_ns,
            unchanged_frames: *unchanged_frames,
            measured: SealedMeasured::of(measured),
        }
    }
}

impl SealedMeasured {
    fn of(measured: &MeasuredSince) -> Option<Self> {
        let MeasuredSince {
            last,
            keyframe,
            place,
        } = measured;

        (*measured != MeasuredSince::default()).then(|| Self {
            time_ns: last.map_or(0, |last| last.time_ns),
            last: last.map_or_else(Vec::new, |last| pose_to_numbers(&last.pose)),
            keyframe: driven_to_numbers(keyframe.as_ref()),
            place: driven_to_numbers(place.as_ref()),
        })
    }

    fn opened(self) -> Result<MeasuredSince, Error> {
        let Self {
            time_ns,
            last,
            keyframe,
            place,
        } = self;

        Ok(MeasuredSince {
            last: if last.is_empty() {
                None
            } else {
                Some(LastMeasured {
                    time_ns,
                    pose: pose_of_numbers(&last)?.0,
                })
            },
            keyframe: driven_of_numbers(&keyframe)?,
            place: driven_of_numbers(&place)?,
        })
    }
}

impl SealedState {
    /// The tracker's state.
    ///
    /// # Errors
    /// [`Error::Internal`] if a belief does not have its numbers, or a room's index is too large
    /// for this machine. No token that a server sealed has either.
    pub fn state(self) -> Result<State, Error> {
        let Self {
            room,
            last,
            keyframe,
            place,
            initial_pose,
            recent,
            recent_count,
            health,
            health_count,
            candidate,
            frames_off_map,
            corrected_ns,
            unchanged_frames,
            measured,
        } = self;

        let health = match health {
            0 => TrackingHealth::NotStarted,
            1 | 2 => TrackingHealth::Consistent {
                score: health_count,
                confirmed: health == 2,
            },
            _ => TrackingHealth::Lost {
                certain_matches: health_count.unsigned_abs(),
            },
        };

        // The rows of `recent` all have one width, which follows from their number. Whether it is
        // the adapter's is checked by the session.
        let width = recent.len().checked_div(recent_count as usize).unwrap_or(0);
        let last = last.map(SealedLast::opened).transpose()?;
        let keyframe = keyframe.map(SealedKeyframe::opened).transpose()?;
        let candidate = candidate.map(SealedCandidate::opened).transpose()?;

        Ok(State {
            room: room.map(index).transpose()?,
            last,
            keyframe,
            place: place.map(SealedPlace::opened).transpose()?,
            initial_pose: belief_of_numbers(&initial_pose)?,
            recent: recent.chunks(width.max(1)).map(<[f64]>::to_vec).collect(),
            health,
            candidate,
            frames_off_map,
            unchanged_frames,
            corrected_ns,
            measured: match measured {
                Some(measured) => measured.opened()?,
                None => MeasuredSince::default(),
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn odd_moving(pose: Pose) -> MovingBelief {
        let mut moving = MovingBelief {
            pose,
            velocity: Twist::from_vector(&Vector6::repeat(0.1)),
            covariance: SMatrix::from_diagonal_element(1.0 / 3.0),
        };
        moving.covariance[(0, 11)] = 1.0 / 9.0;
        moving.covariance[(11, 0)] = 1.0 / 9.0;
        moving
    }

    fn odd_measured(pose: Pose) -> MeasuredSince {
        MeasuredSince {
            last: Some(LastMeasured { time_ns: -9, pose }),
            keyframe: Some(Driven {
                pose,
                way_m: 1.0 / 7.0,
                turns_rad: 0.3,
            }),
            place: None,
        }
    }

    /// Oracle: the contract: a sealed state comes back bit by bit.
    #[test]
    fn a_state_comes_back_to_the_bit() {
        let odd = Pose::new(
            nalgebra::Vector3::new(0.1, -2.3, 1e-17),
            nalgebra::Vector3::new(0.3, 1.0 / 3.0, -0.7),
        );

        let belief = Belief::known(odd, 0.1, 0.2).moved(
            seese3_core::geometry::Twist {
                linear: nalgebra::Vector3::new(0.1, 0.2, 0.3),
                angular: nalgebra::Vector3::y() * 0.4,
            },
            &nalgebra::Matrix6::from_diagonal_element(1.0 / 7.0),
        );
        let moving = odd_moving(odd);

        let state = State {
            room: Some(3),
            last: Some(LastFrame {
                time_ns: -5,
                sequence: u64::MAX,
                latent: vec![-1.5; 20],
                odom: belief,
            }),
            keyframe: Some(Keyframe {
                time_ns: -6,
                sequence: 9,
                latent: vec![1.0 / 3.0; 20],
                odom: moving,
                reported_pose: None,
            }),
            place: Some(Place {
                time_ns: 3,
                latent: vec![-0.0; 20],
                belief: moving,
                lasting: SMatrix::from_diagonal_element(1.0 / 11.0),
            }),
            initial_pose: None,
            recent: vec![vec![0.1; 20], vec![-0.0; 20]],
            health: TrackingHealth::Consistent {
                score: -1,
                confirmed: false,
            },
            candidate: Some(Candidate {
                room: 1,
                time_ns: 12,
                sequence: 8,
                latent: vec![0.5; 20],
                map_pose: belief,
                agreeing_anchors: 2,
            }),
            frames_off_map: 7,
            corrected_ns: Some(-7),
            unchanged_frames: 3,
            measured: odd_measured(belief.pose),
        };

        for state in [
            state,
            State::default(),
            State {
                health: TrackingHealth::Lost { certain_matches: 4 },
                ..State::default()
            },
        ] {
            let bytes = SealedState::from(&state).encode_to_vec();
            let back = SealedState::decode(bytes.as_slice())
                .unwrap()
                .state()
                .unwrap();

            assert_eq!(back, state);

            // Equality does not distinguish -0 from 0, but the bytes do.
            assert_eq!(SealedState::from(&back).encode_to_vec(), bytes);
        }
    }
}

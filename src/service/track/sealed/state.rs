//! The whole state of a tracker as a message.

use prost::Message;

use super::super::super::Error;
use super::numbers::{belief_of_numbers, numbers};
use super::parts::{
    SealedCamera, SealedCandidate, SealedKeyframe, SealedLast, SealedMatches, SealedMeasured,
    SealedPlace,
};
use seese3_core::tracking::{MeasuredSince, State, TrackingHealth};

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
    #[prost(message, repeated, tag = "15")]
    other_cameras: Vec<SealedCamera>,
    #[prost(message, optional, tag = "16")]
    recent_matches: Option<SealedMatches>,
    #[prost(int64, optional, tag = "17")]
    seen_ns: Option<i64>,
    #[prost(int64, optional, tag = "18")]
    gravity_ns: Option<i64>,
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
            other_cameras,
            recent_matches,
            seen_ns,
            gravity_ns,
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
            other_cameras: other_cameras.iter().map(SealedCamera::from).collect(),
            recent_matches: recent_matches.as_ref().map(SealedMatches::from),
            seen_ns: *seen_ns,
            gravity_ns: *gravity_ns,
        }
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
            other_cameras,
            recent_matches,
            seen_ns,
            gravity_ns,
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
            room: room
                .map(usize::try_from)
                .transpose()
                .map_err(|_| Error::Internal)?,
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
            recent_matches: recent_matches.map(SealedMatches::opened),
            seen_ns,
            gravity_ns,
            other_cameras: other_cameras
                .into_iter()
                .map(SealedCamera::opened)
                .collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{SMatrix, Vector6};

    use super::*;
    use seese3_core::geometry::{Pose, Twist};
    use seese3_core::tracking::{
        Belief, Candidate, Driven, Keyframe, LastFrame, LastMeasured, MovingBelief, OtherCamera,
        Place, RecentMatches,
    };

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

    /// A state whose numbers are all odd ones.
    fn odd_state() -> State {
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

        State {
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
                latent: Some(vec![-0.0; 20]),
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
                latent: Some(vec![0.5; 20]),
                map_pose: belief,
                agreeing_anchors: 2,
            }),
            frames_off_map: 7,
            corrected_ns: Some(-7),
            unchanged_frames: 3,
            seen_ns: Some(-11),
            gravity_ns: Some(13),
            measured: odd_measured(belief.pose),
            recent_matches: Some(RecentMatches {
                time_ns: -8,
                log_deviation: 1.0 / 3.0,
            }),
            other_cameras: vec![OtherCamera {
                camera: 2,
                last: vec![-0.0, 0.1],
                unchanged_frames: 4,
            }],
        }
    }

    /// Oracle: the contract: a sealed state comes back bit by bit.
    #[test]
    fn a_state_comes_back_to_the_bit() {
        for state in [
            odd_state(),
            State::default(),
            State {
                place: odd_state().place.map(|place| Place {
                    latent: None,
                    ..place
                }),
                ..odd_state()
            },
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

//! Content of a resume token: the stream's configuration and tracker state, encoded with postcard.
//! The encoding is bit-exact.
//!
//! It has no field tags and is not part of the public API. A change of [`Sealed`] or of the
//! tracker's state types needs a new `MAGIC` in `token`.

use std::sync::Arc;

use prost::Message;
use serde::{Deserialize, Serialize};

use super::super::Error;
use super::super::snapshot::{ServedNavigator, frames_content};
use seese3_client::proto::v1 as pb;
use seese3_robot::tracking::State;

/// Content of a token.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct Sealed {
    /// The stream's `TrackConfig`, encoded as protobuf.
    config: Vec<u8>,
    /// Digest of the adapter, `Content::adapter`.
    adapter: Vec<u8>,
    state: State,
    /// The rooms that the state refers to.
    rooms: Vec<SealedRoom>,
}

/// A room that a state refers to.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct SealedRoom {
    /// Index by which the state refers to the room.
    place: usize,
    name: String,
    frame_count: usize,
    /// Digest of the room's first `frame_count` frames, `Content::frames`.
    frames: Vec<u8>,
}

impl SealedRoom {
    /// The rooms of `served` that a state refers to.
    fn named_by(state: &State, served: &[Arc<ServedNavigator>]) -> Vec<Self> {
        let candidate = state.candidate.as_ref().map(|candidate| candidate.room);
        let mut places: Vec<usize> = state.room.into_iter().chain(candidate).collect();
        places.dedup();

        let sealed = |place: usize| {
            let room = served[place].navigator.room();
            Self {
                place,
                name: room.id().to_string(),
                frame_count: room.frame_count(),
                frames: served[place].content.frames.to_vec(),
            }
        };
        places.into_iter().map(sealed).collect()
    }

    /// The index in `served` of a room with the same name that begins with the same frames. The
    /// state's poses and latents are valid there.
    fn place_in(&self, served: &[Arc<ServedNavigator>]) -> Option<usize> {
        let is_this = |served: &Arc<ServedNavigator>| {
            let room = served.navigator.room();
            if room.id().as_str() != self.name || self.frame_count > room.frame_count() {
                return false;
            }

            let frames = if self.frame_count == room.frame_count() {
                served.content.frames
            } else {
                frames_content(&served.navigator, self.frame_count)
            };
            frames.as_slice() == self.frames
        };

        served.iter().position(is_this)
    }
}

impl Sealed {
    /// The content of a token for this configuration and state; `served` are the stream's rooms.
    pub fn new(config: &pb::TrackConfig, state: &State, served: &[Arc<ServedNavigator>]) -> Self {
        Self {
            config: config.encode_to_vec(),
            adapter: served[0].content.adapter.to_vec(),
            state: state.clone(),
            rooms: SealedRoom::named_by(state, served),
        }
    }

    /// The encoded content.
    #[expect(
        clippy::expect_used,
        reason = "postcard fails only on sequences of unknown length, and these are vectors"
    )]
    pub fn to_bytes(&self) -> Vec<u8> {
        postcard::to_allocvec(self).expect("every length is known")
    }

    /// Decodes the content.
    ///
    /// # Errors
    /// [`Error::Internal`] if the bytes cannot be decoded, because their seal was verified before.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Error> {
        postcard::from_bytes(bytes).map_err(|_| Error::Internal)
    }

    /// The stream's configuration.
    ///
    /// # Errors
    /// [`Error::Internal`] if it cannot be decoded.
    pub fn config(&self) -> Result<pb::TrackConfig, Error> {
        pb::TrackConfig::decode(self.config.as_slice()).map_err(|_| Error::Internal)
    }

    /// The state with room indices mapped to `served`; `None` if the adapter or a room differs from
    /// the token's.
    pub fn opened_in(self, served: &[Arc<ServedNavigator>]) -> Option<State> {
        let is_adapter = |served: &Arc<ServedNavigator>| served.content.adapter == *self.adapter;
        if !served.iter().all(is_adapter) {
            return None;
        }

        let place_here = |place: usize| {
            let mut rooms = self.rooms.iter();
            rooms.find(|room| room.place == place)?.place_in(served)
        };
        let mut state = self.state;
        if let Some(room) = &mut state.room {
            *room = place_here(*room)?;
        }
        if let Some(candidate) = &mut state.candidate {
            candidate.room = place_here(candidate.room)?;
        }

        Some(state)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{SMatrix, Vector6};

    use super::*;
    use seese3_core::geometry::{Pose, Twist};
    use seese3_robot::tracking::{
        Candidate, Keyframe, LastFrame, LastMeasured, OdometryAccumulator, OdometryDelta,
        OtherCamera, Place, PoseVelocity, PoseWithCovariance, RecentMatches, TrackingHealth,
    };

    fn odd_moving(pose: Pose) -> PoseVelocity {
        let mut moving = PoseVelocity {
            pose,
            velocity: Twist::from_vector(&Vector6::repeat(0.1)),
            covariance: SMatrix::from_diagonal_element(1.0 / 3.0),
        };
        moving.covariance[(0, 11)] = 1.0 / 9.0;
        moving.covariance[(11, 0)] = 1.0 / 9.0;
        moving
    }

    fn odd_measured(pose: Pose) -> OdometryAccumulator {
        OdometryAccumulator {
            last: Some(LastMeasured { time_ns: -9, pose }),
            keyframe: Some(OdometryDelta {
                pose,
                way_m: 1.0 / 7.0,
                turns_rad: 0.3,
            }),
            place: None,
        }
    }

    /// A state with values that an inexact encoding would change.
    fn odd_state() -> State {
        let odd = Pose::new(
            nalgebra::Vector3::new(0.1, -2.3, 1e-17),
            nalgebra::Vector3::new(0.3, 1.0 / 3.0, -0.7),
        );

        let belief = PoseWithCovariance::known(odd, 0.1, 0.2).moved(
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

    /// Oracle: the contract: encoding and decoding a state is bit-exact.
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
            let sealed = Sealed {
                config: Vec::new(),
                adapter: Vec::new(),
                state,
                rooms: Vec::new(),
            };
            let bytes = sealed.to_bytes();
            let back = Sealed::from_bytes(&bytes).unwrap();
            assert_eq!(back, sealed);

            // Equality does not distinguish -0 from 0, so compare the bytes too.
            assert_eq!(back.to_bytes(), bytes);
        }
    }
}

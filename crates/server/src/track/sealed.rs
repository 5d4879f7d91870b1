//! Content of a resume token: the stream's configuration and tracker state, encoded with postcard.
//! The encoding is bit-exact.
//!
//! It has no field tags and is not part of the public API. A change of [`Sealed`] or of the
//! tracker's state types needs a new `MAGIC` in `token`.

use prost::Message;
use serde::{Deserialize, Serialize};

use super::super::Error;
use super::engine::EngineState;
use super::rooms::TrackedRoom;
use seese3_client::proto::v1 as pb;

/// Content of a token.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct Sealed {
    /// The stream's `TrackConfig`, encoded as protobuf.
    config: Vec<u8>,
    /// Digest of the adapter, `Content::adapter`; empty without one.
    adapter: Vec<u8>,
    state: EngineState,
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
    /// Digest of the room's first `frame_count` frames, [`TrackedRoom::frames_content`].
    frames: Vec<u8>,
}

impl SealedRoom {
    /// The rooms that a state refers to.
    fn named_by(state: &mut EngineState, rooms: &[TrackedRoom]) -> Vec<Self> {
        let mut places: Vec<usize> = state.rooms().map(|place| *place).collect();
        places.dedup();

        let sealed = |place: usize| {
            let tracked = &rooms[place];
            let frame_count = tracked.room.frame_count();
            let frames = tracked.frames_content(frame_count);
            Self {
                place,
                name: tracked.room.id().to_string(),
                frame_count,
                frames: frames.map_or_else(Vec::new, |frames| frames.to_vec()),
            }
        };
        places.into_iter().map(sealed).collect()
    }

    /// The index of a room with the same name that begins with the same frames. The state's poses
    /// and latents are valid there.
    fn place_in(&self, rooms: &[TrackedRoom]) -> Option<usize> {
        let is_this = |tracked: &TrackedRoom| {
            let frames = tracked.frames_content(self.frame_count);
            tracked.room.id().as_str() == self.name
                && frames.is_some_and(|frames| frames.as_slice() == self.frames)
        };
        rooms.iter().position(is_this)
    }
}

impl Sealed {
    /// The content of a token for this configuration and state of a stream.
    pub fn new(config: &pb::TrackConfig, mut state: EngineState, rooms: &[TrackedRoom]) -> Self {
        Self {
            config: config.encode_to_vec(),
            adapter: rooms[0].adapter_content().to_vec(),
            rooms: SealedRoom::named_by(&mut state, rooms),
            state,
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

    /// Whether the stream tracks by keypoints alone.
    pub fn is_of_keypoints(&self) -> bool {
        matches!(self.state, EngineState::Keypoints(_))
    }

    /// The state with its room indices mapped to `rooms`; `None` if the adapter or a room differs
    /// from the token's.
    pub fn opened_in(self, rooms: &[TrackedRoom]) -> Option<EngineState> {
        if rooms
            .iter()
            .any(|room| room.adapter_content() != self.adapter)
        {
            return None;
        }

        let mut state = self.state;
        for place in state.rooms() {
            let mut sealed = self.rooms.iter();
            *place = sealed.find(|room| room.place == *place)?.place_in(rooms)?;
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
        OtherCamera, Place, PoseVelocity, PoseWithCovariance, RecentMatches, State, TrackingHealth,
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
                state: EngineState::Adapter(Box::new(state)),
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

//! Content of a resume token: the stream's configuration and filter state, encoded with postcard.
//! The encoding is bit-exact.
//!
//! It has no field tags and is not part of the public API. A change of [`Sealed`] or of the
//! filter's saved state needs a new `MAGIC` in `token`.

use prost::Message;
use serde::{Deserialize, Serialize};

use super::super::Error;
use super::rooms::TrackedRoom;
use seese3_client::proto::v1 as pb;
use seese3_robot::pose_filter::SavedState;

/// Content of a token.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct Sealed {
    /// The stream's `TrackConfig`, encoded as protobuf.
    config: Vec<u8>,
    /// Digest of the adapter, `Content::adapter`; empty without one.
    adapter: Vec<u8>,
    state: SavedState,
    /// The room that the state refers to.
    room: Option<SealedRoom>,
}

/// A room that a state refers to.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct SealedRoom {
    name: String,
    frame_count: usize,
    /// Digest of the room's first `frame_count` frames, [`TrackedRoom::frames_content`].
    frames: Vec<u8>,
}

impl SealedRoom {
    fn of(tracked: &TrackedRoom) -> Self {
        let frame_count = tracked.room.frame_count();
        let frames = tracked.frames_content(frame_count);
        Self {
            name: tracked.room.id().to_string(),
            frame_count,
            frames: frames.map_or_else(Vec::new, |frames| frames.to_vec()),
        }
    }

    /// The index of a room with the same name that begins with the same frames. The state's poses
    /// are valid there.
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
    pub fn new(config: &pb::TrackConfig, state: SavedState, rooms: &[TrackedRoom]) -> Self {
        Self {
            config: config.encode_to_vec(),
            adapter: rooms[0].adapter_content().to_vec(),
            room: state.room.map(|place| SealedRoom::of(&rooms[place])),
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
        self.adapter.is_empty()
    }

    /// The state with its room as an index of `rooms`; `None` if the adapter or a room differs
    /// from the token's.
    pub fn opened_in(self, rooms: &[TrackedRoom]) -> Option<SavedState> {
        if rooms
            .iter()
            .any(|room| room.adapter_content() != self.adapter)
        {
            return None;
        }

        let mut state = self.state;
        if let Some(place) = &mut state.room {
            *place = self.room?.place_in(rooms)?;
        }
        Some(state)
    }
}

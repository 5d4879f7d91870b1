//! The state of a stream as bytes, for resume tokens. Every number comes back bit by bit.
//!
//! The messages are the tokens' own format and no part of the public API. A change of their layout
//! or meaning needs a new `MAGIC` in `token`. The state is in `state.rs`, what it is made of in
//! `parts.rs`, and poses and covariances as numbers in `numbers.rs`.

mod numbers;
mod parts;
mod state;

use std::sync::Arc;

use prost::Message;

pub use self::state::SealedState;
use super::super::Error;
use super::super::snapshot::{ServedNavigator, frames_content};
use seese3_core::tracking::State;

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

//! What tracks the camera of a stream: the tracker of an adapter, or the filter of located views.

use serde::{Deserialize, Serialize};

use super::rooms::TrackedRoom;
use seese3_core::room::FrameId;
use seese3_robot::pose_filter::{
    FilterParameters, FilterRoom, FilterState, PoseFilter, SavedState,
};
use seese3_robot::tracking::{PoseWithCovariance, State, Tracker};

/// A tracker with the state of its stream.
pub enum Engine {
    /// By latents of an adapter, and by keypoints where a room has some.
    Adapter { tracker: Tracker, state: Box<State> },
    /// By keypoints alone.
    Keypoints {
        filter: PoseFilter,
        state: Box<FilterState>,
    },
}

/// The state of a stream, as a token holds it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum EngineState {
    Adapter(Box<State>),
    Keypoints(Box<SavedState>),
}

impl Engine {
    /// A filter over rooms with keypoints; `None` without a room.
    pub fn of_keypoints(
        rooms: &[TrackedRoom],
        parameters: FilterParameters,
        initial: Option<&PoseWithCovariance>,
    ) -> Option<Self> {
        let room = |tracked: &TrackedRoom| {
            let frame_count = tracked.room.frame_count() as u32;
            let mapped: Vec<FrameId> = (0..frame_count).map(FrameId).collect();
            FilterRoom::of(&tracked.room, &mapped)
        };
        let filter = PoseFilter::new(rooms.iter().map(room).collect(), parameters)?;
        let state = Box::new(filter.start(initial));
        Some(Self::Keypoints { filter, state })
    }

    /// The stream's room, an index of its rooms; `None` while it is unknown.
    pub fn room(&self) -> Option<usize> {
        match self {
            Self::Adapter { state, .. } => state.room,
            Self::Keypoints { state, .. } => state.room,
        }
    }

    /// Sets the pose of the camera at the last frame.
    pub fn set_pose(&mut self, pose: PoseWithCovariance) {
        match self {
            Self::Adapter { tracker, state } => tracker.set_pose(state, pose),
            Self::Keypoints { filter, state } => filter.set_pose(state, &pose),
        }
    }

    /// Forgets everything about the camera.
    pub fn reset(&mut self) {
        match self {
            Self::Adapter { tracker, state } => **state = tracker.start(None),
            Self::Keypoints { filter, state } => **state = filter.start(None),
        }
    }

    /// The part of the state that a token holds.
    pub fn state(&self) -> EngineState {
        match self {
            Self::Adapter { state, .. } => EngineState::Adapter(state.clone()),
            Self::Keypoints { state, .. } => EngineState::Keypoints(Box::new(state.saved())),
        }
    }

    /// Replaces the state. Returns whether it fits this engine and these rooms.
    #[must_use]
    pub fn resume(&mut self, resumed: EngineState, rooms: &[TrackedRoom]) -> bool {
        match (self, resumed) {
            (Self::Adapter { state, .. }, EngineState::Adapter(resumed)) => {
                let fits = fits(&resumed, rooms);
                *state = resumed;
                fits
            }
            (Self::Keypoints { filter, state }, EngineState::Keypoints(resumed)) => {
                let fits = resumed.room.is_none_or(|room| room < rooms.len());
                if fits {
                    **state = filter.resumed(&resumed);
                }
                fits
            }
            _ => false,
        }
    }
}

impl EngineState {
    /// The rooms that the state refers to.
    pub fn rooms(&mut self) -> impl Iterator<Item = &mut usize> {
        let (room, candidate) = match self {
            Self::Adapter(state) => {
                let candidate = state.candidate.as_mut();
                (
                    &mut state.room,
                    candidate.map(|candidate| &mut candidate.room),
                )
            }
            Self::Keypoints(state) => (&mut state.room, None),
        };
        room.iter_mut().chain(candidate)
    }
}

/// Whether the state's latents have this adapter's width and its room indices are valid. The
/// content digests should guarantee this; an invalid state would panic in the tracker.
fn fits(state: &State, rooms: &[TrackedRoom]) -> bool {
    let Some(adapter) = rooms.first().and_then(TrackedRoom::adapter) else {
        return false;
    };
    let adapter = &adapter.adapter;

    let State {
        room,
        last,
        keyframe,
        place,
        recent,
        candidate,
        other_cameras,
        recent_matches: _,
        seen_ns: _,
        gravity_ns: _,
        initial_pose: _,
        health: _,
        frames_off_map: _,
        unchanged_frames: _,
        corrected_ns: _,
        measured: _,
    } = state;

    let latents = [
        last.as_ref().map(|last| &last.latent),
        keyframe.as_ref().map(|keyframe| &keyframe.latent),
        place.as_ref().and_then(|place| place.latent.as_ref()),
        candidate
            .as_ref()
            .and_then(|candidate| candidate.latent.as_ref()),
    ];

    let named = [*room, candidate.as_ref().map(|candidate| candidate.room)];
    latents
        .into_iter()
        .flatten()
        .all(|latent| adapter.check_latent(latent).is_ok())
        && recent
            .iter()
            .chain(other_cameras.iter().map(|other| &other.last))
            .all(|row| row.len() == adapter.coordinate_count())
        && named.into_iter().flatten().all(|room| room < rooms.len())
}

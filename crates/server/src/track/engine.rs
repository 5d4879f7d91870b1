//! The filter of a stream, with the maps in which its views are retrieved.

use std::sync::Arc;

use super::super::Error;
use super::rooms::TrackedRoom;
use seese3_core::room::FrameId;
use seese3_robot::front_end::RetrievalFrontEnd;
use seese3_robot::pose_filter::{
    FilterParameters, FilterRoom, FilterState, PoseFilter, SavedState,
};
use seese3_robot::tracking::{Map, PoseWithCovariance};

/// A filter with the state of its stream.
pub struct Engine {
    pub filter: PoseFilter,
    pub state: Box<FilterState>,
    /// For streams with an adapter.
    pub retrieval: Option<Retrieval>,
}

/// Retrieves the views of a stream, by an adapter.
pub struct Retrieval {
    /// One per room.
    pub maps: Vec<Arc<Map>>,
    pub front_end: RetrievalFrontEnd,
}

impl Engine {
    /// A filter over rooms, with a map of each for streams with an adapter.
    ///
    /// # Errors
    /// [`Error::Internal`] without a room.
    pub fn new(
        rooms: &[TrackedRoom],
        maps: Option<Vec<Arc<Map>>>,
        parameters: FilterParameters,
        initial: Option<&PoseWithCovariance>,
    ) -> Result<Self, Error> {
        let room = |tracked: &TrackedRoom| {
            let frame_count = tracked.room.frame_count() as u32;
            let mapped: Vec<FrameId> = (0..frame_count).map(FrameId).collect();
            FilterRoom::of(&tracked.room, &mapped)
        };
        let filter = PoseFilter::new(rooms.iter().map(room).collect(), parameters);
        let filter = filter.ok_or(Error::Internal)?;
        Ok(Self {
            state: Box::new(filter.start(initial)),
            filter,
            retrieval: maps.map(|maps| Retrieval {
                maps,
                front_end: RetrievalFrontEnd::default(),
            }),
        })
    }

    /// The stream's room, an index of its rooms; `None` while it is unknown.
    pub fn room(&self) -> Option<usize> {
        self.state.room
    }

    /// Sets the pose of the camera at the last frame.
    pub fn set_pose(&mut self, pose: &PoseWithCovariance) {
        self.filter.set_pose(&mut self.state, pose);
    }

    /// Forgets everything about the camera.
    pub fn reset(&mut self) {
        *self.state = self.filter.start(None);
        if let Some(retrieval) = &mut self.retrieval {
            retrieval.front_end.reset();
        }
    }

    /// Replaces the state. Its room is an index of the stream's rooms.
    pub fn resume(&mut self, resumed: &SavedState) {
        *self.state = self.filter.resumed(resumed);
    }
}

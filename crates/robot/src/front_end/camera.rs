//! The camera of a stream, and whether its matches contradict it.

use super::FoundView;
use crate::localization::{FocalSearch, KeypointRoom, NotLocated};
use seese3_core::geometry::CameraIntrinsics;

/// The camera of a stream.
#[derive(Debug, Clone)]
pub enum StreamCamera {
    /// Stated by the client.
    Stated(CameraIntrinsics),
    /// The camera that mapped the room.
    Mapping,
    /// Estimated from the stream's views.
    Unknown(FocalSearch),
}

impl StreamCamera {
    /// A camera to be estimated.
    pub fn unknown() -> Self {
        Self::Unknown(FocalSearch::default())
    }

    /// Forgets an estimated camera.
    pub(super) fn restart(&mut self) {
        if let Self::Unknown(search) = self {
            *search = FocalSearch::default();
        }
    }

    /// The camera in a room; `estimated` is that of the search.
    pub(super) fn in_room(
        &self,
        room: &KeypointRoom,
        estimated: Option<CameraIntrinsics>,
    ) -> Option<CameraIntrinsics> {
        match self {
            Self::Stated(camera) => Some(*camera),
            Self::Mapping => Some(room.map().camera),
            Self::Unknown(_) => estimated,
        }
    }
}

/// Number of contradicted views from which a stated camera is not believed.
const MIN_CONTRADICTED: u32 = 3;

/// How many views of a stream agree with its stated camera.
#[derive(Debug, Clone, Default)]
pub(super) struct CameraVotes {
    located: u32,
    contradicted: u32,
    /// The last contradiction.
    last: Option<NotLocated>,
}

impl CameraVotes {
    /// Counts a match, and withdraws its pose if most views contradict the camera: views far from
    /// the map do not determine their focal length, and would be located at a wrong place.
    pub fn judged(&mut self, found: FoundView) -> FoundView {
        self.located += u32::from(found.located.is_some());
        if let Some(why) = found.why_not.filter(NotLocated::is_of_camera) {
            self.contradicted += 1;
            self.last = Some(why);
        }

        let is_wrong = self.contradicted >= MIN_CONTRADICTED && self.contradicted > self.located;
        if is_wrong && found.located.is_some() {
            return FoundView {
                located: None,
                why_not: self.last,
            };
        }
        found
    }
}

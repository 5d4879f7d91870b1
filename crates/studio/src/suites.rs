//! The suites of synthetic rooms.

use super::film::Film;
use super::render::Camera;
use super::{SuiteRoom, visits};

/// A suite of rooms, with a style of images and of camera motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Suite {
    /// Rooms filmed twice with a hand-held camera in different light. Photographs have blur, noise
    /// and varying exposure; objects move between visits, and people walk by.
    Visits,
    /// Plain images of one calm walk each, which hardly covers what its last fifth sees: the hard
    /// class.
    Walks,
}

impl Suite {
    /// All suites.
    pub const ALL: [Self; 2] = [Self::Visits, Self::Walks];

    /// The name of the suite.
    pub fn name(self) -> &'static str {
        match self {
            Self::Visits => "visits",
            Self::Walks => "walks",
        }
    }

    /// The recording of room `number` of the suite with `seed`. Rooms do not depend on each other.
    pub fn film(self, seed: u64, number: u32, frame_count: usize) -> Film {
        match self {
            Self::Visits => visits::film(seed, number, frame_count),
            Self::Walks => {
                let room = SuiteRoom::new(seed, number);
                let poses = room.path(frame_count);

                Film {
                    kind: room.walk.name(),
                    field_of_view_rad: Camera::small().field_of_view_rad,
                    poses,
                    visits: Vec::new(),
                    scenes: vec![room.scene],
                }
            }
        }
    }
}

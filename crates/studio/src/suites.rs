//! The suites of synthetic rooms.

use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::film::Film;
use super::render::Camera;
use super::{SuiteRoom, visits};

/// A suite of rooms, with a style of images and of camera motion.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, EnumMessage, EnumString, VariantArray, IntoStaticStr,
)]
#[strum(serialize_all = "kebab-case")]
pub enum Suite {
    /// Two handheld visits to each room in different light: photographs with blur, noise and
    /// per-visit exposure.
    ///
    /// Objects move between visits, and people walk by.
    Visits,
    /// One smooth walk per room, plain images: the hard class.
    ///
    /// The walk hardly covers what its last fifth sees.
    Walks,
}

impl Suite {
    /// The recording of room `number` of the suite with `seed`. Rooms do not depend on each other.
    pub fn film(self, seed: u64, number: u32, frame_count: usize) -> Film {
        match self {
            Self::Visits => visits::film(seed, number, frame_count),
            Self::Walks => {
                let room = SuiteRoom::new(seed, number);
                let poses = room.path(frame_count);

                Film {
                    kind: room.walk.into(),
                    field_of_view_rad: Camera::small().field_of_view_rad,
                    poses,
                    visits: Vec::new(),
                    scenes: vec![room.scene],
                }
            }
        }
    }
}

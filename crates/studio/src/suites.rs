//! The suites of synthetic rooms.

use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::SuiteRoom;
use super::film::Film;
use super::render::Camera;
use super::visits::{self, SecondVisit};

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
    /// The suite `visits`, but the second visit follows the path of the first for the most part.
    ///
    /// It goes at other speeds, in stretches forward and backward, up to 0.3 m beside the path, and
    /// looks elsewhere at times: about half of its views have a view of the first visit within
    /// 0.25 m and 15°.
    Returns,
    /// The suite `returns`, but both visits are filmed in slow sweeps that flow into each other, as
    /// for a 3D scan.
    ///
    /// The camera keeps its velocity for about a second, as in the kitchen of 7-Scenes.
    Scans,
    /// One smooth walk per room, plain images: the hard class.
    ///
    /// The walk hardly covers what its last fifth sees.
    Walks,
}

impl Suite {
    /// The recording of room `number` of the suite with `seed`. Rooms do not depend on each other.
    pub fn film(self, seed: u64, number: u32, frame_count: usize) -> Film {
        match self {
            Self::Visits => visits::film(seed, number, frame_count, SecondVisit::Independent),
            Self::Returns => visits::film(seed, number, frame_count, SecondVisit::Returning),
            Self::Scans => visits::film(seed, number, frame_count, SecondVisit::Sweeping),
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

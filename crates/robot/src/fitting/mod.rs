//! An adapter fitted to the one room that it serves, and single views located in that room.
//!
//! An adapter that learned from other rooms reads motions in a new one badly. [`fit`] trains one on
//! the mapped frames of the room itself. Near a mapped frame it reads better than anything else;
//! where nothing near is mapped it can be worse than no reading at all. So it is measured: networks
//! that were fitted without some of the mapped frames locate those, and [`ReadingRules`] keep, by
//! the distance of a view from the map, which reader to believe and how far. A [`Localizer`]
//! answers by these rules.
//!
//! Distances are those of features, z-scored by the mapped frames, so that all readers start from
//! the same mapped frame.

mod fit;
mod folds;
mod localizer;
mod pairs;
mod hypotheses;
mod room_reader;
mod rules;

pub use fit::{FEWEST_MAPPED_FRAMES, FITTED_PRESET, FITTING_EPOCHS, Fitted, fit};
pub use hypotheses::{MotionHypotheses, MotionReader, PartRule};
pub use localizer::{Localizer, LocatedView};
pub use room_reader::RoomReader;
pub use rules::{ReadingRule, ReadingRules};

use seese3_core::room::{FrameId, Room};
use seese3_core::{adapter, training};

/// Why an adapter cannot be fitted to a room, or a view cannot be located in it.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// Too few frames to fit on and to measure errors with.
    #[error("{given} mapped frames are too few to fit an adapter to; at least {least} are needed")]
    FewFrames {
        /// The fewest that suffice.
        least: usize,
        /// How many were given.
        given: usize,
    },
    /// A row that the room does not have, or one that is named twice.
    #[error("the mapped frames must be rows of the room in rising order")]
    MappedFrames,
    /// No view can be told from another.
    #[error("the features of the mapped frames are all alike: no view can be told from another")]
    AllAlike,
    /// The rules were stored in a form that makes no sense.
    #[error("the rules of a fitted adapter are not sound: {what}")]
    Rules {
        /// What is wrong.
        what: &'static str,
    },
    /// The room and its features do not fit together.
    #[error(transparent)]
    Training(#[from] training::Error),
    /// An adapter refused its input, or training failed.
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
}

/// Refuses mapped frames that are too few, unknown, or not in rising order.
fn check_mapped(room: &Room, mapped: &[FrameId], least: usize) -> Result<(), Error> {
    if mapped.len() < least {
        return Err(Error::FewFrames {
            least,
            given: mapped.len(),
        });
    }

    let is_known = mapped
        .last()
        .is_some_and(|last| last.row() < room.frame_count());
    if !is_known || !mapped.is_sorted_by(|a, b| a < b) {
        return Err(Error::MappedFrames);
    }

    Ok(())
}

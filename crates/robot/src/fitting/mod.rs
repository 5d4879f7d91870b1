//! Fits an adapter to one mapped room and localizes single views in that room.
//!
//! The mapped frames are the frames of the room that form its map; `seese3 fit` uses all frames.
//!
//! An adapter trained on other rooms estimates motions in a new room poorly. [`fit`] trains one on
//! the mapped frames of the room itself. Near the map the fitted adapter is usually the best
//! estimator; far from it, the pose of the nearest mapped frame can be better. The fit is therefore
//! cross-validated: four more models, each trained without a part of the mapped frames, localize
//! that part. [`ReadingRules`] hold the result for each range of distances from the map: an
//! estimator and its gain (a factor from 0 to 1) for the translation, the same for the rotation,
//! and a covariance. A [`Localizer`] applies these rules.
//!
//! Distances are between features, z-scored over the mapped frames, so that all estimators start
//! from the same mapped frame.

mod fit;
mod folds;
mod localizer;
mod pairs;
mod hypotheses;
mod room_reader;
mod rules;

pub use fit::{FEWEST_MAPPED_FRAMES, FITTED_PRESET, FITTING_EPOCHS, FitRun, Fitted, fit};
pub use hypotheses::{MotionHypotheses, MotionReader, PartRule};
pub use localizer::{Localizer, LocatedView};
pub use room_reader::RoomReader;
pub use rules::{ExpectedError, ReadingRule, ReadingRules};

use seese3_core::room::{FrameId, Room};
use seese3_core::{adapter, training};

/// Why an adapter cannot be fitted to a room, or a view cannot be localized.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// Too few mapped frames.
    #[error("{given} mapped frames are too few to fit an adapter to; at least {least} are needed")]
    FewFrames {
        /// Minimum number of mapped frames.
        least: usize,
        /// Number of given frames.
        given: usize,
    },
    /// Mapped frames that do not exist, repeat, or are not in ascending order.
    #[error("the mapped frames must be rows of the room in ascending order, without repeats")]
    MappedFrames,
    /// All mapped frames have the same features.
    #[error("the features of the mapped frames are identical: views cannot be distinguished")]
    AllAlike,
    /// Stored reading rules that are invalid.
    #[error("invalid reading rules of a fitted adapter: {what}")]
    Rules {
        /// What is invalid.
        what: &'static str,
    },
    /// The room and its features do not fit together.
    #[error(transparent)]
    Training(#[from] training::Error),
    /// An adapter rejected its input, or training failed.
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
}

/// Rejects mapped frames that are too few, do not exist, or are not in ascending order.
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

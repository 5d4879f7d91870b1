//! Calibration: how large an adapter's errors are in rooms that it did not learn from.
//!
//! [`calibrate`] measures, in this order; the last step needs the one before it:
//!
//! 1. the second moment of the errors of motions (`error_covariance`), which
//!    calibrated retrieval weighs motions with;
//! 2. the error model of a tracker: the noise of latents from frame to frame, the errors of motions
//!    and of poses read from matching frames, and how far frames of other rooms are (`model`);
//! 3. the factor of corrected map poses, found by replaying the rooms through a tracker with the
//!    error model so far (`map_pose_factor`).
//!
//! Errors are heavy-tailed and differ from room to room. The covariances of the error model are
//! therefore fitted by Student's t, and each is then scaled so that the shares of errors inside its
//! ellipsoids are as near as possible to 68 % and 95 %. The covariance of step 1 is a plain second
//! moment.

mod anchors;
mod embedded_room;
mod error_covariance;
mod limits;
mod map_pose_factor;
mod model;
mod motions;

use std::sync::Arc;

use nalgebra::{Matrix6, Vector6};

use error_covariance::error_covariance;
use map_pose_factor::map_pose_factor;

use crate::tracking;
use seese3_core::adapter::{self, Adapter, ErrorModel, ErrorStatistics, TrainingRecord};
use seese3_core::room::RoomId;
use seese3_core::training::{self, RoomData, check_rooms};
use seese3_core::{navigation, statistics};

/// The fewest rooms that a tracker's error model can be measured in: frames of one room have to be
/// compared with those of another.
pub const FEWEST_ROOMS_TO_TRACK: usize = 2;

/// Why an adapter cannot be calibrated.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// The rooms or their features do not fit together.
    #[error(transparent)]
    Rooms(#[from] training::Error),
    /// The adapter refused the features, or the errors make no sound model.
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    /// A room could not be navigated in.
    #[error(transparent)]
    Navigation(#[from] navigation::Error),
    /// A room could not be tracked in.
    #[error(transparent)]
    Tracking(#[from] tracking::Error),
    /// The adapter learned from one of the rooms.
    #[error(
        "room '{room}' was learned from: errors there are not those in rooms never seen; name others"
    )]
    LearnedFrom {
        /// The room.
        room: RoomId,
    },
    /// Too few rooms for what was asked.
    #[error("{given} rooms are too few to measure in; at least {least} are needed")]
    FewRooms {
        /// The fewest that suffice.
        least: usize,
        /// How many were given.
        given: usize,
    },
    /// No replay found a place.
    #[error("no place was found in the rooms to calibrate on")]
    NoPlaceFound,
}

/// A calibrated adapter with its finished record.
#[derive(Debug, Clone)]
pub struct Calibrated {
    /// The adapter with its measured errors.
    pub adapter: Adapter,
    /// The training record; `calibrated_on` names the calibration rooms, which leak detection reads.
    pub record: TrainingRecord,
    /// Whether the adapter can track cameras now; one room is too few.
    pub can_track: bool,
}

/// Calibrates an adapter for retrieval and, with two or more rooms, for tracking. `record` is the
/// record of its training.
///
/// # Errors
/// [`Error`], when the adapter was trained on one of the rooms, a room is too short, or its features
/// are not the adapter's.
pub fn calibrate(
    adapter: Adapter,
    record: TrainingRecord,
    rooms: &[RoomData<'_>],
) -> Result<Calibrated, Error> {
    let mut calibrated = calibrate_retrieval(adapter, record, rooms)?;
    if rooms.len() < FEWEST_ROOMS_TO_TRACK {
        return Ok(calibrated);
    }

    let statistics = model::measure(&calibrated.adapter, &calibrated.record, rooms)?;
    let preliminary = ErrorModel::new(statistics.clone())?;
    let adapter = Arc::new(calibrated.adapter.with_error_model(preliminary)?);

    // The factor of map poses is measured with the tracker that the error model makes.
    let statistics = ErrorStatistics {
        map_pose_factor: map_pose_factor(&adapter, rooms)?.ok_or(Error::NoPlaceFound)?,
        ..statistics
    };
    let model = ErrorModel::new(statistics)?;
    calibrated.adapter = Arc::unwrap_or_clone(adapter).with_error_model(model)?;
    calibrated.can_track = true;
    Ok(calibrated)
}

/// Calibrates an adapter for retrieval alone: measures the second moment of its motions' errors.
///
/// # Errors
/// As [`calibrate`].
pub fn calibrate_retrieval(
    adapter: Adapter,
    mut record: TrainingRecord,
    rooms: &[RoomData<'_>],
) -> Result<Calibrated, Error> {
    check_rooms(rooms)?;
    for data in rooms {
        check_unseen(data, record.rooms.iter().map(|(room, _)| room))?;
        adapter.check_source(data.features.source())?;
    }

    let covariance = error_covariance(&adapter, &record, rooms)?;
    record.calibrated_on = rooms
        .iter()
        .map(|data| (data.room.id().clone(), data.revision))
        .collect();

    Ok(Calibrated {
        adapter: adapter.with_error_covariance(covariance)?,
        record,
        can_track: false,
    })
}

/// The covariance of errors, see [`statistics::robust_covariance`].
///
/// # Errors
/// [`adapter::Error::ErrorModel`] when the errors do not span six dimensions.
pub fn robust_covariance(residuals: &[Vector6<f64>]) -> Result<Matrix6<f64>, adapter::Error> {
    statistics::robust_covariance(residuals).ok_or(adapter::Error::ErrorModel {
        what: "the covariance of errors",
    })
}

/// Refuses a room that an adapter learned from: its errors there are too small.
///
/// # Errors
/// [`Error::LearnedFrom`].
pub fn check_unseen<'a>(
    data: &RoomData<'_>,
    learned_from: impl IntoIterator<Item = &'a RoomId>,
) -> Result<(), Error> {
    if learned_from.into_iter().any(|room| room == data.room.id()) {
        return Err(Error::LearnedFrom {
            room: data.room.id().clone(),
        });
    }

    Ok(())
}

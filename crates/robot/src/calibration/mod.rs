//! Calibration: measures an adapter's errors in rooms that it was not trained on.
//!
//! [`calibrate`] runs two steps:
//!
//! 1. `error_covariance`: the second moment of motion errors, used by calibrated retrieval.
//!    A relational reader also gets its error scale (`relational_errors`).
//! 2. `model`: the error model of a map: frame-to-frame noise of latents; errors of poses estimated
//!    from the most similar map frames; and how far frames of one room are from the map of another.
//!
//! Errors are heavy-tailed and differ between rooms. The covariances of pose errors in the error
//! model are therefore Student's t fits. Each is then scaled so that its 68 % and 95 %
//! ellipsoids contain nearly 68 % and 95 % of the errors. The covariances of step 1 and of latents
//! are plain second moments.

mod embedded_room;
mod error_covariance;
mod frame_noise;
mod limits;
mod match_errors;
mod model;
mod relational_errors;

use nalgebra::{Matrix6, Vector6};

use error_covariance::error_covariance;

use seese3_core::adapter::{self, Adapter, ErrorModel, RelationalReader, TrainingRecord};
use seese3_core::room::RoomId;
use seese3_core::statistics;
use seese3_core::training::{self, RoomData, check_rooms};

/// Minimum number of rooms for a tracker's error model: it compares frames of different rooms.
pub const FEWEST_ROOMS_TO_TRACK: usize = 2;

/// Why an adapter cannot be calibrated.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum Error {
    /// The rooms or their features do not fit together.
    #[error(transparent)]
    Rooms(#[from] training::Error),
    /// The adapter rejected the features, or the errors give no valid error model.
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    /// The adapter was trained on one of the rooms.
    #[error(
        "the adapter was trained on room '{room}': its errors there are too small; name other rooms"
    )]
    LearnedFrom {
        /// The room.
        room: RoomId,
    },
    /// Too few rooms for an error model.
    #[error("{given} rooms are too few for an error model; at least {least} are needed")]
    FewRooms {
        /// Minimum number of rooms.
        least: usize,
        /// Number of given rooms.
        given: usize,
    },
}

/// A calibrated adapter with its finished record.
#[derive(Debug, Clone)]
pub struct Calibrated {
    /// The adapter with its measured errors.
    pub adapter: Adapter,
    /// The training record; `calibrated_on` names the calibration rooms, which leak detection
    /// reads.
    pub record: TrainingRecord,
    /// Whether the adapter can track cameras now; one room is too few.
    pub can_track: bool,
}

/// Calibrates an adapter for retrieval and, with two or more rooms, for tracking. `record` is the
/// record of its training.
///
/// # Errors
/// [`Error`], when the adapter was trained on one of the rooms, a room is too short, or its
/// features are not the adapter's.
pub fn calibrate(
    adapter: Adapter,
    record: TrainingRecord,
    rooms: &[RoomData<'_>],
) -> Result<Calibrated, Error> {
    let mut calibrated = calibrate_retrieval(adapter, record, rooms)?;
    if rooms.len() < FEWEST_ROOMS_TO_TRACK {
        return Ok(calibrated);
    }

    let statistics = model::measure(&calibrated.adapter, rooms)?;
    let model = ErrorModel::new(statistics)?;
    calibrated.adapter = calibrated.adapter.with_error_model(model)?;
    calibrated.can_track = true;
    Ok(calibrated)
}

/// Calibrates an adapter for retrieval only: measures the second moment of its motion errors.
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
    let adapter = match adapter.relational() {
        Some(reader) => {
            let factors = relational_errors::error_scale(reader, rooms)?;
            let reader = RelationalReader::clone(reader).with_error_scale(factors)?;
            adapter.with_relational(reader)?
        }
        None => adapter,
    };
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

/// Robust covariance of errors; see [`statistics::robust_covariance`].
///
/// # Errors
/// [`adapter::Error::ErrorModel`] if the errors do not span six dimensions.
pub fn robust_covariance(residuals: &[Vector6<f64>]) -> Result<Matrix6<f64>, adapter::Error> {
    statistics::robust_covariance(residuals).ok_or(adapter::Error::ErrorModel {
        what: "the covariance of errors",
    })
}

/// Rejects a room that the adapter was trained on, because its errors there are too small.
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

//! Noise of latents from frame to frame.

use ndarray::{Array2, Axis};

use super::Error;
use super::embedded_room::EmbeddedRoom;
use seese3_core::adapter;
use seese3_core::splits::Pair;

/// A pair of frames of one calibration room.
#[derive(Debug, Clone, Copy)]
pub struct RoomPair {
    /// Index into the calibration rooms.
    pub room: usize,
    /// The two frames.
    pub pair: Pair,
}

/// Second moment of the latent differences d of the pairs, mean d dᵀ, shape (c, c).
///
/// # Errors
/// [`adapter::Error::NoPairs`] unless there are more pairs than columns.
pub fn second_moment(rooms: &[EmbeddedRoom<'_>], pairs: &[RoomPair]) -> Result<Array2<f64>, Error> {
    let size = rooms[0].coordinates.ncols();
    if pairs.len() <= size {
        return Err(adapter::Error::NoPairs.into());
    }

    let mut differences = Array2::zeros((pairs.len(), size));
    for (at, mut row) in pairs.iter().zip(differences.axis_iter_mut(Axis(0))) {
        let coordinates = &rooms[at.room].coordinates;
        let target = coordinates.row(at.pair.target.row());
        let source = coordinates.row(at.pair.source.row());
        row.assign(&(&target - &source));
    }

    let moment = differences.t().dot(&differences) / pairs.len() as f64;
    // Rounding may leave the product asymmetric in its last bits.
    Ok((&moment + &moment.t()) * 0.5)
}

//! The statistics of an error model.

use ndarray::{Array2, s};

use super::embedded_room::EmbeddedRoom;
use super::frame_noise::{RoomPair, second_moment};
use super::limits::match_limits;
use super::match_errors::match_errors;
use super::{Error, FEWEST_ROOMS_TO_TRACK};
use crate::tracking::frame_period_s;
use seese3_core::adapter::{Adapter, ErrorStatistics, Whitener};
use seese3_core::splits::Split;
use seese3_core::statistics::mean;
use seese3_core::training::RoomData;

/// Measures an adapter's errors in two or more rooms.
///
/// # Errors
/// [`Error::FewRooms`], or [`Error::Adapter`] if the rooms are too short or their errors give no
/// valid covariance.
pub fn measure(adapter: &Adapter, rooms: &[RoomData<'_>]) -> Result<ErrorStatistics, Error> {
    if rooms.len() < FEWEST_ROOMS_TO_TRACK {
        return Err(Error::FewRooms {
            least: FEWEST_ROOMS_TO_TRACK,
            given: rooms.len(),
        });
    }

    let embedded = embed(adapter, rooms)?;

    // The difference of two successive latents has twice the noise of one latent.
    let frame_noise = second_moment(&embedded, &pairs_at(rooms, 1))? * 0.5;
    // Match distances are in standard deviations of frame noise.
    let noise_whitener = Whitener::new(frame_noise.view())?;
    let whitened: Vec<Array2<f64>> = embedded
        .iter()
        .map(|room| noise_whitener.whitened(room.coordinates.view()))
        .collect();
    let match_errors = match_errors(&embedded, &whitened)?;
    let limits = match_limits(&whitened)?;

    let periods: Vec<f64> = rooms.iter().map(|data| frame_period_s(data.room)).collect();

    Ok(ErrorStatistics {
        frame_period_s: mean(&periods),
        frame_noise,
        match_errors,
        out_of_distribution_ratio: limits.out_of_distribution,
        certain_match_ratio: limits.certain,
    })
}

fn embed<'a>(adapter: &Adapter, rooms: &'a [RoomData<'_>]) -> Result<Vec<EmbeddedRoom<'a>>, Error> {
    let mut embedded = Vec::with_capacity(rooms.len());
    for data in rooms {
        let latents = adapter.embed(data.features.rows())?;
        let coordinates = latents
            .slice(s![.., ..adapter.coordinate_count()])
            .to_owned();
        embedded.push(EmbeddedRoom {
            poses: data.room.poses(),
            coordinates,
        });
    }

    Ok(embedded)
}

/// All pairs of all rooms at one stride; a room that is too short contributes none.
fn pairs_at(rooms: &[RoomData<'_>], stride: u32) -> Vec<RoomPair> {
    let mut all = Vec::new();
    for (room, data) in rooms.iter().enumerate() {
        let pairs = Split::Whole
            .train_pairs(data.room.timeline(), stride)
            .unwrap_or_default();
        all.extend(pairs.into_iter().map(|pair| RoomPair { room, pair }));
    }

    all
}

//! Which of several rooms a camera is in, and where, from what it sees and nothing else.

use std::sync::Arc;

use ndarray::Array1;

use super::{Error, Map, Sighting};
use crate::cancel::Cancellation;

/// The nearest frame of the best room must be this much nearer than that of any other.
pub const ROOM_RATIO: f64 = 0.9;

/// Rooms by how much a camera's views look like them.
#[derive(Debug, Clone, PartialEq)]
pub struct Relocalized {
    /// The best first.
    pub rooms: Vec<RoomMatch>,
    /// The second room's distance over the best one's; infinite with one room.
    pub margin: f64,
    /// Whether the best room is not to be relied on: another looks nearly as near, or none looks
    /// near.
    pub ambiguous: bool,
    /// Why, in words, if it is.
    pub reason: String,
}

/// How much views look like a room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomMatch {
    /// Which of the maps.
    pub map: usize,
    /// Mean distance of the views from their nearest frames, in deviations of flicker.
    pub distance: f64,
    /// Mean of that over the room's limit: above 1 it looks like another place.
    pub out_of_distribution: f64,
    /// What the last view looks like.
    pub last: Sighting,
}

/// Ranks rooms by views of one camera that hardly moved, the newest last; at least one. Changes
/// nothing.
///
/// # Errors
/// [`Error::NoMap`], [`Error::NoView`], [`Error::Adapters`], [`Error::Cancelled`].
pub fn relocalize(
    maps: &[Arc<Map>],
    latents: &[Array1<f64>],
    hit_count: usize,
    cancel: &Cancellation,
) -> Result<Relocalized, Error> {
    let first = maps.first().ok_or(Error::NoMap)?;
    let last = latents.last().ok_or(Error::NoView)?;

    if maps
        .iter()
        .any(|map| !Arc::ptr_eq(map.navigator().adapter(), first.navigator().adapter()))
    {
        return Err(Error::Adapters);
    }

    let mut rooms = Vec::with_capacity(maps.len());
    for (place, map) in maps.iter().enumerate() {
        cancel.check().map_err(|_| Error::Cancelled)?;
        let newest = map.sighting(last.view(), hit_count);
        let mut distance = newest.nearest[0].distance;
        let mut foreign = newest.out_of_distribution;

        for latent in &latents[..latents.len() - 1] {
            cancel.check().map_err(|_| Error::Cancelled)?;
            let sighting = map.sighting(latent.view(), 1);
            distance += sighting.nearest[0].distance;
            foreign += sighting.out_of_distribution;
        }

        let count = latents.len() as f64;
        let distance = distance / count;
        let out_of_distribution = foreign / count;

        rooms.push(RoomMatch {
            map: place,
            distance,
            out_of_distribution,
            last: newest,
        });
    }

    rooms.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.map.cmp(&b.map)));
    let margin = rooms
        .get(1)
        .map_or(f64::INFINITY, |second| second.distance / rooms[0].distance);
    let alike = margin.recip() > ROOM_RATIO || margin.is_nan();

    let far = rooms[0].out_of_distribution > 1.0;
    let reason = match (far, alike) {
        (true, _) => format!(
            "the best room is {:.2} times as far as its limit",
            rooms[0].out_of_distribution
        ),
        (false, true) => format!("the second room is only {margin:.2} times as far as the best"),
        (false, false) => String::new(),
    };

    Ok(Relocalized {
        rooms,
        margin,
        ambiguous: alike || far,
        reason,
    })
}

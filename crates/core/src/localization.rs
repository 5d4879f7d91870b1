//! Place recognition: the frames nearest to a view, in one or several rooms, by latent distance.
//!
//! Latent distances are comparable only under one adapter, so all rooms of a query must use the
//! same adapter.

use ndarray::ArrayView1;

use crate::cancel::{Cancellation, Cancelled};
use crate::navigation::{Navigator, RetrievedFrame};
use crate::room::RoomId;

/// A retrieved frame and its room.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// The room.
    pub room: RoomId,
    /// The frame, its distance and its pose, `world_from_camera` in that room's world.
    pub frame: RetrievedFrame,
}

/// The `k` nearest frames of all `rooms`, ordered by distance, then room, then frame.
///
/// # Errors
/// [`Cancelled`] when the request was cancelled; checked before each room.
pub fn localize<'a>(
    rooms: impl IntoIterator<Item = &'a Navigator>,
    latent: ArrayView1<'_, f64>,
    k: usize,
    cancel: &Cancellation,
) -> Result<Vec<Place>, Cancelled> {
    let mut places: Vec<Place> = Vec::new();
    for navigator in rooms {
        cancel.check()?;
        let room = navigator.room().id();
        // Most of many rooms have no frame that is near enough: they need no sorting.
        let mut found = navigator.nearest(latent, k);
        if let Some(worst) = places.get(k.saturating_sub(1)) {
            let limit = worst.frame.neighbor.distance;
            found.retain(|frame| frame.neighbor.distance <= limit);
        }
        if found.is_empty() {
            continue;
        }
        places.extend(found.into_iter().map(|frame| Place {
            room: room.clone(),
            frame,
        }));

        // Sort and truncate after every room, so that the list has at most 2k frames.
        places.sort_by(|a, b| {
            let distance = a
                .frame
                .neighbor
                .distance
                .total_cmp(&b.frame.neighbor.distance);
            distance
                .then_with(|| a.room.cmp(&b.room))
                .then(a.frame.neighbor.frame.cmp(&b.frame.neighbor.frame))
        });

        places.truncate(k);
    }

    Ok(places)
}

//! Place recognition: the frames nearest to a view, in one or several rooms, by latent distance.
//!
//! Latent distances are comparable only under one adapter, so all rooms of a query must use the
//! same adapter. [`localize_jointly`] gives the answers of [`localize`] from one index of all
//! rooms.

use std::sync::Arc;

use ndarray::{ArrayView1, s};

use crate::cancel::{Cancellation, Cancelled};
use crate::index::{JointIndex, PartNeighbor};
use crate::navigation::{Navigator, RetrievedFrame};

/// A retrieved frame and its room.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Position of the room among those that are searched.
    pub room: usize,
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
    let rooms: Vec<&Navigator> = rooms.into_iter().collect();
    let id = |place: &Place| rooms[place.room].room().id();
    for (room, navigator) in rooms.iter().enumerate() {
        cancel.check()?;
        // Most of many rooms have no frame that is near enough: they need no sorting.
        let mut found = navigator.nearest(latent, k);
        if let Some(worst) = places.get(k.saturating_sub(1)) {
            let limit = worst.frame.neighbor.distance;
            found.retain(|frame| frame.neighbor.distance <= limit);
        }
        if found.is_empty() {
            continue;
        }
        places.extend(found.into_iter().map(|frame| Place { room, frame }));

        // Sort and truncate after every room, so that the list has at most 2k frames.
        places.sort_by(|a, b| {
            let distance = a
                .frame
                .neighbor
                .distance
                .total_cmp(&b.frame.neighbor.distance);
            distance
                .then_with(|| id(a).cmp(id(b)))
                .then(a.frame.neighbor.frame.cmp(&b.frame.neighbor.frame))
        });

        places.truncate(k);
    }

    Ok(places)
}

/// The index of the latents of `rooms` for [`localize_jointly`]; `None` if there are none or too
/// many, or if they have different adapters.
pub fn joint_index<'a>(rooms: impl IntoIterator<Item = &'a Navigator>) -> Option<JointIndex> {
    let rooms: Vec<&Navigator> = rooms.into_iter().collect();
    let adapter = rooms.first()?.adapter();
    if rooms
        .iter()
        .any(|room| !Arc::ptr_eq(room.adapter(), adapter))
    {
        return None;
    }
    let coordinates = s![.., ..adapter.coordinate_count()];
    let latents = rooms
        .iter()
        .map(|room| room.latents().slice_move(coordinates));
    JointIndex::of(&latents.collect::<Vec<_>>())
}

/// Same result as [`localize`], searched in the joint index of the rooms in the order of their
/// names; `k` is at least 1. `navigator` is the room at a position.
pub fn localize_jointly<'a>(
    index: &JointIndex,
    navigator: impl Fn(usize) -> &'a Navigator,
    latent: ArrayView1<'_, f64>,
    k: usize,
) -> Vec<Place> {
    let latent = latent.slice(s![..index.width()]);
    let nearest = index.nearest(&latent.to_vec(), k);
    let place = |found: PartNeighbor| Place {
        room: found.part,
        frame: RetrievedFrame {
            neighbor: found.neighbor,
            pose: navigator(found.part).room().poses()[found.neighbor.frame.row()],
        },
    };
    nearest.into_iter().map(place).collect()
}

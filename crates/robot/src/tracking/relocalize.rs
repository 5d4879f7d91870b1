//! Relocalization: finds the room and the pose of a camera from its views alone.

use std::sync::Arc;

use super::{Error, Map, MapMatch, MapQuery};
use seese3_core::cancel::Cancellation;
use seese3_core::index::{JointIndex, PartNeighbor};

/// Ratio test between rooms: the distance to the best room must be at most this fraction of the
/// distance to the second.
pub const ROOM_RATIO: f64 = 0.9;

/// Rooms ranked by how well a camera's views match them.
#[derive(Debug, Clone, PartialEq)]
pub struct Relocalization {
    /// The ranked rooms, best match first: all, or the best of a joint search.
    pub rooms: Vec<RoomMatch>,
    /// Match of the newest view with the best room.
    pub best: MapMatch,
    /// Distance to the second room divided by the distance to the best; infinite with one room.
    pub margin: f64,
    /// Whether the best room must not be used: it is out of distribution, another room matches
    /// nearly as well, or the pose is too uncertain.
    pub ambiguous: bool,
    /// Reason of the ambiguity, as text; empty if there is none.
    pub reason: String,
}

/// Match of the views with one room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomMatch {
    /// Index into the maps.
    pub map: usize,
    /// Mean distance of the views from their nearest frames, in standard deviations of frame noise.
    pub distance: f64,
    /// Mean of the views' distances divided by the room's limit: above 1 they are out of
    /// distribution.
    pub out_of_distribution: f64,
}

/// Ranks rooms by one or more views, newest last; the camera must hardly move between them. In each
/// room only the nearest latent of each view is searched; the best room is matched in full.
///
/// # Errors
/// [`Error::NoMap`] without a map, [`Error::NoView`] without a view, [`Error::Adapters`] if the
/// maps have different adapters, [`Error::Cancelled`] once `cancel` is set.
pub fn relocalize<M: AsRef<Map>>(
    maps: &[M],
    views: &[MapQuery<'_>],
    cancel: &Cancellation,
) -> Result<Relocalization, Error> {
    let first = maps.first().ok_or(Error::NoMap)?.as_ref();
    let newest = views.last().ok_or(Error::NoView)?;
    check_adapters(maps)?;

    // One adapter whitens alike in all rooms.
    let whitened: Vec<Vec<f64>> = views
        .iter()
        .map(|view| first.whitened(view.latent))
        .collect();

    let mut rooms = Vec::with_capacity(maps.len());
    for (place, map) in maps.iter().enumerate() {
        cancel.check().map_err(|_| Error::Cancelled)?;
        let map = map.as_ref();
        let distances = whitened.iter().map(|view| map.distance(view));
        let distance = distances.sum::<f64>() / views.len() as f64;
        rooms.push(RoomMatch {
            map: place,
            distance,
            out_of_distribution: map.out_of_distribution(distance),
        });
    }

    rooms.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.map.cmp(&b.map)));

    let matched = maps[rooms[0].map].as_ref().match_view(*newest, 1);
    Ok(judged(rooms, matched))
}

/// The index of the whitened latents of `maps` for [`relocalize_jointly`]; `None` if there are
/// none, or too many.
///
/// # Errors
/// [`Error::Adapters`] if the maps have different adapters.
pub fn joint_map_index<M: AsRef<Map>>(maps: &[M]) -> Result<Option<JointIndex>, Error> {
    check_adapters(maps)?;
    let latents: Vec<_> = maps
        .iter()
        .map(|map| map.as_ref().whitened_latents())
        .collect();
    let latents: Vec<_> = latents.iter().map(|latents| latents.view()).collect();
    Ok(JointIndex::of(&latents))
}

/// The answer of [`relocalize`] for one view in maps with this index, with the best `count` rooms
/// of at least two.
///
/// # Errors
/// [`Error::NoMap`] without a map.
pub fn relocalize_jointly<M: AsRef<Map>>(
    maps: &[M],
    index: &JointIndex,
    view: MapQuery<'_>,
    count: usize,
) -> Result<Relocalization, Error> {
    let whitened = maps
        .first()
        .ok_or(Error::NoMap)?
        .as_ref()
        .whitened(view.latent);
    let nearest = index.nearest_parts(&whitened, count.max(2));
    let room = |found: &PartNeighbor| RoomMatch {
        map: found.part,
        distance: found.neighbor.distance,
        out_of_distribution: maps[found.part]
            .as_ref()
            .out_of_distribution(found.neighbor.distance),
    };
    let rooms: Vec<RoomMatch> = nearest.iter().map(room).collect();
    let best = rooms.first().ok_or(Error::NoMap)?;

    let matched = maps[best.map].as_ref().match_view(view, 1);
    Ok(judged(rooms, matched))
}

/// Checks that the maps have one adapter.
fn check_adapters<M: AsRef<Map>>(maps: &[M]) -> Result<(), Error> {
    let first = maps.first().ok_or(Error::NoMap)?.as_ref();
    let adapter = first.navigator().adapter();
    let has_other = |map: &M| !Arc::ptr_eq(map.as_ref().navigator().adapter(), adapter);
    if maps.iter().any(has_other) {
        return Err(Error::Adapters);
    }
    Ok(())
}

/// Judges whether the best room is ambiguous, given its match of the newest view.
fn judged(rooms: Vec<RoomMatch>, matched: MapMatch) -> Relocalization {
    let best = &rooms[0];
    let margin = rooms
        .get(1)
        .map_or(f64::INFINITY, |second| second.distance / best.distance);

    // The margin is NaN when both distances are zero.
    let has_rival = margin.recip() > ROOM_RATIO || margin.is_nan();
    let is_far = best.out_of_distribution > 1.0;
    let is_vague = !matched.pose.tells_a_place();
    let reason = if is_far {
        format!(
            "the distance to the best room is {:.2} times the room's limit",
            best.out_of_distribution
        )
    } else if has_rival {
        format!("the second-best room is only {margin:.2} times as far as the best")
    } else if is_vague {
        let belief = &matched.pose;
        format!(
            "the pose uncertainty in the best room is {:.2} m and {:.0}° (2.5 standard deviations)",
            2.5 * belief.position_deviation_m(),
            2.5 * belief.rotation_deviation_rad().to_degrees()
        )
    } else {
        String::new()
    };

    Relocalization {
        rooms,
        best: matched,
        margin,
        ambiguous: has_rival || is_far || is_vague,
        reason,
    }
}

//! Which of several rooms a camera is in, and where, from what it sees and nothing else.

use std::sync::Arc;

use super::{Error, Map, MapMatch, MapQuery};
use seese3_core::cancel::Cancellation;

/// A room is only named if its nearest frame is this much nearer than that of any other room.
pub const ROOM_RATIO: f64 = 0.9;

/// Rooms in the order in which a camera's views match them.
#[derive(Debug, Clone, PartialEq)]
pub struct Relocalization {
    /// The rooms, the best match first.
    pub rooms: Vec<RoomMatch>,
    /// The second room's distance over the best one's; infinite with one room.
    pub margin: f64,
    /// Whether the best room should not be relied on: another one matches nearly as well, or none
    /// matches, or the view does not tell where in the room it is.
    pub ambiguous: bool,
    /// Why it is ambiguous, in words; empty if it is not.
    pub reason: String,
}

/// How well views match a room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomMatch {
    /// The room's place among the maps.
    pub map: usize,
    /// The mean distance of the views from their nearest frames, in standard deviations of frame
    /// noise.
    pub distance: f64,
    /// The mean of the views' distances over the room's limit: above 1 they look like another
    /// place.
    pub out_of_distribution: f64,
    /// How the last view matches.
    pub last: MapMatch,
}

/// Ranks rooms by one or more views of a camera that hardly moved between them, the newest last.
/// `top_k` frames are returned for the newest view.
///
/// # Errors
/// [`Error::NoMap`] without a map, [`Error::NoView`] without a view, [`Error::Adapters`] when the
/// maps have several adapters, [`Error::Cancelled`] when nobody waits any more.
pub fn relocalize(
    maps: &[Arc<Map>],
    views: &[MapQuery<'_>],
    top_k: usize,
    cancel: &Cancellation,
) -> Result<Relocalization, Error> {
    let adapter = maps.first().ok_or(Error::NoMap)?.navigator().adapter();
    let (newest, earlier) = views.split_last().ok_or(Error::NoView)?;
    if maps
        .iter()
        .any(|map| !Arc::ptr_eq(map.navigator().adapter(), adapter))
    {
        return Err(Error::Adapters);
    }

    let mut rooms = Vec::with_capacity(maps.len());
    for (place, map) in maps.iter().enumerate() {
        cancel.check().map_err(|_| Error::Cancelled)?;
        let last = map.match_view(*newest, top_k);
        let mut distance = last.distance;
        let mut out_of_distribution = last.out_of_distribution;

        for view in earlier {
            cancel.check().map_err(|_| Error::Cancelled)?;
            let matched = map.match_view(*view, 1);
            distance += matched.distance;
            out_of_distribution += matched.out_of_distribution;
        }

        let count = views.len() as f64;
        rooms.push(RoomMatch {
            map: place,
            distance: distance / count,
            out_of_distribution: out_of_distribution / count,
            last,
        });
    }

    rooms.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.map.cmp(&b.map)));

    Ok(judged(rooms))
}

/// Ranked rooms, with the judgement whether the first may be relied on.
fn judged(rooms: Vec<RoomMatch>) -> Relocalization {
    let best = &rooms[0];
    let margin = rooms
        .get(1)
        .map_or(f64::INFINITY, |second| second.distance / best.distance);

    // The margin is NaN when both distances are zero.
    let has_rival = margin.recip() > ROOM_RATIO || margin.is_nan();
    let is_far = best.out_of_distribution > 1.0;
    let is_vague = !best.last.anchor.belief.tells_a_place();
    let reason = if is_far {
        format!(
            "the best room is {:.2} times as far as its limit",
            best.out_of_distribution
        )
    } else if has_rival {
        format!("the second room is only {margin:.2} times as far as the best")
    } else if is_vague {
        let belief = &best.last.anchor.belief;
        format!(
            "the view is known to {:.2} m and {:.0}° only in the best room, 2.5 standard deviations",
            2.5 * belief.position_deviation_m(),
            2.5 * belief.rotation_deviation_rad().to_degrees()
        )
    } else {
        String::new()
    };

    Relocalization {
        rooms,
        margin,
        ambiguous: has_rival || is_far || is_vague,
        reason,
    }
}

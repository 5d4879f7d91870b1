//! Distance limits that separate frames of a room from frames of other rooms.

use ndarray::{Array2, ArrayView1};

use super::Error;
use seese3_core::adapter::{self, TEMPORAL_NEIGHBORS};
use seese3_core::index::{ExactIndex, Exclusion, Index};
use seese3_core::room::FrameId;
use seese3_core::splits::is_in_left_out_block;
use seese3_core::statistics::{median, quantile};

/// Stride at which frames of other rooms are sampled as negatives.
const OTHER_ROOM_STEP: usize = 4;
/// Quantile of own-room distances for the out-of-distribution limit.
const OWN_SHARE: f64 = 0.97;
/// Quantile of other-room distances for the out-of-distribution limit.
const OTHERS_SHARE: f64 = 0.02;
/// Quantile of other-room distances that is the limit of certain matches.
const OTHERS_SHARE_CERTAIN: f64 = 0.0003;

/// Limits of match distances, in units of the room's typical distance.
pub struct MatchLimits {
    /// A view farther than this is out of distribution.
    pub out_of_distribution: f64,
    /// A view nearer than this certainly shows this room.
    pub certain: f64,
}

/// Match limits from the rooms' whitened latents. Positives are the frames of the blocks left out
/// of a room's map, so that their distances are those of unmapped places. The out-of-distribution
/// limit is the geometric mean of the `OWN_SHARE` quantile of own-room distances and the
/// `OTHERS_SHARE` quantile of other-room distances.
pub fn match_limits(rooms: &[Array2<f64>]) -> Result<MatchLimits, Error> {
    let mut own = Vec::new();
    let mut others = Vec::new();

    for (place, room) in rooms.iter().enumerate() {
        let is_unmapped = |row: usize| is_in_left_out_block(row, room.nrows());
        let mapped: Vec<FrameId> = (0..room.nrows())
            .filter(|&row| !is_unmapped(row))
            .map(|row| FrameId(row as u32))
            .collect();
        let index = ExactIndex::new(room.view(), &mapped);

        let typical = typical_distance(&index, room, &mapped);
        let relative_distance = |row: ArrayView1<'_, f64>| {
            Some(index.nearest(&row.to_vec(), 1, None).first()?.distance / typical)
        };

        let unmapped = (0..room.nrows()).filter(|&row| is_unmapped(row));
        own.extend(unmapped.filter_map(|row| relative_distance(room.row(row))));

        for other in other_rooms(rooms, place) {
            let frames = other.outer_iter().step_by(OTHER_ROOM_STEP);
            others.extend(frames.filter_map(relative_distance));
        }
    }

    let far_own = known(quantile(&own, OWN_SHARE))?;
    let near_others = known(quantile(&others, OTHERS_SHARE))?;
    Ok(MatchLimits {
        out_of_distribution: (far_own * near_others).sqrt(),
        certain: known(quantile(&others, OTHERS_SHARE_CERTAIN))?,
    })
}

/// Median distance from a mapped frame to its nearest mapped frame more than
/// [`TEMPORAL_NEIGHBORS`] rows away.
fn typical_distance(index: &ExactIndex, room: &Array2<f64>, mapped: &[FrameId]) -> f64 {
    let distances: Vec<f64> = mapped
        .iter()
        .filter_map(|&center| {
            let exclusion = Exclusion {
                center,
                radius: TEMPORAL_NEIGHBORS,
            };
            let query = room.row(center.row()).to_vec();
            Some(index.nearest(&query, 1, Some(exclusion)).first()?.distance)
        })
        .collect();

    median(&distances)
}

fn other_rooms(rooms: &[Array2<f64>], place: usize) -> impl Iterator<Item = &Array2<f64>> {
    rooms
        .iter()
        .enumerate()
        .filter(move |(other, _)| *other != place)
        .map(|(_, room)| room)
}

/// Rejects the quantile of an empty set, which occurs if the rooms are too short.
fn known(quantile: Option<f64>) -> Result<f64, Error> {
    quantile.ok_or_else(|| adapter::Error::NoPairs.into())
}

//! The world frame of a mapped room in that of another one, from keypoints that both show.

use nalgebra::{Matrix4, Quaternion, UnitQuaternion, Vector3};

use super::KeypointRoom;
use crate::matched_views::KeypointMap;
use seese3_core::geometry::Pose;
use seese3_core::statistics::root_mean_square;
use seese3_core::trajectory::Similarity;

/// Maximum number of frames that are located.
const MOST_FRAMES: usize = 200;
/// Minimum number of frames that agree.
const FEWEST_AGREEING: usize = 5;
/// Largest rotation difference of frames that agree, radians.
const MAX_ROTATION_RAD: f64 = 0.15;
/// Largest position difference of frames that agree, units (median depths of the map).
const MAX_POSITION: f64 = 0.15;
/// Rounds of fitting and leaving out frames that do not agree.
const ROUNDS: usize = 5;

/// An alignment of two maps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapAlignment {
    /// The frame of the map, from that of the other room. Its scale is 1 unless it was estimated.
    pub map_from_other: Similarity,
    /// Number of frames of the other room that were looked for, that were located in the map, and
    /// that agree with the alignment.
    pub counts: [usize; 3],
    /// Root mean squares of their differences from the alignment, meters and radians.
    pub residuals: [f64; 2],
}

/// Why two maps are not aligned.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq, Eq)]
#[error(
    "{located} of {tried} frames were located in the other map, and {agreeing} agree on one alignment; at least \
     {FEWEST_AGREEING} are required: the maps must show the same place from similar positions"
)]
pub struct NotAligned {
    /// Number of frames that were looked for.
    pub tried: usize,
    /// Number of frames that were located.
    pub located: usize,
    /// Number of frames that agree.
    pub agreeing: usize,
}

/// A frame with its poses in both rooms.
#[derive(Clone, Copy)]
struct Pair {
    in_map: Pose,
    in_other: Pose,
}

impl KeypointRoom {
    /// Aligns another map of the same encoder, with the poses of its frames, `world_from_camera`.
    ///
    /// # Errors
    /// [`NotAligned`] if too few of its frames are located and agree.
    pub fn align(
        &self,
        other: &KeypointMap,
        poses: &[Pose],
        with_scale: bool,
    ) -> Result<MapAlignment, NotAligned> {
        let every = poses.len().div_ceil(MOST_FRAMES).max(1);
        let rows: Vec<usize> = (0..poses.len()).step_by(every).collect();
        let pairs: Vec<Pair> = rows
            .iter()
            .filter_map(|&row| {
                Some(Pair {
                    in_map: self.locate_mapped(other, row)?,
                    in_other: poses[row],
                })
            })
            .collect();

        let limit_m = MAX_POSITION * self.map().unit_m;
        let best = pairs
            .iter()
            .filter_map(|seed| {
                let turn = seed.in_map.rotation * seed.in_other.rotation.inverse();
                let agreeing = of_rotation(&pairs, &turn);
                fitted(&agreeing, with_scale, limit_m)
            })
            .max_by_key(|(_, agreeing)| agreeing.len());
        let failed = |agreeing: usize| NotAligned {
            tried: rows.len(),
            located: pairs.len(),
            agreeing,
        };
        let (map_from_other, agreeing) = best.ok_or_else(|| failed(0))?;
        if agreeing.len() < FEWEST_AGREEING {
            return Err(failed(agreeing.len()));
        }

        let differences = agreeing.iter().map(|pair| {
            let moved = map_from_other.pose(&pair.in_other);
            pair.in_map.inv_mul(&moved)
        });
        let of = |value: fn(&Pose) -> f64| {
            root_mean_square(
                &differences
                    .clone()
                    .map(|pose| value(&pose))
                    .collect::<Vec<_>>(),
            )
        };
        Ok(MapAlignment {
            map_from_other,
            counts: [rows.len(), pairs.len(), agreeing.len()],
            residuals: [
                of(|pose| pose.translation.vector.norm()),
                of(|pose| pose.rotation.angle()),
            ],
        })
    }
}

/// The pairs whose rotation between the rooms is nearly this one.
fn of_rotation(pairs: &[Pair], turn: &UnitQuaternion<f64>) -> Vec<Pair> {
    let is_near = |pair: &&Pair| {
        let own = pair.in_map.rotation * pair.in_other.rotation.inverse();
        own.angle_to(turn) < MAX_ROTATION_RAD
    };
    pairs.iter().filter(is_near).copied().collect()
}

/// The similarity that fits the pairs, and those that agree with it.
fn fitted(pairs: &[Pair], with_scale: bool, limit_m: f64) -> Option<(Similarity, Vec<Pair>)> {
    let mut kept = pairs.to_vec();
    for _ in 0..ROUNDS {
        let similarity = similarity(&kept, with_scale)?;
        let error_m = |pair: &Pair| {
            let moved = similarity.pose(&pair.in_other).translation.vector;
            (moved - pair.in_map.translation.vector).norm()
        };
        let agreeing: Vec<Pair> = pairs
            .iter()
            .filter(|pair| error_m(pair) < limit_m)
            .copied()
            .collect();
        let is_settled = agreeing.len() == kept.len();
        kept = agreeing;
        if is_settled {
            break;
        }
    }
    Some((similarity(&kept, with_scale)?, kept))
}

/// The mean rotation, then the least-squares scale and translation of the positions; `None` without
/// a pair.
fn similarity(pairs: &[Pair], with_scale: bool) -> Option<Similarity> {
    let count = pairs.len() as f64;
    let mut moment = Matrix4::zeros();
    for pair in pairs {
        let turn = pair.in_map.rotation * pair.in_other.rotation.inverse();
        moment += turn.coords * turn.coords.transpose();
    }
    let eigen = moment.symmetric_eigen();
    let rotation = UnitQuaternion::from_quaternion(Quaternion::from(
        eigen
            .eigenvectors
            .column(eigen.eigenvalues.imax())
            .into_owned(),
    ));

    let mean = |of: fn(&Pair) -> Vector3<f64>| pairs.iter().map(of).sum::<Vector3<f64>>() / count;
    let in_map = mean(|pair| pair.in_map.translation.vector);
    let in_other = mean(|pair| pair.in_other.translation.vector);
    let (mut product, mut square) = (0.0, 0.0);
    for pair in pairs {
        let turned = rotation * (pair.in_other.translation.vector - in_other);
        product += turned.dot(&(pair.in_map.translation.vector - in_map));
        square += turned.norm_squared();
    }
    let scale = if with_scale && square > 0.0 && product > 0.0 {
        product / square
    } else {
        1.0
    };
    let shift = in_map - rotation * in_other * scale;
    (count > 0.0).then(|| Similarity {
        scale,
        reference_from_estimate: Pose::from_parts(shift.into(), rotation),
    })
}

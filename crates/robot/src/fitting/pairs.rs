//! Training pairs of mapped frames for a fitted adapter.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use seese3_core::geometry::Pose;
use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::median;

/// Number of pairs drawn.
pub const PAIRS: usize = 30_000;
/// Longest temporal pair in rows, as in the paper.
const LONGEST_ROWS: f64 = 40.0;
/// Minimum length of the longest temporal pair in mapped frames; overrides [`LONGEST_ROWS`].
const FEWEST_STEPS: usize = 5;

/// Draws training pairs, as rows of mapped frames, with replacement. The pool holds temporal pairs
/// of one sequence and pairs with near poses at any time. The second kind trains the case of a
/// camera that returns to a place.
pub fn pairs(room: &Room, mapped: &[FrameId], seed: u64) -> Vec<[usize; 2]> {
    let steps = steps(mapped);
    let mut pool = following(room, mapped, steps);
    pool.extend(near(room.poses(), mapped, 2 * steps));
    if pool.is_empty() {
        return pool;
    }

    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..PAIRS)
        .map(|_| pool[random.random_range(0..pool.len())])
        .collect()
}

/// Length of the longest temporal pair in rows, for the training record.
pub fn longest_rows(mapped: &[FrameId]) -> u32 {
    let longest = mapped
        .windows(steps(mapped) + 1)
        .map(|window| window[window.len() - 1].0 - window[0].0)
        .max();
    longest.unwrap_or(1)
}

/// Length of the longest temporal pair in mapped frames.
fn steps(mapped: &[FrameId]) -> usize {
    let spacings: Vec<f64> = mapped
        .windows(2)
        .map(|pair| f64::from(pair[1].0 - pair[0].0))
        .collect();
    let steps = LONGEST_ROWS / median(&spacings).max(1.0);

    (steps as usize).clamp(
        FEWEST_STEPS,
        mapped.len().saturating_sub(1).max(FEWEST_STEPS),
    )
}

/// Temporal pairs: at most `steps` mapped frames apart, in one sequence.
fn following(room: &Room, mapped: &[FrameId], steps: usize) -> Vec<[usize; 2]> {
    let mut pairs = Vec::new();
    for (at, &source) in mapped.iter().enumerate() {
        let targets = mapped[at + 1..].iter().take(steps);
        let joined = targets.filter(|&&target| room.timeline().joins(source, target));
        pairs.extend(joined.map(|target| [source.row(), target.row()]));
    }

    pairs
}

/// Spatial pairs: each mapped frame with the `count` mapped frames of nearest pose, by [`apart`].
fn near(poses: &[Pose], mapped: &[FrameId], count: usize) -> Vec<[usize; 2]> {
    let mut pairs = Vec::new();
    for &source in mapped {
        let from = &poses[source.row()];
        let mut others: Vec<(f64, usize)> = mapped
            .iter()
            .filter(|&&target| target != source)
            .map(|target| (apart(from, &poses[target.row()]), target.row()))
            .collect();

        let count = count.min(others.len());
        if count < others.len() {
            others.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0));
        }
        pairs.extend(
            others[..count]
                .iter()
                .map(|&(_, target)| [source.row(), target]),
        );
    }

    pairs
}

/// Distance between two poses: meters plus radians.
fn apart(a: &Pose, b: &Pose) -> f64 {
    let meters = (a.translation.vector - b.translation.vector).norm();
    meters + a.rotation.angle_to(&b.rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::room::{Frames, Provenance, RoomId};

    /// A camera that moves along x and returns on the same path.
    fn there_and_back(count: usize) -> Room {
        let x = |row: usize| row.min(count - 1 - row) as f64;
        let frames = Frames {
            poses: (0..count)
                .map(|row| Pose::translation(x(row), 0.0, 0.0))
                .collect(),
            ..Frames::default()
        };
        Room::new(RoomId::new("r").unwrap(), frames, Provenance::default()).unwrap()
    }

    /// Oracle: by hand. Every tenth frame is mapped, so temporal pairs span up to five mapped
    /// frames. The frame at the same place on the way back is among the nearest.
    #[test]
    fn pairs_join_neighbors_in_time_and_in_place() {
        let room = there_and_back(200);
        let mapped: Vec<FrameId> = (0..200).step_by(10).map(FrameId).collect();

        let drawn = pairs(&room, &mapped, 1);
        assert_eq!(drawn.len(), PAIRS);
        assert_eq!(longest_rows(&mapped), 50);

        let rows: Vec<usize> = mapped.iter().map(|frame| frame.row()).collect();
        assert!(drawn.iter().flatten().all(|row| rows.contains(row)));
        assert!(drawn.contains(&[20, 70]) && !drawn.contains(&[0, 110]));
        assert!(drawn.contains(&[20, 180]), "the way back at the same place");
        assert_ne!(drawn, pairs(&room, &mapped, 2));
    }
}

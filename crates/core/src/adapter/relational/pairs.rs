//! Random training pairs of frames, near each other or anywhere in the same room.

use std::ops::Range;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::geometry::{Pose, Twist, body_twist};

/// The training frames of a room, as rows of the stacked images.
#[derive(Debug, Clone)]
pub struct RoomFrames {
    /// The row of the room's first frame in the stack.
    pub first_row: usize,
    /// `world_from_camera` of every frame of the room, also of those that are not trained on.
    pub poses: Vec<Pose>,
    /// Uninterrupted runs of training frames, as rows of the room.
    pub runs: Vec<Range<usize>>,
}

/// Draws pairs of training frames.
#[derive(Debug, Clone)]
pub struct PairSampler {
    rooms: Vec<RoomFrames>,
    longest_stride: usize,
    far_share: f64,
}

/// A drawn pair: rows of the stacked images, and the motion between them in the body frame of the
/// first camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrawnPair {
    pub rows: [usize; 2],
    pub motion: Twist,
}

impl PairSampler {
    /// A sampler of rooms. Runs of a single frame are left out. `None` if a room has no run of two
    /// frames.
    ///
    /// With the probability `far_share`, a pair has any two training frames of one room; otherwise
    /// two frames of one run that are up to `longest_stride` frames apart, in either order.
    pub fn new(mut rooms: Vec<RoomFrames>, longest_stride: usize, far_share: f64) -> Option<Self> {
        for room in &mut rooms {
            room.runs.retain(|run| run.len() > 1);
        }
        let is_usable = !rooms.is_empty() && rooms.iter().all(|room| !room.runs.is_empty());

        is_usable.then_some(Self {
            rooms,
            longest_stride: longest_stride.max(1),
            far_share,
        })
    }

    /// Draws a pair. Every room is equally likely.
    pub fn draw(&self, random: &mut ChaCha8Rng) -> DrawnPair {
        let room = &self.rooms[random.random_range(0..self.rooms.len())];
        let (first, run) = room.frame(random);
        let second = if random.random::<f64>() < self.far_share {
            room.frame(random).0
        } else {
            let low = first.saturating_sub(self.longest_stride).max(run.start);
            let high = (first + self.longest_stride).min(run.end - 1);

            // Every frame of the window but the first one itself.
            let drawn = random.random_range(low..high);
            if drawn < first { drawn } else { drawn + 1 }
        };

        DrawnPair {
            rows: [room.first_row + first, room.first_row + second],
            motion: body_twist(&room.poses[first], &room.poses[second]),
        }
    }
}

impl RoomFrames {
    /// A random training frame and its run. Every frame is equally likely.
    fn frame(&self, random: &mut ChaCha8Rng) -> (usize, &Range<usize>) {
        let count: usize = self.runs.iter().map(Range::len).sum();
        let mut place = random.random_range(0..count);
        for run in &self.runs {
            if place < run.len() {
                return (run.start + place, run);
            }
            place -= run.len();
        }

        // Not reached: `place` is less than the sum of the lengths.
        let run = &self.runs[self.runs.len() - 1];
        (run.end - 1, run)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    /// Oracle: the contract, for every pair of many: near pairs are in one run, at most the longest
    /// stride apart and never the same frame; all distances occur in both orders; far pairs join
    /// runs; frames between the runs are never drawn.
    #[test]
    fn pairs_are_near_in_a_run_or_anywhere_in_the_room() {
        let poses: Vec<Pose> = (0..60)
            .map(|x| Pose::translation(f64::from(x), 0.0, 0.0))
            .collect();
        let room = RoomFrames {
            first_row: 100,
            poses,
            runs: vec![0..20, 30..31, 40..60],
        };
        let run = |row: usize| match row - 100 {
            0..20 => 0,
            40..60 => 1,
            other => panic!("frame {other} is not a training frame"),
        };

        let mut random = ChaCha8Rng::seed_from_u64(5);
        let near = PairSampler::new(vec![room.clone()], 5, 0.0).unwrap();
        let mut seen = [false; 11];
        for _ in 0..2_000 {
            let DrawnPair { rows, motion } = near.draw(&mut random);
            let apart = rows[1] as i64 - rows[0] as i64;
            assert!(apart != 0 && apart.abs() <= 5 && run(rows[0]) == run(rows[1]));
            assert!((motion.linear.x - apart as f64).abs() < 1e-12);
            seen[(apart + 5) as usize] = true;
        }
        assert_eq!(seen.iter().filter(|seen| **seen).count(), 10);

        let far = PairSampler::new(vec![room], 5, 1.0).unwrap();
        let joins = (0..200).filter(|_| {
            let [a, b] = far.draw(&mut random).rows;
            run(a) != run(b)
        });
        assert!((60..140).contains(&joins.count()));
    }

    /// Oracle: the contract.
    #[test]
    fn rooms_without_a_pair_are_refused() {
        let room = RoomFrames {
            first_row: 0,
            poses: vec![Pose::identity(); 3],
            runs: vec![0..1, 2..3],
        };
        assert!(PairSampler::new(vec![room], 5, 0.0).is_none());
        assert!(PairSampler::new(Vec::new(), 5, 0.0).is_none());
    }
}

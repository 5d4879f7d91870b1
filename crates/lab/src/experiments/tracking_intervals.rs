//! Intervals of tracking scores by a bootstrap over rooms, and over blocks of time within them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use seese3_core::geometry::{Pose, PoseError, body_twist};
use seese3_core::statistics::{coverage, quantile};
use seese3_robot::tracking::Status;

use super::replay::Replay;
use super::tracking_scores::is_wrong;

/// Number of blocks of a recording. Errors of neighboring frames are correlated.
const BLOCKS: usize = 20;
const RESAMPLES: usize = 2_000;
const SEED: u64 = 1;

/// Sums over the frames of a block of time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BlockSums {
    frames: f64,
    /// Frames with a map pose, with its squared position errors and those of the nearest frame, m².
    placed: f64,
    fused_m2: f64,
    nearest_m2: f64,
    /// TRACKING frames, those over 0.2 m or 10° off, and those in the 68 % and 95 % ellipsoids.
    tracking: f64,
    wrong: f64,
    within: [f64; 2],
    /// Squared errors of velocities, and squared true speeds, m²/s².
    velocity: f64,
    speed: f64,
}

/// 95 % intervals, each from its lower to its upper end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TrackingIntervals {
    /// Root-mean-square position error of the map pose, meters; the mean over rooms.
    pub fused_m: [f64; 2],
    /// The same of the nearest frame.
    pub nearest_frame_m: [f64; 2],
    /// Their difference.
    pub fused_minus_nearest_m: [f64; 2],
    /// Share of TRACKING frames.
    pub tracking: [f64; 2],
    /// Share of wrong poses among TRACKING frames.
    pub tracking_wrong: [f64; 2],
    /// Share of TRACKING poses in the 68 % ellipsoid.
    pub coverage_68: [f64; 2],
    /// The same for the 95 % ellipsoid.
    pub coverage_95: [f64; 2],
    /// Root-mean-square error of the velocity, relative to that of reporting zero.
    pub velocity_ratio: [f64; 2],
}

/// The blocks of a replay, in order. `nearest_frame` returns the pose of the mapped frame with the
/// raw feature most similar to that of a row.
pub fn blocks_of(replay: &Replay, nearest_frame: impl Fn(usize) -> Pose) -> Vec<BlockSums> {
    let truth = &replay.truth;
    let frame = |row: usize| {
        let mut sums = BlockSums {
            frames: 1.0,
            ..BlockSums::default()
        };

        let (update, pose) = (&replay.updates[row], &truth.poses[row]);

        let squared_m = |given: &Pose| PoseError::between(given, pose).translation_m.powi(2);
        if let Some(map_pose) = &update.map_pose {
            sums.placed = 1.0;
            sums.fused_m2 = squared_m(&map_pose.pose);
            sums.nearest_m2 = squared_m(&nearest_frame(row));
            if update.status == Status::Tracking {
                sums.tracking = 1.0;
                sums.wrong = f64::from(u8::from(is_wrong(&map_pose.pose, pose)));
                let squared: Vec<f64> = map_pose.squared_error(pose).into_iter().collect();
                let within = coverage(&squared);
                sums.within = [within.within_68, within.within_95];
            }
        }

        if let (Some(velocity), Some(last)) = (update.velocity, row.checked_sub(1)) {
            let seconds = (truth.times_ns[row] - truth.times_ns[last]) as f64 * 1e-9;
            let true_velocity = body_twist(&truth.poses[last], pose).linear / seconds;
            sums.velocity = (velocity.linear - true_velocity).norm_squared();
            sums.speed = true_velocity.norm_squared();
        }

        sums
    };

    let frames: Vec<BlockSums> = (0..replay.updates.len()).map(frame).collect();
    let length = frames.len().div_ceil(BLOCKS).max(1);
    frames.chunks(length).map(BlockSums::total).collect()
}

impl BlockSums {
    fn total(blocks: &[Self]) -> Self {
        blocks.iter().fold(Self::default(), |a, b| Self {
            frames: a.frames + b.frames,
            placed: a.placed + b.placed,
            fused_m2: a.fused_m2 + b.fused_m2,
            nearest_m2: a.nearest_m2 + b.nearest_m2,
            tracking: a.tracking + b.tracking,
            wrong: a.wrong + b.wrong,
            within: [a.within[0] + b.within[0], a.within[1] + b.within[1]],
            velocity: a.velocity + b.velocity,
            speed: a.speed + b.speed,
        })
    }
}

/// The scores of one sample of rooms, in the order of [`TrackingIntervals`].
fn scores(rooms: &[BlockSums]) -> [f64; 8] {
    let known: Vec<&BlockSums> = rooms.iter().filter(|room| room.placed > 0.0).collect();
    let mean_error = |squared: fn(&BlockSums) -> f64| {
        let errors = known
            .iter()
            .map(|room| (squared(room) / room.placed).sqrt());
        errors.sum::<f64>() / known.len() as f64
    };
    let fused_m = mean_error(|room| room.fused_m2);
    let nearest_m = mean_error(|room| room.nearest_m2);

    let all = BlockSums::total(rooms);
    let velocities = rooms
        .iter()
        .map(|room| (room.velocity / room.frames).sqrt());
    let speeds = rooms.iter().map(|room| (room.speed / room.frames).sqrt());
    let tracking = rooms.iter().map(|room| room.tracking / room.frames);

    [
        fused_m,
        nearest_m,
        fused_m - nearest_m,
        tracking.sum::<f64>() / rooms.len() as f64,
        all.wrong / all.tracking,
        all.within[0] / all.tracking,
        all.within[1] / all.tracking,
        velocities.sum::<f64>() / speeds.sum::<f64>(),
    ]
}

impl TrackingIntervals {
    /// Percentile intervals over samples: rooms are drawn with replacement, then blocks within each
    /// of them. One room is always drawn: its interval is that of its recording. `None` without a
    /// frame.
    pub fn of(rooms: &[&[BlockSums]]) -> Option<Self> {
        let rooms: Vec<&[BlockSums]> = rooms.iter().copied().filter(|r| !r.is_empty()).collect();
        if rooms.is_empty() {
            return None;
        }

        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        let mut samples: [Vec<f64>; 8] = Default::default();
        for _ in 0..RESAMPLES {
            let drawn: Vec<BlockSums> = (0..rooms.len())
                .map(|_| {
                    let room = rooms[random.random_range(0..rooms.len())];
                    let blocks: Vec<BlockSums> = (0..room.len())
                        .map(|_| room[random.random_range(0..room.len())])
                        .collect();
                    BlockSums::total(&blocks)
                })
                .collect();
            for (samples, score) in samples.iter_mut().zip(scores(&drawn)) {
                samples.extend(Some(score).filter(|score| score.is_finite()));
            }
        }

        let point = |samples: &[f64], share| quantile(samples, share).unwrap_or(f64::NAN);
        let [
            fused_m,
            nearest_frame_m,
            fused_minus_nearest_m,
            tracking,
            tracking_wrong,
            coverage_68,
            coverage_95,
            velocity_ratio,
        ] = samples.map(|samples| [point(&samples, 0.025), point(&samples, 0.975)]);
        Some(Self {
            fused_m,
            nearest_frame_m,
            fused_minus_nearest_m,
            tracking,
            tracking_wrong,
            coverage_68,
            coverage_95,
            velocity_ratio,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(fused_m: f64, is_tracking: bool) -> BlockSums {
        BlockSums {
            frames: 1.0,
            placed: 1.0,
            fused_m2: fused_m * fused_m,
            nearest_m2: 0.25,
            tracking: f64::from(u8::from(is_tracking)),
            wrong: 0.0,
            within: [1.0, 1.0],
            velocity: 1.0,
            speed: 4.0,
        }
    }

    /// Oracle: by hand. Equal blocks have intervals of width zero. Of two rooms that differ, a
    /// sample holds either one twice with probability 1/4, so the interval reaches from one to the
    /// other. Of one room with as many blocks that are TRACKING as not, the share in 20 draws is
    /// binomial: 95 % of B(20, 1/2) lie in 6 to 14.
    #[test]
    fn rooms_and_blocks_are_resampled() {
        let near = vec![block(0.1, true); 20];
        let far = vec![block(0.3, true); 20];
        let close = |found: [f64; 2], expected: [f64; 2]| {
            let is_close = |(a, b): (f64, f64)| (a - b).abs() < 1e-9;
            assert!(found.into_iter().zip(expected).all(is_close), "{found:?}");
        };

        let one = TrackingIntervals::of(&[&near]).unwrap();
        close(one.fused_m, [0.1, 0.1]);
        close(one.nearest_frame_m, [0.5, 0.5]);
        close(one.fused_minus_nearest_m, [-0.4, -0.4]);
        close(one.tracking, [1.0, 1.0]);
        close(one.velocity_ratio, [0.5, 0.5]);
        let two = TrackingIntervals::of(&[&near, &far]).unwrap();
        close(two.fused_m, [0.1, 0.3]);

        let mixed: Vec<BlockSums> = (0..20).map(|at| block(0.1, at % 2 == 0)).collect();
        let mixed = TrackingIntervals::of(&[&mixed]).unwrap();
        close(mixed.tracking, [0.3, 0.7]);
        assert!(TrackingIntervals::of(&[]).is_none());
    }
}

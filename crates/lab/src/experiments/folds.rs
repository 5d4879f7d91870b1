//! Scores under one split, or under the cross-validation folds of a recording.
//!
//! The test pairs of all folds are scored together. The R² of a single fold divides by the motion
//! variance of that fifth, which may be much smaller than that of the whole recording. The pooled
//! R² divides by the variance over all folds.

use seese3_core::eval::{Baselines, TestPairs};
use seese3_core::geometry::PoseError;
use seese3_core::motion_scores::{MotionScores, ReadMotions};
use seese3_core::room::Room;
use seese3_core::splits::{self, Split};
use seese3_core::statistics::mean_of_known;

use super::Error;

/// Motions of the test pairs of several rooms, for each of several splits.
#[derive(Debug, Clone)]
pub struct FoldedMotions {
    /// Per split, the motions of each room.
    pub by_split: Vec<Vec<ReadMotions>>,
}

impl FoldedMotions {
    /// Calls `read` for each of `splits`; it returns the motions of each room.
    ///
    /// # Errors
    /// The first error of `read`.
    pub fn of(
        splits: &[Split],
        read: impl Fn(Split) -> Result<Vec<ReadMotions>, Error>,
    ) -> Result<Self, Error> {
        Ok(Self {
            by_split: splits
                .iter()
                .map(|&split| read(split))
                .collect::<Result<_, _>>()?,
        })
    }

    /// Scores over the pairs of all splits of a room together, averaged over rooms.
    pub fn scores(&self) -> MotionScores {
        MotionScores::mean(&self.room_scores())
    }

    /// Scores over the pairs of all splits of a room together, one per room.
    pub fn room_scores(&self) -> Vec<MotionScores> {
        self.rooms().iter().map(ReadMotions::scores).collect()
    }

    /// The overall R² of the constant baseline, pooled and averaged as in
    /// [`FoldedMotions::scores`]. The baseline always predicts the mean training motion.
    pub fn constant_r2(&self) -> f64 {
        let rooms: Vec<f64> = self.rooms().iter().map(ReadMotions::constant_r2).collect();
        mean_of_known(&rooms)
    }

    /// The overall R² under each split, averaged over rooms.
    pub fn r2_by_split(&self) -> Vec<f64> {
        let of = |rooms: &Vec<ReadMotions>| {
            let r2: Vec<f64> = rooms.iter().map(|room| room.scores().overall).collect();
            mean_of_known(&r2)
        };
        self.by_split.iter().map(of).collect()
    }

    /// The motions of each room, concatenated over all splits.
    fn rooms(&self) -> Vec<ReadMotions> {
        let mut rooms = vec![ReadMotions::default(); self.by_split.first().map_or(0, Vec::len)];
        for split in &self.by_split {
            for (room, motions) in rooms.iter_mut().zip(split) {
                room.append(motions.clone());
            }
        }
        rooms
    }
}

/// Baselines to compare R² with: for each split, and for all splits together.
#[derive(Debug, Clone)]
pub struct FoldedBaselines {
    /// The constant's R² over the pairs of all splits together; the other fields are means over
    /// the splits.
    pub together: Baselines,
    /// One entry per split.
    pub by_split: Vec<Baselines>,
}

impl FoldedBaselines {
    /// The baselines of a model trained on the room's own training pairs, with the given number of
    /// optimizer steps.
    ///
    /// # Errors
    /// [`splits::Error`] when the room has no training or no test pairs under a split.
    pub fn of(
        room: &Room,
        splits: &[Split],
        stride: u32,
        optimizer_steps: u64,
        constant_r2: f64,
    ) -> Result<Self, splits::Error> {
        let within =
            |&split: &Split| Baselines::within(room, &TestPairs { split, stride }, optimizer_steps);
        let by_split: Vec<Baselines> = splits.iter().map(within).collect::<Result<_, _>>()?;

        let ratios: Vec<f64> = by_split.iter().map(|split| split.variance_ratio).collect();
        let nearest: Vec<PoseError> = by_split
            .iter()
            .filter_map(|split| split.nearest_pose)
            .collect();
        let mean =
            |of: fn(&PoseError) -> f64| mean_of_known(&nearest.iter().map(of).collect::<Vec<_>>());

        Ok(Self {
            together: Baselines {
                constant_r2,
                variance_ratio: mean_of_known(&ratios),
                nearest_pose: (!nearest.is_empty()).then(|| PoseError {
                    translation_m: mean(|pose| pose.translation_m),
                    rotation_rad: mean(|pose| pose.rotation_rad),
                }),
                optimizer_steps,
            },
            by_split,
        })
    }
}

#[cfg(test)]
mod tests {
    use seese3_core::geometry::Twist;

    use super::*;

    /// Oracle: by hand. Each fold has one value of x, so its own R² is undefined. Together,
    /// R² = 1 − (0.25 + 0.25) / 2 = 0.75. Each constant is the other fold's mean and misses by 2:
    /// 1 − 8 / 2 = −3.
    #[test]
    fn folds_are_scored_together() {
        let along =
            |x: f64| Twist::from_vector(&nalgebra::Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0));
        let fold = |truth: f64, read: f64, mean: f64| {
            vec![ReadMotions::new(
                vec![along(truth)],
                vec![along(read)],
                &along(mean).to_vector(),
            )]
        };
        let folded = FoldedMotions {
            by_split: vec![fold(-1.0, -0.5, 1.0), fold(1.0, 0.5, -1.0)],
        };

        assert!(folded.r2_by_split().iter().all(|r2| r2.is_nan()));
        assert!((folded.scores().overall - 0.75).abs() < 1e-12);
        assert!((folded.constant_r2() + 3.0).abs() < 1e-12);
        assert_eq!(folded.scores().n, 2);
    }
}

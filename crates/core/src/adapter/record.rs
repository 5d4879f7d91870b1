//! The training record, stored with an adapter so that the run can be reproduced.

use super::{Mixing, PairPlan, RelationalConfig, TrainConfig};
use crate::motion_scores::MotionScores;
use crate::room::RoomId;
use crate::splits::Split;

/// Settings and scores of a training run.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingRecord {
    /// Name of the preset that the settings started from.
    pub preset: String,
    /// Split of the frames or pairs into training and test.
    pub split: Split,
    /// Frames from source to target in the test pairs.
    pub stride: u32,
    /// Selection of the training pairs.
    pub pairs: PairPlan,
    /// Rooms of the training set, with their revisions.
    pub rooms: Vec<(RoomId, u64)>,
    /// Rooms of the calibration, with their revisions.
    pub calibrated_on: Vec<(RoomId, u64)>,
    /// Optimizer settings and seed.
    pub config: TrainConfig,
    /// Number of training pairs; repeated draws of a pair are counted.
    pub pair_count: usize,
    /// Scores on the test pairs, mean over rooms. Undefined under [`Split::Whole`], which has no
    /// test pairs.
    pub test: MotionScores,
    /// Scores on the test pairs of each room, in the order of `rooms`.
    pub room_tests: Vec<MotionScores>,
    /// Scores on the training pairs.
    pub train: MotionScores,
    /// Baseline: R² on the test pairs if μ is predicted for every pair; mean over rooms. A fitted
    /// adapter has no test pairs; there the training pairs are used.
    pub train_mean_r2: f64,
    /// Settings of the relational reader, if the adapter has one.
    pub relational: Option<RelationalConfig>,
}

impl TrainingRecord {
    /// Number of optimizer steps: batches per epoch times epochs. The epochs of an ensemble are
    /// divided among its charts.
    pub fn optimizer_steps(&self) -> u64 {
        let batches = self.pair_count.div_ceil(self.config.batch.max(1)) as u64;
        let is_ensemble = self.config.charts > 1 && self.config.mixing == Mixing::Even;
        let epochs = if is_ensemble {
            self.config.epochs.div_ceil(self.config.charts) * self.config.charts
        } else {
            self.config.epochs
        };

        batches * epochs as u64
    }
}

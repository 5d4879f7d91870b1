//! How an adapter was trained, recorded with it so that the run can be reproduced.

use super::{Mixing, PairPlan, TrainConfig};
use crate::motion_scores::MotionScores;
use crate::room::RoomId;
use crate::splits::Split;

/// The settings of a training run and the scores that it reached.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingRecord {
    /// Name of the preset that the settings are based on.
    pub preset: String,
    /// How frames or pairs were divided into training and test.
    pub split: Split,
    /// Frames from source to target in the test pairs.
    pub stride: u32,
    /// Which training pairs were used.
    pub pairs: PairPlan,
    /// Rooms of the training set, with their revisions.
    pub rooms: Vec<(RoomId, u64)>,
    /// Rooms in which the adapter's errors were measured, with their revisions.
    pub calibrated_on: Vec<(RoomId, u64)>,
    /// The optimiser's settings and the seed.
    pub config: TrainConfig,
    /// Number of training pairs; a pair that was drawn several times counts each time.
    pub pair_count: usize,
    /// Scores on the test pairs, the mean over rooms. Under [`Split::Whole`] there are no test
    /// pairs, and the scores are undefined.
    pub test: MotionScores,
    /// Scores on the test pairs of each room, in the order of `rooms`.
    pub room_tests: Vec<MotionScores>,
    /// Scores on the training pairs.
    pub train: MotionScores,
    /// R² on the test pairs of a constant prediction, the mean of the training twists. The mean
    /// over rooms.
    pub train_mean_r2: f64,
}

impl TrainingRecord {
    /// How many steps the optimiser took: the batches of an epoch times the epochs. The charts of an
    /// ensemble share the epochs.
    pub fn optimiser_steps(&self) -> u64 {
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

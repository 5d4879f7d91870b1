//! How an adapter came to be: recorded with it, so that its numbers can be made again.

use super::TrainConfig;
use crate::pairs::Split;
use crate::room::RoomId;
use crate::scores::MotionScores;

/// A training run and what it reached.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingRecord {
    /// The protocol's name.
    pub preset: String,
    /// How frames were kept apart.
    pub split: Split,
    /// Frames from source to target in the test pairs, and in the training pairs unless the protocol draws a range.
    pub stride: u32,
    /// Rooms it learned from, with their revisions.
    pub rooms: Vec<(RoomId, u64)>,
    /// The optimiser's settings and the seed.
    pub config: TrainConfig,
    /// Training pairs, drawn ones counted as often as drawn.
    pub pair_count: usize,
    /// On the test pairs.
    pub test: MotionScores,
    /// On the training pairs.
    pub train: MotionScores,
    /// R² on the test pairs of always predicting the mean of the training twists.
    pub train_mean_r2: f64,
}

//! How an adapter came to be: recorded with it, so that its numbers can be made again.

use super::{PairPlan, TrainConfig};
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
    /// Frames from source to target in the test pairs.
    pub stride: u32,
    /// Which training pairs were taken.
    pub pairs: PairPlan,
    /// Rooms it learned from, with their revisions.
    pub rooms: Vec<(RoomId, u64)>,
    /// Rooms in which its errors were measured.
    pub calibrated_on: Vec<(RoomId, u64)>,
    /// The optimiser's settings and the seed.
    pub config: TrainConfig,
    /// Training pairs, drawn ones counted as often as drawn.
    pub pair_count: usize,
    /// On the test pairs: the mean over rooms. Of no pair, and undefined, under [`Split::Whole`].
    pub test: MotionScores,
    /// On the test pairs of each room.
    pub room_tests: Vec<MotionScores>,
    /// On the training pairs.
    pub train: MotionScores,
    /// R² on the test pairs of always predicting the mean of the training twists: the mean over
    /// rooms.
    pub train_mean_r2: f64,
}

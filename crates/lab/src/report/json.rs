//! Parts shared by several JSON records. Keys are stable; undefined values are null.

use serde::Serialize;

use seese3_core::eval::Baselines;
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{Rate, RoomMean, deviation, mean, median};

/// A rate with Wilson's 95 % interval.
#[derive(Debug, Clone, Serialize)]
pub struct RateJson {
    rate: f64,
    low: f64,
    high: f64,
}

impl From<&Rate> for RateJson {
    fn from(rate: &Rate) -> Self {
        Self {
            rate: rate.rate,
            low: rate.low,
            high: rate.high,
        }
    }
}

/// A mean over rooms with its 95 % bootstrap interval.
#[derive(Debug, Clone, Serialize)]
pub struct RoomMeanJson {
    mean: f64,
    low: f64,
    high: f64,
    rooms: usize,
}

impl From<&RoomMean> for RoomMeanJson {
    fn from(mean: &RoomMean) -> Self {
        Self {
            mean: mean.mean,
            low: mean.low,
            high: mean.high,
            rooms: mean.rooms,
        }
    }
}

/// The scores of predicted motions.
#[derive(Debug, Clone, Serialize)]
pub struct MotionJson {
    n: usize,
    r2: R2Json,
    direction_pairs_dropped: usize,
}

/// R² by component and part of the motion.
#[derive(Debug, Clone, Serialize)]
struct R2Json {
    components: [f64; 6],
    overall: f64,
    translation: f64,
    rotation: f64,
    direction: f64,
    magnitude: f64,
}

impl From<&MotionScores> for MotionJson {
    fn from(scores: &MotionScores) -> Self {
        Self {
            n: scores.n,
            r2: R2Json {
                components: scores.components,
                overall: scores.overall,
                translation: scores.translation,
                rotation: scores.rotation,
                direction: scores.direction,
                magnitude: scores.magnitude,
            },
            direction_pairs_dropped: scores.direction_pairs_dropped,
        }
    }
}

/// R² by part of the motion, over several runs.
#[derive(Debug, Clone, Serialize)]
pub struct PartsJson {
    overall: SpreadJson,
    translation: SpreadJson,
    rotation: SpreadJson,
    direction: SpreadJson,
    magnitude: SpreadJson,
}

/// A mean and a sample standard deviation over the runs in which a value is defined.
#[derive(Debug, Clone, Serialize)]
struct SpreadJson {
    mean: f64,
    sd: f64,
}

impl PartsJson {
    /// The spread of each part over `runs`.
    pub fn of(runs: &[MotionScores]) -> Self {
        let spread = |part: fn(&MotionScores) -> f64| {
            let values: Vec<f64> = runs
                .iter()
                .map(part)
                .filter(|value| !value.is_nan())
                .collect();

            SpreadJson {
                mean: mean(&values),
                sd: deviation(&values),
            }
        };

        Self {
            overall: spread(|run| run.overall),
            translation: spread(|run| run.translation),
            rotation: spread(|run| run.rotation),
            direction: spread(|run| run.direction),
            magnitude: spread(|run| run.magnitude),
        }
    }
}

/// Baselines to compare an R² with.
#[derive(Debug, Clone, Serialize)]
pub struct BaselinesJson {
    constant_r2: f64,
    variance_ratio: f64,
    nearest_pose: Option<NearestPoseJson>,
    optimiser_steps: u64,
    /// False if the constant's R² is so far below zero that the recording cannot rate an adapter.
    can_tell: bool,
}

/// Median distance and angle from the test frames to the nearest training poses.
#[derive(Debug, Clone, Serialize)]
struct NearestPoseJson {
    m: f64,
    deg: f64,
}

impl From<&Baselines> for BaselinesJson {
    fn from(baselines: &Baselines) -> Self {
        Self {
            constant_r2: baselines.constant_r2,
            variance_ratio: baselines.variance_ratio,
            nearest_pose: baselines.nearest_pose.map(|nearest| NearestPoseJson {
                m: nearest.translation_m,
                deg: nearest.rotation_rad.to_degrees(),
            }),
            optimiser_steps: baselines.optimiser_steps,
            can_tell: baselines.can_tell(),
        }
    }
}

impl BaselinesJson {
    /// Medians over the held-out rooms of one adapter; `None` without rooms.
    pub fn medians<'a>(rooms: impl Iterator<Item = &'a Baselines> + Clone) -> Option<Self> {
        let first = *rooms.clone().next()?;
        let middle = |of: fn(&Baselines) -> f64| median(&rooms.clone().map(of).collect::<Vec<_>>());

        Some(Self::from(&Baselines {
            constant_r2: middle(|room| room.constant_r2),
            variance_ratio: middle(|room| room.variance_ratio),
            ..first
        }))
    }
}

//! Poincaré adapters: features to latents, pairs of latents to camera motions, and camera motions
//! to steps in latent space.
//!
//! - φ is a small network (d → 64 → 20) and W (6×20) a matrix without bias: ΔP ≈ σ ⊙ W(φ(z₂) −
//!   φ(z₁)) + μ. One φ with its W is a chart; a mixture has several, combined by a gating
//!   network or evenly (an ensemble).
//! - μ and σ are the mean and the population standard deviation (ddof 0; A-11 in `docs/paper.md`)
//!   of the training twists, for each component of (v, ω).
//! - Weights are trained and stored in f32; every answer is computed in f64.

mod attention;
mod corrector;
mod error_model;
mod inverse;
mod layers;
mod loss;
mod mixture;
mod network;
mod phi;
mod preset;
mod real;
mod record;
mod relational;
mod samples;
mod seeded;
mod siamese;
mod train;
mod trained;
mod whitener;

pub use corrector::{Corrector, CorrectorKind, CorrectorSamples, train_corrector};
pub use error_model::{ErrorModel, ErrorStatistics, ErrorTable, Stratum, TEMPORAL_NEIGHBORS};
pub use inverse::{Inverse, Reading};
pub use loss::Loss;
pub use mixture::{Mixing, Mixture, ROUTE_DIM};
pub use network::{At, Network, Objective};
pub use phi::{Phi, Widths};
pub use preset::{PairPlan, Preset};
pub use real::Real;
pub use record::TrainingRecord;
pub use relational::{
    CellLayout, Cells, MAX_MEMBERS, MotionReading, PAIRS_PER_EPOCH, PairSampler, RelationalConfig,
    RelationalNetwork, RelationalReader, RelationalSamples, RoomFrames, train_relational,
};
pub use samples::{Samples, column_scale};
pub use siamese::{Siamese, TENSOR_NAMES};
pub use train::{EpochProgress, StepReport, TrainConfig, Trainer, train, train_further};
pub use trained::{Adapter, Gating};
pub use whitener::Whitener;

/// Layers and training loop for the comparison networks of `seese3-lab`.
pub mod building_blocks {
    pub use super::layers::{Dense, DenseActivations};
    pub use super::phi::Activations as PhiActivations;
    pub use super::samples::Batch;
    pub use super::seeded::Seeded;
    pub use super::train::fit;
}

use nalgebra::Vector6;

use crate::cancel;
use crate::geometry::Twist;

/// Largest accepted magnitude of a number in a latent: far above what adapters produce and far
/// below overflow.
pub const MAX_LATENT: f64 = 1e6;

/// Maximum number of charts in an adapter.
pub const MAX_CHARTS: usize = 16;

/// Default width of a chart's latent, the paper's geo_dim.
pub const LATENT_DIM: usize = 20;

/// Errors of an adapter, its input or its training.
#[derive(Debug, Clone, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("features have {actual} columns, the adapter was trained on {expected}")]
    FeatureDim { expected: usize, actual: usize },
    #[error("features come from '{actual}', the adapter was trained on '{expected}'")]
    FeatureSource { expected: String, actual: String },
    #[error("latent has {actual} numbers, the adapter's latents have {expected}")]
    LatentDim { expected: usize, actual: usize },
    #[error("latent, number {position} is {value:e}; its magnitude is limited to {MAX_LATENT:e}")]
    LatentRange { position: usize, value: f64 },
    #[error("{what}, number {position} is {value}; every number must be finite")]
    NotFinite {
        what: &'static str,
        position: usize,
        value: f64,
    },
    #[error(
        "latent: the gate weight of chart {chart} is {value}; gate weights must lie between 0 and 1, \
        add up to 1, and be equal in an ensemble"
    )]
    Gate { chart: usize, value: f64 },
    #[error("an adapter has 1 to {MAX_CHARTS} charts, not {count}")]
    Charts { count: usize },
    #[error(
        "features '{name}' are pooled by '{pooling}'; a relational reader compares cells, so it needs \
         features of a grid of four or more cells (encode --pool grid4x4)"
    )]
    NotAGrid { name: String, pooling: String },
    #[error("a relational reader has 1 to {MAX_MEMBERS} members, not {count}")]
    Members { count: usize },
    #[error("the adapter has no relational reader (train --reader relational)")]
    NoRelational,
    #[error("the adapter has no corrector '{name}' (train --correctors); it has {known}")]
    NoCorrector { name: &'static str, known: String },
    #[error(
        "charts mixed by a gate have no single matrix from latents to motions; choose another \
        metric, or train with --mixing even"
    )]
    GatedMotion,
    #[error("whitening takes latents of at most {most} columns, these have {actual}")]
    WhitenedColumns { actual: usize, most: usize },
    #[error("features cannot be standardized for charts mixed by a gate; use --mixing even")]
    GatedStandardized,
    #[error("the covariance of an adapter's errors must be symmetric and positive definite")]
    ErrorCovariance,
    #[error(
        "{what} in an adapter's calibration is invalid: not finite, out of range, not in rising \
        order or not positive definite"
    )]
    ErrorModel { what: &'static str },
    #[error(
        "the adapter is not calibrated: its errors were not measured in rooms outside its training \
        set (train --calibrate-on)"
    )]
    NoErrorCovariance,
    #[error("corrector '{name}' was given twice")]
    CorrectorTwice { name: &'static str },
    #[error("adapter weights are not finite in '{tensor}'")]
    WeightsNotFinite { tensor: String },
    #[error("adapter tensor '{tensor}' has shape {actual:?}, expected {expected:?}")]
    WeightShape {
        tensor: String,
        expected: Vec<usize>,
        actual: Vec<usize>,
    },
    #[error(
        "the standard deviation of twist component {component} is {value}; it must be finite and \
        positive"
    )]
    Deviation { component: usize, value: f64 },
    #[error(
        "W has rank {rank} (singular values {largest:.3e} to {smallest:.3e}), 6 are needed to invert it: \
         the training motions do not span all six directions"
    )]
    RankDeficient {
        rank: usize,
        largest: f64,
        smallest: f64,
    },
    #[error("no training pairs")]
    NoPairs,
    #[error(
        "all training pairs have the same camera motion; training needs pairs with different motions"
    )]
    NoMotion,
    #[error("training diverged in epoch {epoch}: the loss is {loss}; lower the learning rate")]
    Diverged { epoch: usize, loss: f64 },
    #[error(transparent)]
    Cancelled(#[from] cancel::Cancelled),
}

/// A twist component with a standard deviation below this (meters or radians) is constant up to
/// rounding.
const STILL: f64 = 1e-9;

/// Mean and standard deviation of the training twists, per component of (v, ω), meters and radians.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetScale {
    /// μ, zero under [`TargetScale::about_zero`].
    pub mean: Vector6<f64>,
    /// σ: the population standard deviation (ddof 0), or the root mean square under
    /// [`TargetScale::about_zero`].
    pub deviation: Vector6<f64>,
}

impl TargetScale {
    /// Mean and standard deviation of `twists`. A component that is constant up to rounding gets
    /// deviation 1, so that z-scoring does not amplify rounding errors.
    pub fn of(twists: &[Twist]) -> Self {
        let n = twists.len().max(1) as f64;
        let mean = twists
            .iter()
            .map(|twist| twist.to_vector())
            .sum::<Vector6<f64>>()
            / n;
        let square = |twist: &Twist| (twist.to_vector() - mean).map(|x| x * x);

        let variance = twists.iter().map(square).sum::<Vector6<f64>>() / n;
        Self {
            mean,
            deviation: variance.map(|x| if x.sqrt() > STILL { x.sqrt() } else { 1.0 }),
        }
    }

    /// μ = 0 and σ the root mean square of `twists`, so that the z-score of zero motion is zero. A
    /// component that is zero up to rounding gets σ = 1.
    pub fn about_zero(twists: &[Twist]) -> Self {
        let n = twists.len().max(1) as f64;
        let square = twists
            .iter()
            .map(|twist| twist.to_vector().map(|x| x * x))
            .sum::<Vector6<f64>>()
            / n;

        Self {
            mean: Vector6::zeros(),
            deviation: square.map(|x| if x.sqrt() > STILL { x.sqrt() } else { 1.0 }),
        }
    }

    /// The z-scored motion, (ΔP − μ) / σ.
    pub fn normalized(&self, twist: Twist) -> Vector6<f64> {
        (twist.to_vector() - self.mean).component_div(&self.deviation)
    }

    /// The motion with the z-score y, σ ⊙ y + μ.
    pub fn twist(&self, normalized: &Vector6<f64>) -> Twist {
        Twist::from_vector(&(normalized.component_mul(&self.deviation) + self.mean))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. A wheeled robot moves in x and z and turns about y; the other components
    /// are rounding errors.
    #[test]
    fn a_planar_robots_rounding_is_not_blown_up_to_motion() {
        let step = |i: f64| Twist {
            linear: [i, 1e-17 * i, -i].into(),
            angular: [0.0, 2.0 * i, 1e-16].into(),
        };
        let scale = TargetScale::of(&[step(-1.0), step(1.0)]);

        assert_eq!(scale.deviation.as_slice(), [1.0, 1.0, 1.0, 1.0, 2.0, 1.0]);
    }
}

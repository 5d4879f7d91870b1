//! Poincaré adapters: features to latents, latents to twists, and twists back to latent steps.
//!
//! - φ is a small network (d → 64 → 20); W (6×20) has no bias. ΔP ≈ σ ⊙ W(φ(z₂) − φ(z₁)) + μ. A
//!   mixture has several such charts and a gate.
//! - μ and σ are the mean and the population deviation (ddof 0, A-11) of the training twists, by
//!   component, (v, ω).
//! - Weights are f32, as trained; every answer is computed in f64.

mod attention;
mod calibration;
mod corrector;
mod inverse;
mod layers;
mod loss;
mod mixture;
mod network;
mod phi;
mod preset;
mod real;
mod record;
mod samples;
mod seeded;
mod siamese;
mod train;
mod trained;

pub use calibration::{
    BESIDE, Calibration, ELLIPSOIDS, ErrorTable, Measured, Metric, MotionErrors, RECENT, Stratum,
};
pub use corrector::{Corrector, CorrectorKind, CorrectorSamples, train_corrector};
pub use inverse::{Inverse, Reading};
pub use layers::Dense;
pub use loss::Loss;
pub use mixture::{Mixing, Mixture, ROUTE_DIM};
pub use network::{At, Network, Objective};
pub use phi::{Phi, Widths};
pub use preset::{PairPlan, Preset};
pub use real::Real;
pub use record::TrainingRecord;
pub use samples::Samples;
pub(crate) use seeded::Seeded;
pub use siamese::{Siamese, TENSOR_NAMES};
pub(crate) use train::fit;
pub use train::{EpochProgress, StepReport, TrainConfig, Trainer, train};
pub use trained::Adapter;

use nalgebra::Vector6;

use crate::geometry::Twist;

/// The largest number that a latent may hold: far over any that an adapter makes, far under what
/// overflows.
pub const MAX_LATENT: f64 = 1e6;

/// The most charts of an adapter.
pub const MAX_CHARTS: usize = 16;

/// Columns of a chart's latent, the paper's geo_dim.
pub const LATENT_DIM: usize = 20;

/// What is wrong with an adapter, its input or its training.
#[derive(Debug, Clone, thiserror::Error, PartialEq)]
pub enum Error {
    #[error("features have {actual} columns, the adapter was trained on {expected}")]
    FeatureDim { expected: usize, actual: usize },
    #[error("features come from '{actual}', the adapter was trained on '{expected}'")]
    FeatureSource { expected: String, actual: String },
    #[error("latent has {actual} numbers, the adapter's latents have {expected}")]
    LatentDim { expected: usize, actual: usize },
    #[error("latent, number {position} is {value:e}, over the limit of {MAX_LATENT:e}")]
    LatentRange { position: usize, value: f64 },
    #[error("{what}, number {position} is {value}; every number must be finite")]
    NotFinite {
        what: &'static str,
        position: usize,
        value: f64,
    },
    #[error(
        "latent: the gate's share of chart {chart} is {value}; shares must be 0 to 1 and add up to 1"
    )]
    Gate { chart: usize, value: f64 },
    #[error("an adapter has 1 to {MAX_CHARTS} charts, not {count}")]
    Charts { count: usize },
    #[error("the adapter has no corrector '{name}' (train --correctors); it has {known}")]
    NoCorrector { name: &'static str, known: String },
    #[error(
        "charts under a gate have no one matrix from latents to motions; take another metric, or mix them evenly"
    )]
    GatedMotion,
    #[error("whitening takes latents of at most {most} columns, these have {actual}")]
    WhitenedColumns { actual: usize, most: usize },
    #[error("features cannot be z-scored for charts under a gate; mix them evenly")]
    GatedStandardised,
    #[error("the covariance of an adapter's errors must be symmetric and positive definite")]
    ErrorCovariance,
    #[error(
        "{what} of an adapter's calibration is not sound: not finite, not rising or not positive definite"
    )]
    Calibration { what: &'static str },
    #[error(
        "the adapter's errors were not measured in rooms that it did not learn from (train --calibrate-on)"
    )]
    NotCalibrated,
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
        "the deviation of twist component {component} is {value}; it must be finite and positive"
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
        "the camera moves alike in all training pairs: there is nothing to learn a motion from"
    )]
    NoMotion,
    #[error("training diverged in epoch {epoch}: the loss is {loss}; lower the learning rate")]
    Diverged { epoch: usize, loss: f64 },
}

/// A component of the motions that deviates by less, metres or radians, does not move: it is
/// rounding.
const STILL: f64 = 1e-9;

/// Mean and deviation of the training twists, by component (v, ω): metres and radians.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetScale {
    /// μ.
    pub mean: Vector6<f64>,
    /// σ, population (ddof 0).
    pub deviation: Vector6<f64>,
}

impl TargetScale {
    /// The scale of `twists`; a component that moves by no more than rounding gets deviation 1, so
    /// that it stays at zero.
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

    /// μ = 0 and σ the root mean square, so that zero motion is zero.
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

    /// (ΔP − μ) / σ.
    pub fn normalised(&self, twist: Twist) -> Vector6<f64> {
        (twist.to_vector() - self.mean).component_div(&self.deviation)
    }

    /// σ ⊙ y + μ.
    pub fn twist(&self, normalised: &Vector6<f64>) -> Twist {
        Twist::from_vector(&(normalised.component_mul(&self.deviation) + self.mean))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. A wheeled robot moves in x, z and about y; what rounding leaves of the rest
    /// is no motion.
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

//! Poincaré adapters: features to latents, latents to twists, and twists back to latent steps.
//!
//! - φ is a small network (d → 64 → 20); W (6×20) has no bias. ΔP ≈ σ ⊙ W(φ(z₂) − φ(z₁)) + μ.
//! - μ and σ are the mean and the population deviation (ddof 0, A-11) of the training twists, by component, (v, ω).
//! - Weights are f32, as trained; every answer is computed in f64.

mod inverse;
mod loss;
mod preset;
mod real;
mod record;
mod seeded;
mod siamese;
mod train;

pub use inverse::{Inverse, Reading};
pub use loss::mean_squared_error;
pub use preset::{PairPlan, Preset};
pub use real::Real;
pub use record::TrainingRecord;
pub use siamese::{Siamese, TENSOR_NAMES, Widths};
pub use train::{EpochProgress, Samples, StepReport, TrainConfig, Trainer, train};

use nalgebra::Vector6;
use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis};

use crate::features::FeatureSource;
use crate::geometry::Twist;

/// The largest number that a latent may hold: far over any that an adapter makes, far under what overflows.
pub const MAX_LATENT: f64 = 1e6;

/// Rows embedded at a time, so that memory stays flat with the size of a room.
const EMBED_ROWS: usize = 1_024;

/// Columns of a latent, the paper's geo_dim.
pub const LATENT_DIM: usize = 20;

/// What is wrong with an adapter, its input or its training.
#[derive(Debug, thiserror::Error, PartialEq)]
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
    NotFinite { what: &'static str, position: usize, value: f64 },
    #[error("adapter weights are not finite in '{tensor}'")]
    WeightsNotFinite { tensor: &'static str },
    #[error("adapter tensor '{tensor}' has shape {actual:?}, expected {expected:?}")]
    WeightShape { tensor: &'static str, expected: Vec<usize>, actual: Vec<usize> },
    #[error("the deviation of twist component {component} is {value}; it must be finite and positive")]
    Deviation { component: usize, value: f64 },
    #[error(
        "W has rank {rank} (singular values {largest:.3e} to {smallest:.3e}), 6 are needed to invert it: \
         the training motions do not span all six directions"
    )]
    RankDeficient { rank: usize, largest: f64, smallest: f64 },
    #[error("no training pairs")]
    NoPairs,
    #[error("the camera moves alike in all training pairs: there is nothing to learn a motion from")]
    NoMotion,
    #[error("training diverged in epoch {epoch}: the loss is {loss}; lower the learning rate")]
    Diverged { epoch: usize, loss: f64 },
}

/// A component of the motions that deviates by less, metres or radians, does not move: it is rounding.
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
    /// The scale of `twists`; a component that moves by no more than rounding gets deviation 1, so that it stays at
    /// zero.
    pub fn of(twists: &[Twist]) -> Self {
        let n = twists.len().max(1) as f64;
        let mean = twists.iter().map(|twist| twist.to_vector()).sum::<Vector6<f64>>() / n;
        let square = |twist: &Twist| (twist.to_vector() - mean).map(|x| x * x);
        let variance = twists.iter().map(square).sum::<Vector6<f64>>() / n;
        Self { mean, deviation: variance.map(|x| if x.sqrt() > STILL { x.sqrt() } else { 1.0 }) }
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

/// A trained adapter. Immutable; refuses features of another source.
#[derive(Debug, Clone)]
pub struct Adapter {
    source: FeatureSource,
    network: Siamese<f32>,
    network_f64: Siamese<f64>,
    scale: TargetScale,
    inverse: Inverse,
}

impl Adapter {
    /// Checks trained weights and prepares W⁺.
    ///
    /// # Errors
    /// [`Error::FeatureDim`], [`Error::WeightsNotFinite`], [`Error::Deviation`] or [`Error::RankDeficient`].
    pub fn new(source: FeatureSource, network: Siamese<f32>, scale: TargetScale) -> Result<Self, Error> {
        if network.feature_dim() != source.dim {
            return Err(Error::FeatureDim { expected: network.feature_dim(), actual: source.dim });
        }
        network.check_finite()?;
        for (component, &value) in scale.deviation.iter().enumerate() {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::Deviation { component, value });
            }
        }
        if let Some(position) = scale.mean.iter().position(|x| !x.is_finite()) {
            return Err(Error::NotFinite { what: "target mean", position, value: scale.mean[position] });
        }
        let network_f64 = network.cast::<f64>();
        let inverse = Inverse::new(network_f64.motion_matrix(), &scale)?;
        Ok(Self { source, network, network_f64, scale, inverse })
    }

    /// The features it was trained on.
    pub fn source(&self) -> &FeatureSource {
        &self.source
    }

    /// The trained weights.
    pub fn network(&self) -> &Siamese<f32> {
        &self.network
    }

    /// μ and σ of the training twists.
    pub fn scale(&self) -> &TargetScale {
        &self.scale
    }

    /// W⁺ in its three readings.
    pub fn inverse(&self) -> &Inverse {
        &self.inverse
    }

    /// Columns of its latents.
    pub fn latent_dim(&self) -> usize {
        self.network.latent_dim()
    }

    /// Refuses features of another source.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] or [`Error::FeatureSource`].
    pub fn check_source(&self, source: &FeatureSource) -> Result<(), Error> {
        if source.dim != self.source.dim {
            return Err(Error::FeatureDim { expected: self.source.dim, actual: source.dim });
        }
        if !source.is_like(&self.source) {
            return Err(Error::FeatureSource { expected: describe(&self.source), actual: describe(source) });
        }
        Ok(())
    }

    /// Latents φ(z) of feature rows: shape (n, d) in, (n, k) out.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] or [`Error::NotFinite`].
    ///
    /// Source: SeeSE3, sec. 2.4.
    pub fn embed(&self, features: ArrayView2<'_, f32>) -> Result<Array2<f64>, Error> {
        if features.ncols() != self.source.dim {
            return Err(Error::FeatureDim { expected: self.source.dim, actual: features.ncols() });
        }
        if let Some(((_, position), &value)) = features.indexed_iter().find(|(_, value)| !value.is_finite()) {
            return Err(Error::NotFinite { what: "feature", position, value: f64::from(value) });
        }
        let mut latents = Array2::zeros((features.nrows(), self.latent_dim()));
        let chunks = features.axis_chunks_iter(Axis(0), EMBED_ROWS);
        for (rows, mut out) in chunks.zip(latents.axis_chunks_iter_mut(Axis(0), EMBED_ROWS)) {
            out.assign(&self.network_f64.embed(rows.mapv(f64::from)));
        }
        Ok(latents)
    }

    /// The latent φ(z) of one feature.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] or [`Error::NotFinite`].
    pub fn embed_one(&self, feature: &[f32]) -> Result<Array1<f64>, Error> {
        let row = ArrayView1::from(feature);
        Ok(self.embed(row.insert_axis(Axis(0)))?.row(0).to_owned())
    }

    /// The camera's motion between two latents, ΔP = σ ⊙ W(g₂ − g₁) + μ, in the first camera's body frame.
    ///
    /// Source: SeeSE3, sec. 2.4; targets un-normalised.
    pub fn motion(&self, from: ArrayView1<'_, f64>, to: ArrayView1<'_, f64>) -> Twist {
        let normalised = self.network_f64.motion_matrix().dot(&(&to - &from));
        self.scale.twist(&Vector6::from_fn(|row, _| normalised[row]))
    }

    /// Refuses a latent of the wrong width or with a number that is not finite.
    ///
    /// # Errors
    /// [`Error::LatentDim`], [`Error::NotFinite`] or [`Error::LatentRange`].
    pub fn check_latent(&self, latent: &[f64]) -> Result<(), Error> {
        if latent.len() != self.latent_dim() {
            return Err(Error::LatentDim { expected: self.latent_dim(), actual: latent.len() });
        }
        if let Some(position) = latent.iter().position(|x| !x.is_finite()) {
            return Err(Error::NotFinite { what: "latent", position, value: latent[position] });
        }
        match latent.iter().position(|x| x.abs() > MAX_LATENT) {
            Some(position) => Err(Error::LatentRange { position, value: latent[position] }),
            None => Ok(()),
        }
    }
}

/// A source in words, enough to see which of its parts differ.
fn describe(source: &FeatureSource) -> String {
    let FeatureSource { name, encoder, layer, base, norm, pooling, preprocess, dim } = source;
    format!(
        "{name} (encoder {encoder}, layer {layer}, base {base}, norm {norm}, pooling {pooling}, \
         preprocess {preprocess}, {dim} columns)"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. A wheeled robot moves in x, z and about y; what rounding leaves of the rest is no motion.
    #[test]
    fn a_planar_robots_rounding_is_not_blown_up_to_motion() {
        let step = |i: f64| Twist { linear: [i, 1e-17 * i, -i].into(), angular: [0.0, 2.0 * i, 1e-16].into() };
        let scale = TargetScale::of(&[step(-1.0), step(1.0)]);
        assert_eq!(scale.deviation.as_slice(), [1.0, 1.0, 1.0, 1.0, 2.0, 1.0]);
    }
}

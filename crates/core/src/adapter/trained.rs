//! A trained adapter.

use std::sync::Arc;

use nalgebra::{Matrix6, Vector6};
use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis, s};

use super::inverse::{pseudo_inverse, target};
use super::{
    Corrector, CorrectorKind, Error, ErrorModel, Inverse, MAX_LATENT, Mixing, Mixture, Network,
    Reading, RelationalReader, TargetScale,
};
use crate::features::FeatureSource;
use crate::geometry::Twist;

/// Rows embedded at a time, which bounds the memory of intermediate results.
const EMBED_ROWS: usize = 1_024;
/// Tolerance of the gate weights: of their sum from 1, and of each weight of an ensemble from 1/K.
const GATE_TOLERANCE: f64 = 1e-6;

/// A trained adapter for features of one source. Immutable.
#[derive(Debug, Clone)]
pub struct Adapter {
    source: FeatureSource,
    network: Mixture<f32>,
    network_f64: Mixture<f64>,
    scale: TargetScale,
    inverse: Inverse,
    correctors: Vec<(Corrector<f32>, Corrector<f64>)>,
    error_covariance: Option<Matrix6<f64>>,
    error_model: Option<Arc<ErrorModel>>,
    relational: Option<Arc<RelationalReader>>,
}

impl Adapter {
    /// Validates trained weights and computes W⁺.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] when the widths of network and source differ,
    /// [`Error::WeightsNotFinite`] or [`Error::NotFinite`] when a weight or a component of μ is not
    /// finite, [`Error::Deviation`] when a component of σ is not finite and positive, and
    /// [`Error::RankDeficient`] when a chart's W does not have rank 6.
    pub fn new(
        source: FeatureSource,
        network: impl Into<Mixture<f32>>,
        scale: TargetScale,
    ) -> Result<Self, Error> {
        let network = network.into();
        if network.feature_dim() != source.dim {
            return Err(Error::FeatureDim {
                expected: network.feature_dim(),
                actual: source.dim,
            });
        }

        if let Some(tensor) = network.not_finite() {
            return Err(Error::WeightsNotFinite { tensor });
        }

        for (component, &value) in scale.deviation.iter().enumerate() {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::Deviation { component, value });
            }
        }

        if let Some(position) = scale.mean.iter().position(|x| !x.is_finite()) {
            return Err(Error::NotFinite {
                what: "target mean",
                position,
                value: scale.mean[position],
            });
        }

        let network_f64 = network.cast::<f64>();

        // A gate can give nearly all weight to one chart, so each chart's W must have rank 6.
        for chart in network_f64.charts() {
            Inverse::new(chart.motion_matrix(), &scale)?;
        }

        // With a gate, this is the inverse at equal weights; `step` computes the one at the
        // source's gate weights.
        let inverse = Inverse::new(
            network_f64
                .motion_matrix(network_f64.even_gate().view())
                .view(),
            &scale,
        )?;

        Ok(Self {
            source,
            network,
            network_f64,
            scale,
            inverse,
            correctors: Vec::new(),
            error_covariance: None,
            error_model: None,
            relational: None,
        })
    }

    /// The same adapter with `correctors`, at most one of each kind.
    ///
    /// # Errors
    /// [`Error::CorrectorTwice`] when two are of the same kind, [`Error::WeightsNotFinite`] when a
    /// weight is not finite, or [`Error::WeightShape`] when a corrector does not fit the adapter's
    /// latents.
    pub fn with_correctors(mut self, correctors: Vec<Corrector<f32>>) -> Result<Self, Error> {
        for corrector in correctors {
            let name = corrector.kind().name();
            if self.corrector(corrector.kind()).is_ok() {
                return Err(Error::CorrectorTwice { name });
            }

            corrector.check(self.network.coordinate_count())?;
            let precise = corrector.cast::<f64>();
            self.correctors.push((corrector, precise));
        }

        Ok(self)
    }

    /// The same adapter with its error covariance: the second moment Σ = mean r rᵀ of r = ΔP −
    /// σ⊙W(g₂ − g₁) on (v, ω), meters and radians, measured in rooms outside the training set.
    ///
    /// # Errors
    /// [`Error::ErrorCovariance`] when Σ is not symmetric and positive definite.
    pub fn with_error_covariance(mut self, covariance: Matrix6<f64>) -> Result<Self, Error> {
        let symmetric = (covariance - covariance.transpose()).amax() <= 1e-9 * covariance.amax();
        if !symmetric || covariance.cholesky().is_none() {
            return Err(Error::ErrorCovariance);
        }

        self.error_covariance = Some(covariance);
        Ok(self)
    }

    /// The error covariance on (v, ω), meters and radians, if measured: the second moment of the
    /// errors.
    pub fn error_covariance(&self) -> Option<Matrix6<f64>> {
        self.error_covariance
    }

    /// The same adapter with the error model that a tracker needs.
    ///
    /// # Errors
    /// [`Error::ErrorModel`] when the error model is for latents of another width.
    pub fn with_error_model(mut self, error_model: ErrorModel) -> Result<Self, Error> {
        if error_model.frame_noise().size() != self.coordinate_count() {
            return Err(Error::ErrorModel {
                what: "the size of a covariance of latents",
            });
        }

        self.error_model = Some(Arc::new(error_model));
        Ok(self)
    }

    /// The error model, if the adapter has one.
    pub fn error_model(&self) -> Option<&Arc<ErrorModel>> {
        self.error_model.as_ref()
    }

    /// The same adapter with a relational reader of the same features.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] if the reader is for features of another width.
    pub fn with_relational(mut self, reader: RelationalReader) -> Result<Self, Error> {
        if reader.feature_dim() != self.source.dim {
            return Err(Error::FeatureDim {
                expected: self.source.dim,
                actual: reader.feature_dim(),
            });
        }

        self.relational = Some(Arc::new(reader));
        Ok(self)
    }

    /// The relational reader, if the adapter has one.
    pub fn relational(&self) -> Option<&Arc<RelationalReader>> {
        self.relational.as_ref()
    }

    /// The source of the features that the adapter was trained on.
    pub fn source(&self) -> &FeatureSource {
        &self.source
    }

    /// The trained weights.
    pub fn network(&self) -> &Mixture<f32> {
        &self.network
    }

    /// The trained correctors.
    pub fn correctors(&self) -> impl Iterator<Item = &Corrector<f32>> {
        self.correctors.iter().map(|(corrector, _)| corrector)
    }

    /// μ and σ of the training twists.
    pub fn scale(&self) -> &TargetScale {
        &self.scale
    }

    /// W⁺ in its three readings; for a mixture, at equal gate weights.
    pub fn inverse(&self) -> &Inverse {
        &self.inverse
    }

    /// Columns of a latent: the coordinates and, with several charts, one gate weight per chart.
    pub fn latent_dim(&self) -> usize {
        self.network.latent_dim()
    }

    /// Number of coordinates of a latent: the columns that distances are computed on.
    pub fn coordinate_count(&self) -> usize {
        self.network.coordinate_count()
    }

    /// W of each chart, shape (6, k).
    pub fn motion_matrices(&self) -> Vec<ArrayView2<'_, f64>> {
        self.network_f64
            .charts()
            .iter()
            .map(super::Siamese::motion_matrix)
            .collect()
    }

    /// σ ⊙ W, shape (6, [`Adapter::coordinate_count`]): a motion is this matrix times the
    /// difference of two latents, plus μ. For an ensemble it is σ ⊙ W̄.
    ///
    /// # Errors
    /// [`Error::GatedMotion`] for charts with a gate: their matrix depends on the source frame.
    pub fn motion_of_coordinates(&self) -> Result<Array2<f64>, Error> {
        if self.network.chart_count() > 1 && self.network.mixing() == Mixing::Gate {
            return Err(Error::GatedMotion);
        }

        let mut matrix = self
            .network_f64
            .motion_matrix(self.network_f64.even_gate().view());
        for (mut row, &deviation) in matrix.outer_iter_mut().zip(self.scale.deviation.iter()) {
            row *= deviation;
        }

        Ok(matrix)
    }

    /// How a gate mixes the charts for these features, shape (n, d), n > 0. `None` without a gate.
    ///
    /// # Errors
    /// The errors of [`Adapter::embed`].
    pub fn gating(&self, features: ArrayView2<'_, f32>) -> Result<Option<Gating>, Error> {
        let Some(temperature) = self.network_f64.temperature() else {
            return Ok(None);
        };

        let latents = self.embed(features)?;
        let gates = latents.slice(s![.., self.coordinate_count()..]);
        Ok(Some(Gating::of(temperature, gates)))
    }

    /// Refuses features from a source that differs from the training source.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] when the widths differ, [`Error::FeatureSource`] when any other part
    /// of the source differs.
    pub fn check_source(&self, source: &FeatureSource) -> Result<(), Error> {
        if source.dim != self.source.dim {
            return Err(Error::FeatureDim {
                expected: self.source.dim,
                actual: source.dim,
            });
        }

        if !source.is_like(&self.source) {
            return Err(Error::FeatureSource {
                expected: describe(&self.source),
                actual: describe(source),
            });
        }

        Ok(())
    }

    /// Latents φ(z) of feature rows: shape (n, d) in, (n, [`Adapter::latent_dim`]) out.
    ///
    /// # Errors
    /// [`Error::FeatureDim`] when the width is not the trained one, [`Error::NotFinite`] when a
    /// number is not finite.
    ///
    /// Source: SeeSE3, Eq. 3.
    pub fn embed(&self, features: ArrayView2<'_, f32>) -> Result<Array2<f64>, Error> {
        if features.ncols() != self.source.dim {
            return Err(Error::FeatureDim {
                expected: self.source.dim,
                actual: features.ncols(),
            });
        }

        if let Some(latent) = self.embed_single(features) {
            return Ok(latent);
        }

        if let Some(((_, position), &value)) = features
            .indexed_iter()
            .find(|(_, value)| !value.is_finite())
        {
            return Err(Error::NotFinite {
                what: "feature",
                position,
                value: f64::from(value),
            });
        }

        let mut latents = Array2::zeros((features.nrows(), self.latent_dim()));
        let chunks = features.axis_chunks_iter(Axis(0), EMBED_ROWS);
        for (rows, mut out) in chunks.zip(latents.axis_chunks_iter_mut(Axis(0), EMBED_ROWS)) {
            out.assign(&self.network_f64.embed(rows.mapv(f64::from)));
        }

        Ok(latents)
    }

    /// The latent of a single feature by a single chart: the weights of the first layer, most of a request's
    /// memory, are read in f32. `None` for others, and if a number is not finite.
    fn embed_single(&self, features: ArrayView2<'_, f32>) -> Option<Array2<f64>> {
        let ([chart], [wide]) = (self.network.charts(), self.network_f64.charts()) else {
            return None;
        };
        let feature = features.as_slice().filter(|_| features.nrows() == 1)?;
        chart.phi.of_one(&wide.phi, feature)
    }

    /// The latent φ(z) of one feature.
    ///
    /// # Errors
    /// The errors of [`Adapter::embed`].
    pub fn embed_one(&self, feature: &[f32]) -> Result<Array1<f64>, Error> {
        let row = ArrayView1::from(feature);
        Ok(self.embed(row.insert_axis(Axis(0)))?.row(0).to_owned())
    }

    /// Predicted camera motion between two latents, ΔP = σ ⊙ W(g₂ − g₁) + μ, in the body frame of
    /// the first camera. A mixture uses the gate weights of the first latent.
    ///
    /// Source: SeeSE3, Eq. 3, with the z-scoring of the targets undone.
    pub fn motion(&self, from: ArrayView1<'_, f64>, to: ArrayView1<'_, f64>) -> Twist {
        let normalized = match self.network_f64.charts() {
            [chart] => chart.motion_matrix().dot(&(&to - &from)),
            _ => {
                let coordinates = s![..self.coordinate_count()];
                let step = &to.slice(coordinates) - &from.slice(coordinates);

                self.network_f64
                    .motion_matrix(self.network_f64.gate_of(from).view())
                    .dot(&step)
            }
        };

        self.scale
            .twist(&Vector6::from_fn(|row, _| normalized[row]))
    }

    /// [`Adapter::motion`] without μ: equal latents give zero motion (A-16, homogeneous).
    pub fn motion_without_mean(&self, from: ArrayView1<'_, f64>, to: ArrayView1<'_, f64>) -> Twist {
        Twist::from_vector(&(self.motion(from, to).to_vector() - self.scale.mean))
    }

    /// The latent step of a motion from `latent`, ĝ − g = W⁺ΔP. A mixture keeps the gate weights of
    /// the source. For `mean_share` see [`Inverse::step`].
    ///
    /// Source: SeeSE3, ĝ = φ(z) + W⁺ΔP.
    pub fn step(
        &self,
        latent: ArrayView1<'_, f64>,
        twist: Twist,
        reading: Reading,
        mean_share: f64,
    ) -> Array1<f64> {
        if self.network_f64.chart_count() == 1 || self.network_f64.mixing() == Mixing::Even {
            return self.widened(self.inverse.step(twist, reading, mean_share));
        }

        // The gate weights depend on the source, so the mixed matrix is inverted per query. It has
        // rank 6, because each chart's W has rank 6.
        let mixed = self
            .network_f64
            .motion_matrix(self.network_f64.gate_of(latent).view());
        let (inverse, ..) = pseudo_inverse(mixed.view());

        self.widened(inverse.dot(&target(&self.scale, twist, reading, mean_share)))
    }

    /// The latent step of a motion from `latent` by a corrector. A residual corrector adds its
    /// output to W⁺ΔP in the affine reading; the linear one predicts the target latent, and the
    /// source latent is subtracted. If a motion is divided into parts, call this for each part:
    /// each gets the whole μ, because μ is part of the corrector's input and cannot be divided.
    ///
    /// # Errors
    /// [`Error::NoCorrector`] when the adapter has no corrector of this kind.
    ///
    /// Source: SeeSE3, Sec. A.9; widths and heads are ours.
    pub fn corrected_step(
        &self,
        kind: CorrectorKind,
        latent: ArrayView1<'_, f64>,
        twist: Twist,
    ) -> Result<Array1<f64>, Error> {
        let corrector = self.corrector(kind)?;
        let wanted = target(&self.scale, twist, Reading::Affine, 1.0);
        let here = latent.slice(s![..self.coordinate_count()]);
        let added = corrector.added(here, wanted.view());

        if kind.has_residual() {
            Ok(self.step(latent, twist, Reading::Affine, 1.0) + self.widened(added))
        } else {
            Ok(self.widened(added - here))
        }
    }

    /// Validates a latent: its width, its numbers and its gate weights.
    ///
    /// # Errors
    /// [`Error::LatentDim`] when its width is wrong, [`Error::NotFinite`] when a number is not
    /// finite, [`Error::LatentRange`] when one exceeds [`MAX_LATENT`] in magnitude, or
    /// [`Error::Gate`] when the gate weights are invalid.
    pub fn check_latent(&self, latent: &[f64]) -> Result<(), Error> {
        if latent.len() != self.latent_dim() {
            return Err(Error::LatentDim {
                expected: self.latent_dim(),
                actual: latent.len(),
            });
        }

        if let Some(position) = latent.iter().position(|x| !x.is_finite()) {
            return Err(Error::NotFinite {
                what: "latent",
                position,
                value: latent[position],
            });
        }

        if let Some(position) = latent.iter().position(|x| x.abs() > MAX_LATENT) {
            return Err(Error::LatentRange {
                position,
                value: latent[position],
            });
        }

        // Gate weights lie between 0 and 1 and add up to 1. If only the sum is wrong, the first
        // chart is reported.
        let gate = &latent[self.coordinate_count()..];
        let sum: f64 = gate.iter().sum();
        let off = gate.iter().position(|share| !(0.0..=1.0).contains(share));
        let off = off.or((!gate.is_empty() && (sum - 1.0).abs() > GATE_TOLERANCE).then_some(0));

        // In an ensemble every weight is 1/K.
        let even = (gate.len() as f64).recip();
        let uneven = |share: &f64| {
            self.network.mixing() == Mixing::Even && (share - even).abs() > GATE_TOLERANCE
        };
        let off = off.or(gate.iter().position(uneven));

        match off {
            Some(chart) => Err(Error::Gate {
                chart,
                value: gate[chart],
            }),
            None => Ok(()),
        }
    }

    /// Extends a step of the coordinates to the whole latent; the gate weights do not change.
    fn widened(&self, coordinates: Array1<f64>) -> Array1<f64> {
        if coordinates.len() == self.latent_dim() {
            return coordinates;
        }

        let mut step = Array1::zeros(self.latent_dim());
        step.slice_mut(s![..coordinates.len()]).assign(&coordinates);

        step
    }

    fn corrector(&self, kind: CorrectorKind) -> Result<&Corrector<f64>, Error> {
        let found = self
            .correctors
            .iter()
            .map(|(_, precise)| precise)
            .find(|corrector| corrector.kind() == kind);

        found.ok_or_else(|| {
            let names: Vec<&str> = self
                .correctors
                .iter()
                .map(|(corrector, _)| corrector.kind().name())
                .collect();
            let known = if names.is_empty() {
                "none".to_owned()
            } else {
                names.join(", ")
            };

            Error::NoCorrector {
                name: kind.name(),
                known,
            }
        })
    }
}

/// A source as text, with all its parts.
fn describe(source: &FeatureSource) -> String {
    let FeatureSource {
        name,
        encoder,
        layer,
        base,
        norm,
        pooling,
        preprocess,
        dim,
        parts: _,
    } = source;

    format!(
        "{name} (encoder {encoder}, layer {layer}, base {base}, norm {norm}, pooling {pooling}, \
         preprocess {preprocess}, {dim} columns)"
    )
}

/// How the gate of a mixture mixes its charts.
///
/// Source: SeeSE3, Sec. A.11: a gate whose weights stay equal has learned no charts.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Gating {
    /// The temperature e^τ of the softmax; 1 before training.
    pub temperature: f64,
    /// Mean entropy of a frame's gate weights, in that of equal weights: 1 for equal weights, 0 for
    /// one chart per frame.
    pub entropy: f64,
    /// Mean gate weight of each chart.
    pub mean_weights: Vec<f64>,
    /// Entropy of the mean weights, in that of equal weights: 0 if all frames use one chart.
    pub entropy_of_mean: f64,
}

impl Gating {
    /// Of gate weights, shape (n, K), with n > 0 and K > 1.
    fn of(temperature: f64, gates: ArrayView2<'_, f64>) -> Self {
        let most = (gates.ncols() as f64).ln();
        let entropy = |weights: ArrayView1<'_, f64>| {
            let terms = weights.iter().filter(|weight| **weight > 0.0);
            -terms.map(|weight| weight * weight.ln()).sum::<f64>() / most
        };
        let sum: f64 = gates.outer_iter().map(entropy).sum();
        let count = gates.nrows() as f64;
        let mean = gates.sum_axis(Axis(0)) / count;

        Self {
            temperature,
            entropy: sum / count,
            entropy_of_mean: entropy(mean.view()),
            mean_weights: mean.to_vec(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. One frame uses one chart alone, the other both equally: the entropies 0 and
    /// ln 2 have the mean ½ ln 2, and the mean weights are ¾ and ¼ with the entropy 0.8113 bits.
    #[test]
    fn the_entropy_of_a_gate_is_relative_to_equal_weights() {
        let gates = ndarray::array![[1.0, 0.0], [0.5, 0.5]];
        let found = Gating::of(1.0, gates.view());
        assert!((found.entropy - 0.5).abs() < 1e-12);
        assert_eq!(found.mean_weights, [0.75, 0.25]);
        assert!((found.entropy_of_mean - 0.811_278).abs() < 1e-6);
    }
}

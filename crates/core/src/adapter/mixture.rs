//! Mixtures of charts with a gating network: ΔP ≈ Σ_k α_k(z₁) W_k(φ_k(z₂) − φ_k(z₁)).
//!
//! - α = softmax_k((W_route z)·p_k / e^τ). The gate depends on the source frame alone (Sec. A.11).
//!   A single chart has no gate.
//! - Separately trained charts can form an ensemble with equal weights; then W̄ = \[W_1, …,
//!   W_K\]/K.
//! - Each φ_k is a separate MLP. For K > 1 charts, a latent has K·k coordinates, followed by
//!   the K gate weights α.

use ndarray::{Array1, Array2, ArrayView1, Axis, concatenate, s};
use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::phi::Widths;
use super::seeded::Seeded;
use super::{At, Error, MAX_CHARTS, Network, Objective, Real, Samples, Siamese, TENSOR_NAMES};

/// Dimension r of a prototype. The paper does not give a value.
pub const ROUTE_DIM: usize = 16;
/// PyTorch's names of the gate's tensors.
const GATE_NAMES: [&str; 3] = ["route.weight", "prototypes", "log_tau"];

/// Parameters of the gate: W_route (r, d), the prototypes p (K, r) and τ (1, 1).
#[derive(Debug, Clone, PartialEq)]
struct Gate<T> {
    tensors: [Array2<T>; 3],
}

/// How charts are mixed.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(rename_all = "kebab-case")
)]
pub enum Mixing {
    /// By a gate trained with the charts, as in the paper.
    ///
    /// A single chart has no gate.
    #[default]
    Gate,
    /// By their mean: an ensemble of adapters, each trained for its share of the epochs.
    Even,
}

impl Mixing {
    /// Name on the command line and in a manifest.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// Parameters of one or several charts and their gate.
#[derive(Debug, Clone, PartialEq)]
pub struct Mixture<T> {
    charts: Vec<Siamese<T>>,
    /// `None` for a single chart and for an ensemble.
    gate: Option<Gate<T>>,
}

impl<T: Real> From<Siamese<T>> for Mixture<T> {
    fn from(chart: Siamese<T>) -> Self {
        Self {
            charts: vec![chart],
            gate: None,
        }
    }
}

impl<T: Real> Gate<T> {
    /// Initial weights: W_route as PyTorch draws a `Linear`, prototypes from N(0, 1/r), τ = 0.
    fn random(feature: usize, charts: usize, random: &mut Seeded) -> Self {
        let route = super::layers::uniform(ROUTE_DIM, feature, feature, random);
        let scale = (ROUTE_DIM as f32).sqrt();
        let drawn = random.normal(charts * ROUTE_DIM);
        let prototypes = Array2::from_shape_fn((charts, ROUTE_DIM), |(k, r)| {
            T::of(f64::from(drawn[k * ROUTE_DIM + r] / scale))
        });

        Self {
            tensors: [route, prototypes, Array2::zeros((1, 1))],
        }
    }

    /// The routed features W_route z, and the scores (W_route z)·p / e^τ before the softmax.
    fn scores(&self, features: &Array2<T>) -> (Array2<T>, Array2<T>) {
        let [route, prototypes, log_tau] = &self.tensors;
        let routed = features.dot(&route.t());
        let scores = routed
            .dot(&prototypes.t())
            .mapv(|x| x / log_tau[(0, 0)].exp());

        (routed, scores)
    }
}

fn softmax<T: Real>(mut scores: Array2<T>) -> Array2<T> {
    for mut row in scores.outer_iter_mut() {
        let largest = row.fold(T::neg_infinity(), |a, &b| a.max(b));
        row.mapv_inplace(|x| (x - largest).exp());
        let sum = row.sum();
        row.mapv_inplace(|x| x / sum);
    }

    scores
}

impl<T: Real> Mixture<T> {
    /// The initial weights that PyTorch draws from `seed`: first the charts, then `W_route`, then
    /// the prototypes.
    pub fn initial(widths: Widths, charts: usize, seed: u64) -> Self {
        Self::random(widths, charts, &mut Seeded::new(seed))
    }

    pub(super) fn random(widths: Widths, charts: usize, random: &mut Seeded) -> Self {
        let charts: Vec<_> = (0..charts.max(1))
            .map(|_| Siamese::random(widths, random))
            .collect();
        let gate = (charts.len() > 1).then(|| Gate::random(widths.feature, charts.len(), random));

        Self { charts, gate }
    }

    /// An ensemble of charts of equal shape, with equal weights.
    ///
    /// # Errors
    /// [`Error::WeightShape`] when the charts differ in shape, [`Error::Charts`] when their number
    /// is 0 or above [`MAX_CHARTS`].
    pub fn even(charts: Vec<Siamese<T>>) -> Result<Self, Error> {
        let mixture = Self { charts, gate: None };
        mixture.check_shapes()?;
        Ok(mixture)
    }

    /// Builds a mixture from tensors by their PyTorch names: [`TENSOR_NAMES`] for a single chart,
    /// else `experts.0.phi.0.weight`, …, and with a gate `route.weight`, `prototypes` and
    /// `log_tau`.
    ///
    /// # Errors
    /// The errors of `tensor`, [`Error::Charts`] when `charts` is 0 or above [`MAX_CHARTS`], and
    /// [`Error::WeightShape`] when the shapes of the tensors are inconsistent.
    pub fn from_tensors<E: From<Error>>(
        charts: usize,
        mixing: Mixing,
        mut tensor: impl FnMut(&str) -> Result<Array2<T>, E>,
    ) -> Result<Self, E> {
        if charts == 0 || charts > MAX_CHARTS {
            return Err(Error::Charts { count: charts }.into());
        }

        let mut read = Vec::with_capacity(charts);
        for chart in 0..charts {
            let mut arrays = Vec::with_capacity(TENSOR_NAMES.len());
            for name in TENSOR_NAMES {
                arrays.push(tensor(&chart_name(charts, chart, name))?);
            }

            let arrays =
                <[Array2<T>; 7]>::try_from(arrays).map_err(|_| Error::Charts { count: charts })?;
            read.push(Siamese::from_tensors(arrays)?);
        }

        // A single chart and an ensemble have no gate.
        let gate = match (charts, mixing) {
            (0 | 1, _) | (_, Mixing::Even) => None,
            _ => {
                let [route, prototypes, log_tau] = GATE_NAMES;
                Some(Gate {
                    tensors: [tensor(route)?, tensor(prototypes)?, tensor(log_tau)?],
                })
            }
        };

        let network = Self { charts: read, gate };
        network.check_shapes()?;

        Ok(network)
    }

    fn check_shapes(&self) -> Result<(), Error> {
        let count = self.charts.len();
        let Some(first) = self.charts.first().filter(|_| count <= MAX_CHARTS) else {
            return Err(Error::Charts { count });
        };
        let feature = first.feature_dim();

        let latent = first.latent_dim();

        // The layout of a latent assumes that all charts have the first chart's width.
        for (position, chart) in self.charts.iter().enumerate() {
            if (chart.feature_dim(), chart.latent_dim()) != (feature, latent) {
                let tensor = chart_name(self.charts.len(), position, "phi");
                let actual = vec![chart.feature_dim(), chart.latent_dim()];

                return Err(Error::WeightShape {
                    tensor,
                    expected: vec![feature, latent],
                    actual,
                });
            }
        }

        let Some(Gate { tensors }) = &self.gate else {
            return Ok(());
        };

        // r is the number of rows of W_route; there is one prototype of dimension r per chart.
        let route = tensors[0].nrows();
        let expected = [(route, feature), (self.charts.len(), route), (1, 1)];

        for ((tensor, array), expected) in GATE_NAMES.into_iter().zip(tensors).zip(expected) {
            if array.dim() != expected || array.is_empty() {
                let tensor = tensor.to_owned();
                let expected = vec![expected.0, expected.1];

                return Err(Error::WeightShape {
                    tensor,
                    expected,
                    actual: array.shape().to_vec(),
                });
            }
        }

        Ok(())
    }

    /// Converts charts trained on (z − mean)/deviation, each (1, d), to charts for z. A gate has no
    /// bias that could absorb the mean, so training refuses this combination with
    /// [`Error::GatedStandardized`].
    pub(super) fn fold_standardization(&mut self, mean: &Array2<T>, deviation: &Array2<T>) {
        for chart in &mut self.charts {
            chart.phi.fold_standardization(mean, deviation);
        }
    }

    /// Undoes [`Mixture::fold_standardization`].
    pub(super) fn unfold_standardization(&mut self, mean: &Array2<T>, deviation: &Array2<T>) {
        for chart in &mut self.charts {
            chart.phi.unfold_standardization(mean, deviation);
        }
    }

    /// How the charts are mixed.
    pub fn mixing(&self) -> Mixing {
        if self.charts.len() > 1 && self.gate.is_none() {
            Mixing::Even
        } else {
            Mixing::Gate
        }
    }

    /// The temperature e^τ of the gate; `None` without a gate.
    pub fn temperature(&self) -> Option<T> {
        let [_, _, log_tau] = &self.gate.as_ref()?.tensors;
        Some(log_tau[(0, 0)].exp())
    }

    /// Number of charts, K.
    pub fn chart_count(&self) -> usize {
        self.charts.len()
    }

    /// The charts.
    pub fn charts(&self) -> &[Siamese<T>] {
        &self.charts
    }

    /// Columns of a feature, d.
    pub fn feature_dim(&self) -> usize {
        self.charts[0].feature_dim()
    }

    /// Number of coordinates of a latent, K·k: the columns that distances are computed on.
    pub fn coordinate_count(&self) -> usize {
        self.charts.len() * self.charts[0].latent_dim()
    }

    /// Columns of a latent: the coordinates and, with several charts, one gate weight per chart.
    pub fn latent_dim(&self) -> usize {
        self.coordinate_count()
            + if self.charts.len() > 1 {
                self.charts.len()
            } else {
                0
            }
    }

    /// The same weights in another precision.
    pub fn cast<U: Real>(&self) -> Mixture<U> {
        let cast = |tensor: &Array2<T>| tensor.mapv(|x| U::of(x.f64()));
        Mixture {
            charts: self.charts.iter().map(Siamese::cast).collect(),
            gate: self.gate.as_ref().map(|gate| Gate {
                tensors: gate.tensors.each_ref().map(cast),
            }),
        }
    }

    /// Latents of feature rows, shape (n, d) in, (n, [`Mixture::latent_dim`]) out.
    pub fn embed(&self, features: Array2<T>) -> Array2<T> {
        if let [chart] = self.charts.as_slice() {
            return chart.embed(features);
        }

        let alpha = match &self.gate {
            Some(gate) => softmax(gate.scores(&features).1),
            None => Array2::from_elem((features.nrows(), self.charts.len()), self.even_share()),
        };

        // Layout of a latent: the coordinates, chart by chart, then the gate weights.
        let coordinates: Vec<_> = self
            .charts
            .iter()
            .map(|chart| chart.embed(features.clone()))
            .collect();
        let parts: Vec<_> = coordinates
            .iter()
            .chain([&alpha])
            .map(|part| part.view())
            .collect();

        // This cannot fail: every part has one row for each feature.
        concatenate(Axis(1), &parts).unwrap_or(alpha)
    }

    /// Gate weights of a latent; a single 1 for a single chart.
    pub fn gate_of(&self, latent: ArrayView1<'_, T>) -> Array1<T> {
        match self.charts.len() {
            1 => Array1::ones(1),
            _ => latent.slice(s![self.coordinate_count()..]).to_owned(),
        }
    }

    /// Equal gate weights, 1/K each.
    pub fn even_gate(&self) -> Array1<T> {
        Array1::from_elem(self.charts.len(), self.even_share())
    }

    fn even_share(&self) -> T {
        T::of((self.charts.len() as f64).recip())
    }

    /// W of the mixture for the weights `gate`: \[α_1 W_1, …, α_K W_K\], shape (6, K·k).
    pub fn motion_matrix(&self, gate: ArrayView1<'_, T>) -> Array2<T> {
        let parts: Vec<_> = self
            .charts
            .iter()
            .zip(gate)
            .map(|(chart, &alpha)| &chart.motion * alpha)
            .collect();
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();

        // This cannot fail: every part has six rows.
        concatenate(Axis(1), &views).unwrap_or_default()
    }
}

fn chart_name(charts: usize, chart: usize, name: &str) -> String {
    if charts == 1 {
        name.to_owned()
    } else {
        format!("experts.{chart}.{name}")
    }
}

impl<T: Real> Network<T> for Mixture<T> {
    fn names(&self) -> Vec<String> {
        let count = self.charts.len();
        let charts =
            (0..count).flat_map(|chart| TENSOR_NAMES.map(|name| chart_name(count, chart, name)));
        let gate = self.gate.iter().flat_map(|_| GATE_NAMES.map(str::to_owned));

        charts.chain(gate).collect()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        let charts = self.charts.iter().flat_map(Siamese::tensors);
        charts
            .chain(self.gate.iter().flat_map(|gate| &gate.tensors))
            .collect()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        let charts = self.charts.iter_mut().flat_map(Siamese::parameters_mut);
        charts
            .chain(self.gate.iter_mut().flat_map(|gate| &mut gate.tensors))
            .collect()
    }
}

impl<T: Real> Objective<T> for Mixture<T> {
    type Data = Samples<T>;

    fn count(samples: &Samples<T>) -> usize {
        samples.pair_count()
    }

    fn gradient(&self, samples: &Samples<T>, batch: &[usize], at: At<'_>) -> (f64, Self) {
        let batch = samples.batch(batch, at);

        // Gate weights are computed for every distinct frame of the batch; the prediction uses
        // those of the source frames.
        let alpha = self.gate.as_ref().map(|gate| {
            let (routed, scores) = gate.scores(&batch.features);
            (routed, softmax(scores.clone()), scores)
        });

        let gate_at_source = |chart: usize| {
            let column = |(_, alpha, _): &(_, Array2<T>, _)| {
                batch.sources(&alpha.slice(s![.., chart..=chart]))
            };
            alpha.as_ref().map(column)
        };

        // Each chart predicts the z-scored motion of every pair from the difference of its latents.
        let forward: Vec<_> = self
            .charts
            .iter()
            .map(|chart| chart.phi.forward(&batch.features))
            .collect();
        let steps: Vec<_> = forward
            .iter()
            .map(|forward| batch.differences(&forward.latents))
            .collect();

        let motions: Vec<_> = self
            .charts
            .iter()
            .zip(&steps)
            .map(|(chart, steps)| steps.dot(&chart.motion.t()))
            .collect();

        // The prediction is the mean of the charts' motions, weighted by the gate or equally.
        let mut predicted = Array2::zeros(batch.targets.dim());
        for (chart, motion) in motions.iter().enumerate() {
            match gate_at_source(chart) {
                Some(alpha) => predicted += &(motion * &alpha),
                None => predicted += &(motion * self.even_share()),
            }
        }

        let (loss, d_predicted) = at.config.loss.value(predicted.view(), batch.targets.view());
        let mut gradient = self.zeros_like();
        let mut d_alpha = Array2::zeros((batch.targets.nrows(), self.charts.len()));

        // The gradient of a chart's motion is the gradient of the prediction times the chart's
        // weight. The gradient of the weight is the inner product of the prediction's gradient and
        // the chart's motion.
        for (position, chart) in self.charts.iter().enumerate() {
            let d_motion = match gate_at_source(position) {
                Some(alpha) => {
                    d_alpha
                        .column_mut(position)
                        .assign(&(&d_predicted * &motions[position]).sum_axis(Axis(1)));
                    &d_predicted * &alpha
                }
                None => &d_predicted * self.even_share(),
            };

            let (forward, into) = (&forward[position], &mut gradient.charts[position]);
            into.motion += &d_motion.t().dot(&steps[position]);
            let d_latents = batch.scattered(&d_motion.dot(&chart.motion));
            chart
                .phi
                .backward(&batch.features, forward, &d_latents, &mut into.phi);
        }

        if let (Some(gate), Some((routed, alpha, scores)), Some(into)) =
            (&self.gate, &alpha, &mut gradient.gate)
        {
            // Softmax backward: ds_k = α_k (dα_k − Σ_j α_j dα_j).
            let at_source = batch.sources(alpha);
            let mean = (&at_source * &d_alpha)
                .sum_axis(Axis(1))
                .insert_axis(Axis(1));
            let d_scores = batch.scattered_to_sources(&(&at_source * &(d_alpha - mean)));

            // Scores are s = (W_route z)·p · e^−τ, hence ∂s/∂τ = −s, and the gradients of W_route
            // and p carry the factor e^−τ.
            let [_, prototypes, log_tau] = &gate.tensors;
            let scale = log_tau[(0, 0)].exp().recip();
            into.tensors[2][(0, 0)] = -(&d_scores * scores).sum();
            into.tensors[1] += &(d_scores.t().dot(routed) * scale);

            into.tensors[0] += &((d_scores.dot(prototypes) * scale).t().dot(&batch.features));
        }

        (loss, gradient)
    }
}

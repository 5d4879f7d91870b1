//! The network φ: Linear(d, 64) → LayerNorm(64) → GELU (erf) → Linear(64, 20), with hand-written
//! forward and backward passes.

use ndarray::{Array1, Array2, Axis};

use super::Real;
use super::layers::{
    cumulative, gelu_backward, linear, linear_initial, normalize, normalize_backward,
    wide_dot_products,
};
use super::seeded::Seeded;

/// Sizes of φ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Widths {
    /// Columns of a feature, d.
    pub feature: usize,
    /// Width of the hidden layer.
    pub hidden: usize,
    /// Columns of a latent, k.
    pub latent: usize,
}

/// Parameters of φ.
#[derive(Debug, Clone, PartialEq)]
pub struct Phi<T> {
    /// In the order of [`Phi::NAMES`].
    pub(super) tensors: [Array2<T>; 6],
}

/// Intermediate values of the forward pass that the backward pass uses.
pub struct Activations<T> {
    normalized: Array2<T>,
    inverse_deviation: Array2<T>,
    scaled: Array2<T>,
    cumulative: Array2<T>,
    hidden: Array2<T>,
    /// φ(z), shape (n, k).
    pub latents: Array2<T>,
}

impl<T: Real> Phi<T> {
    /// PyTorch's names of the tensors in a `Sequential`.
    pub const NAMES: [&str; 6] = [
        "0.weight", "0.bias", "1.weight", "1.bias", "3.weight", "3.bias",
    ];

    /// Initial weights, drawn as in PyTorch: linear layers uniform in ±1/√fan_in, LayerNorm weights
    /// 1 and biases 0.
    pub fn random(widths: Widths, random: &mut Seeded) -> Self {
        let Widths {
            feature,
            hidden,
            latent,
        } = widths;
        let [first_weight, first_bias] = linear_initial(feature, hidden, random);

        let [last_weight, last_bias] = linear_initial(hidden, latent, random);
        let norm_weight = Array2::ones((1, hidden));
        let norm_bias = Array2::zeros((1, hidden));

        Self {
            tensors: [
                first_weight,
                first_bias,
                norm_weight,
                norm_bias,
                last_weight,
                last_bias,
            ],
        }
    }

    /// Shapes of all tensors, from the weights of the two linear layers.
    pub(super) fn expected_shapes(&self) -> [(usize, usize); 6] {
        let (hidden, feature) = self.tensors[0].dim();
        let latent = self.tensors[4].nrows();

        [
            (hidden, feature),
            (1, hidden),
            (1, hidden),
            (1, hidden),
            (latent, hidden),
            (1, latent),
        ]
    }

    /// Columns of a feature, d.
    pub fn feature_dim(&self) -> usize {
        self.tensors[0].ncols()
    }

    /// Width of the hidden layer.
    pub fn hidden_dim(&self) -> usize {
        self.tensors[0].nrows()
    }

    /// Columns of a latent, k.
    pub fn latent_dim(&self) -> usize {
        self.tensors[4].nrows()
    }

    /// The tensors, in the order of [`Phi::NAMES`].
    pub fn parameters(&self) -> Vec<&Array2<T>> {
        self.tensors.iter().collect()
    }

    /// [`Phi::parameters`], mutable.
    pub fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.tensors.iter_mut().collect()
    }

    /// A φ of the same shape, all zeros.
    pub fn zeros(&self) -> Self {
        Self {
            tensors: self
                .tensors
                .each_ref()
                .map(|tensor| Array2::zeros(tensor.dim())),
        }
    }

    /// The same weights in another precision.
    pub(super) fn cast<U: Real>(&self) -> Phi<U> {
        Phi {
            tensors: self
                .tensors
                .each_ref()
                .map(|tensor| tensor.mapv(|x| U::of(x.f64()))),
        }
    }

    /// Folds the z-scoring of features into the first layer: W₁(z − m)/s + b₁ = (W₁/s) z + (b₁ −
    /// (W₁/s) m).
    pub(super) fn fold_standardization(&mut self, mean: &Array2<T>, deviation: &Array2<T>) {
        let [first_weight, first_bias, ..] = &mut self.tensors;

        // In f64, because (W₁/s) m can be far larger than b₁.
        let wide = |tensor: &Array2<T>| tensor.mapv(|x| x.f64());
        let weight = wide(first_weight) / &wide(deviation);
        let bias = wide(first_bias) - wide(mean).dot(&weight.t());
        *first_weight = weight.mapv(T::of);

        *first_bias = bias.mapv(T::of);
    }

    /// Undoes [`Phi::fold_standardization`]: converts a φ for z to a φ for (z − m)/s.
    pub(super) fn unfold_standardization(&mut self, mean: &Array2<T>, deviation: &Array2<T>) {
        let [first_weight, first_bias, ..] = &mut self.tensors;

        let wide = |tensor: &Array2<T>| tensor.mapv(|x| x.f64());
        let weight = wide(first_weight);
        let bias = wide(first_bias) + wide(mean).dot(&weight.t());
        *first_weight = (weight * &wide(deviation)).mapv(T::of);
        *first_bias = bias.mapv(T::of);
    }

    /// The forward pass of feature rows, shape (n, d).
    pub fn forward(&self, input: &Array2<T>) -> Activations<T> {
        let [weight, bias, ..] = &self.tensors;
        self.after_first_layer(linear(input, weight, bias))
    }

    /// The forward pass from the output of the first layer on, shape (n, h).
    fn after_first_layer(&self, mut normalized: Array2<T>) -> Activations<T> {
        let [_, _, norm_weight, norm_bias, last_weight, last_bias] = &self.tensors;
        let inverse_deviation = normalize(&mut normalized);
        let scaled = &normalized * norm_weight + norm_bias;

        // GELU(x) = x Φ(x). Φ(x) is kept for the derivative.
        let cumulative = cumulative(&scaled);
        let hidden = &scaled * &cumulative;
        let latents = linear(&hidden, last_weight, last_bias);

        Activations {
            normalized,
            inverse_deviation,
            scaled,
            cumulative,
            hidden,
            latents,
        }
    }

    /// Adds the gradient of the parameters to `gradient`; `input` are the rows of the forward pass,
    /// `d_latents` is the gradient with respect to the latents, shape (n, k).
    ///
    /// The last bias is skipped. It cancels in the difference of two latents, so its gradient is
    /// exactly zero; Adam would amplify the rounding errors to the full learning rate.
    /// [`Phi::backward_whole`] includes it.
    pub fn backward(
        &self,
        input: &Array2<T>,
        forward: &Activations<T>,
        d_latents: &Array2<T>,
        gradient: &mut Self,
    ) {
        let [_, _, norm_weight, _, last_weight, _] = &self.tensors;
        gradient.tensors[4] += &d_latents.t().dot(&forward.hidden);
        let mut d_scaled = d_latents.dot(last_weight);
        gelu_backward(&mut d_scaled, &forward.scaled, &forward.cumulative);

        // LayerNorm backward: first weight and bias, then the normalization.
        gradient.tensors[2] += &(&d_scaled * &forward.normalized).sum_axis(Axis(0));
        gradient.tensors[3] += &d_scaled.sum_axis(Axis(0));
        let mut d_first = d_scaled * norm_weight;
        normalize_backward(
            &mut d_first,
            &forward.normalized,
            &forward.inverse_deviation,
        );

        gradient.tensors[0] += &d_first.t().dot(input);
        gradient.tensors[1] += &d_first.sum_axis(Axis(0));
    }

    /// [`Phi::backward`] for latents that are used directly, not as differences: the last bias has
    /// a gradient.
    pub fn backward_whole(
        &self,
        input: &Array2<T>,
        forward: &Activations<T>,
        d_latents: &Array2<T>,
        gradient: &mut Self,
    ) {
        self.backward(input, forward, d_latents, gradient);
        gradient.tensors[5] += &d_latents.sum_axis(Axis(0));
    }
}

impl Phi<f32> {
    /// φ of one feature in f64, shape (1, k): to the bit [`Phi::forward`] of `wide`, which has the same
    /// weights in f64. `None` if a number of the feature is not finite.
    pub(super) fn of_one(&self, wide: &Phi<f64>, feature: &[f32]) -> Option<Array2<f64>> {
        let weight = self.tensors[0].as_slice()?;
        let first = Array1::from(wide_dot_products(weight, feature)).insert_axis(Axis(0));
        let first = first + &wide.tensors[1];

        // Each number of the feature is multiplied by a weight in every sum.
        let is_finite = first.first().is_some_and(|sum| sum.is_finite());
        is_finite.then(|| wide.after_first_layer(first).latents)
    }
}

//! The network φ and the matrix W: forward, and backward by hand.
//!
//! φ = Linear(d, 64) → LayerNorm(64) → GELU (erf) → Linear(64, 20). Rows are samples. Tensors are named and shaped
//! as PyTorch's state dict names them: `phi.0.weight` (64, d), …, `W.weight` (6, 20); vectors are (1, n) here.

use super::seeded::Seeded;
use super::{Error, Real};
use ndarray::{Array2, ArrayView2, Axis, Zip};

/// Added to a LayerNorm's variance, PyTorch's default.
const LAYER_NORM_EPS: f64 = 1e-5;

/// Names of the tensors, in the order of [`Siamese::tensors`].
pub const TENSOR_NAMES: [&str; 7] =
    ["phi.0.weight", "phi.0.bias", "phi.1.weight", "phi.1.bias", "phi.3.weight", "phi.3.bias", "W.weight"];

/// Parameters of φ and W, or anything shaped like them (gradients, moments).
#[derive(Debug, Clone, PartialEq)]
pub struct Siamese<T> {
    first_weight: Array2<T>,
    first_bias: Array2<T>,
    norm_weight: Array2<T>,
    norm_bias: Array2<T>,
    last_weight: Array2<T>,
    last_bias: Array2<T>,
    motion: Array2<T>,
}

/// What the backward pass needs of the forward pass.
pub(super) struct Activations<T> {
    input: Array2<T>,
    normalised: Array2<T>,
    inverse_deviation: Array2<T>,
    scaled: Array2<T>,
    /// The normal distribution's cumulative Φ at `scaled`.
    cumulative: Array2<T>,
    hidden: Array2<T>,
    /// φ(z), shape (n, k).
    pub latents: Array2<T>,
}

/// Sizes of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Widths {
    /// d, columns of a feature.
    pub feature: usize,
    /// Columns between the two linear layers.
    pub hidden: usize,
    /// k, columns of a latent.
    pub latent: usize,
}

impl<T: Real> Siamese<T> {
    /// A network drawn as PyTorch draws it: linear weights and biases uniform in ±1/√fan_in, LayerNorm 1 and 0.
    pub(super) fn random(widths: Widths, random: &mut Seeded) -> Self {
        let Widths { feature, hidden, latent } = widths;
        let mut uniform = |rows: usize, columns: usize, fan_in: usize| {
            let bound = (fan_in as f64).sqrt().recip();
            Array2::from_shape_simple_fn((rows, columns), || T::of(f64::from(random.symmetric(bound))))
        };
        Self {
            first_weight: uniform(hidden, feature, feature),
            first_bias: uniform(1, hidden, feature),
            norm_weight: Array2::ones((1, hidden)),
            norm_bias: Array2::zeros((1, hidden)),
            last_weight: uniform(latent, hidden, hidden),
            last_bias: uniform(1, latent, hidden),
            motion: uniform(6, latent, latent),
        }
    }

    /// The initial weights of a seed: those that PyTorch gives the same network after `torch.manual_seed(seed)`.
    pub fn initial(widths: Widths, seed: u64) -> Self {
        Self::random(widths, &mut Seeded::new(seed))
    }

    /// Takes the seven tensors in the order of [`TENSOR_NAMES`], vectors as (1, n).
    ///
    /// # Errors
    /// [`Error::WeightShape`] when they do not fit one another.
    pub fn from_tensors(tensors: [Array2<T>; 7]) -> Result<Self, Error> {
        let [first_weight, first_bias, norm_weight, norm_bias, last_weight, last_bias, motion] = tensors;
        let (hidden, feature) = first_weight.dim();
        let latent = last_weight.nrows();
        let network = Self { first_weight, first_bias, norm_weight, norm_bias, last_weight, last_bias, motion };
        let expected =
            [(hidden, feature), (1, hidden), (1, hidden), (1, hidden), (latent, hidden), (1, latent), (6, latent)];
        for ((tensor, array), (rows, columns)) in TENSOR_NAMES.into_iter().zip(network.tensors()).zip(expected) {
            if array.dim() != (rows, columns) || rows * columns == 0 {
                let actual = array.shape().to_vec();
                return Err(Error::WeightShape { tensor, expected: vec![rows, columns], actual });
            }
        }
        Ok(network)
    }

    /// The seven tensors in the order of [`TENSOR_NAMES`].
    pub fn tensors(&self) -> [&Array2<T>; 7] {
        [
            &self.first_weight,
            &self.first_bias,
            &self.norm_weight,
            &self.norm_bias,
            &self.last_weight,
            &self.last_bias,
            &self.motion,
        ]
    }

    pub(super) fn tensors_mut(&mut self) -> [&mut Array2<T>; 7] {
        [
            &mut self.first_weight,
            &mut self.first_bias,
            &mut self.norm_weight,
            &mut self.norm_bias,
            &mut self.last_weight,
            &mut self.last_bias,
            &mut self.motion,
        ]
    }

    /// All zeros, in this one's shape.
    pub(super) fn zeros_like(&self) -> Self {
        let mut zeros = self.clone();
        zeros.tensors_mut().into_iter().for_each(|tensor| tensor.fill(T::zero()));
        zeros
    }

    /// The same numbers in another precision.
    pub fn cast<U: Real>(&self) -> Siamese<U> {
        let cast = |array: &Array2<T>| array.mapv(|x| U::of(x.f64()));
        Siamese {
            first_weight: cast(&self.first_weight),
            first_bias: cast(&self.first_bias),
            norm_weight: cast(&self.norm_weight),
            norm_bias: cast(&self.norm_bias),
            last_weight: cast(&self.last_weight),
            last_bias: cast(&self.last_bias),
            motion: cast(&self.motion),
        }
    }

    /// Columns of a feature, d.
    pub fn feature_dim(&self) -> usize {
        self.first_weight.ncols()
    }

    /// Columns of a latent, k.
    pub fn latent_dim(&self) -> usize {
        self.last_weight.nrows()
    }

    /// W, shape (6, k).
    pub fn motion_matrix(&self) -> ArrayView2<'_, T> {
        self.motion.view()
    }

    pub(super) fn check_finite(&self) -> Result<(), Error> {
        let bad = |array: &Array2<T>| array.iter().any(|x| !x.is_finite());
        match TENSOR_NAMES.into_iter().zip(self.tensors()).find(|(_, array)| bad(array)) {
            Some((tensor, _)) => Err(Error::WeightsNotFinite { tensor }),
            None => Ok(()),
        }
    }

    /// φ of feature rows, shape (n, d) in, (n, k) out.
    pub fn embed(&self, features: Array2<T>) -> Array2<T> {
        self.forward(features).latents
    }

    pub(super) fn forward(&self, input: Array2<T>) -> Activations<T> {
        let mut normalised = input.dot(&self.first_weight.t()) + &self.first_bias;
        let width = T::of(normalised.ncols() as f64);
        let mut inverse_deviation = Array2::zeros((normalised.nrows(), 1));
        for (mut row, mut scale) in normalised.outer_iter_mut().zip(inverse_deviation.outer_iter_mut()) {
            let mean = row.sum() / width;
            row.mapv_inplace(|x| x - mean);
            let variance = row.fold(T::zero(), |sum, &x| sum + x * x) / width;
            scale[0] = (variance + T::of(LAYER_NORM_EPS)).sqrt().recip();
            row.mapv_inplace(|x| x * scale[0]);
        }
        let scaled = &normalised * &self.norm_weight + &self.norm_bias;
        let cumulative = scaled.mapv(|x| T::of(0.5) * (T::one() + (x * T::of(std::f64::consts::FRAC_1_SQRT_2)).erf()));
        let hidden = &scaled * &cumulative;
        let latents = hidden.dot(&self.last_weight.t()) + &self.last_bias;
        Activations { input, normalised, inverse_deviation, scaled, cumulative, hidden, latents }
    }

    /// Adds to `gradient` the gradient of φ's parameters for the latents' gradient `d_latents`, shape (n, k).
    ///
    /// The last bias is left alone: a Siamese difference cancels it, so its gradient is exactly zero, and rounding
    /// noise in its place would be amplified by Adam to the full learning rate.
    pub(super) fn backward(&self, forward: &Activations<T>, d_latents: &Array2<T>, gradient: &mut Self) {
        gradient.last_weight += &d_latents.t().dot(&forward.hidden);
        let mut d_scaled = d_latents.dot(&self.last_weight);
        let density_scale = T::of((2.0 * std::f64::consts::PI).sqrt().recip());
        let half = T::of(0.5);
        Zip::from(&mut d_scaled)
            .and(&forward.scaled)
            .and(&forward.cumulative)
            .for_each(|d, &x, &cumulative| *d *= cumulative + x * density_scale * (-half * x * x).exp());
        gradient.norm_weight += &(&d_scaled * &forward.normalised).sum_axis(Axis(0));
        gradient.norm_bias += &d_scaled.sum_axis(Axis(0));
        let mut d_first = d_scaled * &self.norm_weight;
        let width = T::of(d_first.ncols() as f64);
        for ((mut row, normalised), scale) in
            d_first.outer_iter_mut().zip(forward.normalised.outer_iter()).zip(forward.inverse_deviation.iter())
        {
            let mean = row.sum() / width;
            let along = row.iter().zip(&normalised).fold(T::zero(), |sum, (&d, &x)| sum + d * x) / width;
            Zip::from(&mut row).and(&normalised).for_each(|d, &x| *d = *scale * (*d - mean - x * along));
        }
        gradient.first_weight += &d_first.t().dot(&forward.input);
        gradient.first_bias += &d_first.sum_axis(Axis(0));
    }

    pub(super) fn add_to_motion(&mut self, gradient: Array2<T>) {
        self.motion += &gradient;
    }
}

//! One chart: φ and the matrix W, ΔP ≈ W(φ(z₂) − φ(z₁)).

use super::layers::uniform;
use super::phi::{Phi, Widths};
use super::seeded::Seeded;
use super::{Error, Network, Real};
use ndarray::{Array2, ArrayView2};

/// Names of the tensors, in the order of [`Siamese::tensors`].
pub const TENSOR_NAMES: [&str; 7] = [
    "phi.0.weight",
    "phi.0.bias",
    "phi.1.weight",
    "phi.1.bias",
    "phi.3.weight",
    "phi.3.bias",
    "W.weight",
];

/// Parameters of φ and W, or values of the same shape, such as gradients. Shapes are those of
/// PyTorch (`phi.0.weight` (64, d), …, `W.weight` (6, 20)), but vectors are (1, n).
#[derive(Debug, Clone, PartialEq)]
pub struct Siamese<T> {
    /// φ: features to latents.
    pub phi: Phi<T>,
    /// W, shape (6, k): differences of latents to z-scored motions.
    pub motion: Array2<T>,
}

impl<T: Real> Siamese<T> {
    /// Random initial weights, drawn as in PyTorch.
    pub fn random(widths: Widths, random: &mut Seeded) -> Self {
        Self {
            phi: Phi::random(widths, random),
            motion: uniform(6, widths.latent, widths.latent, random),
        }
    }

    /// Initial weights of a seed, equal to PyTorch's after `torch.manual_seed(seed)`.
    pub fn initial(widths: Widths, seed: u64) -> Self {
        Self::random(widths, &mut Seeded::new(seed))
    }

    /// A chart from its seven tensors in the order of [`TENSOR_NAMES`], vectors as (1, n).
    ///
    /// # Errors
    /// [`Error::WeightShape`] when the shapes are inconsistent.
    pub fn from_tensors(tensors: [Array2<T>; 7]) -> Result<Self, Error> {
        let [
            first_weight,
            first_bias,
            norm_weight,
            norm_bias,
            last_weight,
            last_bias,
            motion,
        ] = tensors;

        let phi = Phi {
            tensors: [
                first_weight,
                first_bias,
                norm_weight,
                norm_bias,
                last_weight,
                last_bias,
            ],
        };

        // The weights of φ's two linear layers set the widths; the other tensors must match.
        let expected = phi
            .expected_shapes()
            .into_iter()
            .chain([(6, phi.latent_dim())]);

        let chart = Self { phi, motion };
        for ((tensor, array), (rows, columns)) in
            TENSOR_NAMES.into_iter().zip(chart.tensors()).zip(expected)
        {
            if array.dim() != (rows, columns) || rows * columns == 0 {
                let tensor = tensor.to_owned();
                let actual = array.shape().to_vec();

                return Err(Error::WeightShape {
                    tensor,
                    expected: vec![rows, columns],
                    actual,
                });
            }
        }

        Ok(chart)
    }

    /// The seven tensors in the order of [`TENSOR_NAMES`].
    pub fn tensors(&self) -> [&Array2<T>; 7] {
        let [a, b, c, d, e, f] = self.phi.tensors.each_ref();
        [a, b, c, d, e, f, &self.motion]
    }

    /// The same weights in another precision.
    pub fn cast<U: Real>(&self) -> Siamese<U> {
        Siamese {
            phi: self.phi.cast(),
            motion: self.motion.mapv(|x| U::of(x.f64())),
        }
    }

    /// Columns of a feature, d.
    pub fn feature_dim(&self) -> usize {
        self.phi.feature_dim()
    }

    /// Columns of a latent, k.
    pub fn latent_dim(&self) -> usize {
        self.phi.latent_dim()
    }

    /// W, shape (6, k).
    pub fn motion_matrix(&self) -> ArrayView2<'_, T> {
        self.motion.view()
    }

    /// φ of feature rows, shape (n, d) in, (n, k) out.
    pub fn embed(&self, features: Array2<T>) -> Array2<T> {
        self.phi.forward(&features).latents
    }
}

impl<T: Real> Network<T> for Siamese<T> {
    fn names(&self) -> Vec<String> {
        TENSOR_NAMES.map(str::to_owned).to_vec()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        self.tensors().to_vec()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.phi
            .tensors
            .iter_mut()
            .chain([&mut self.motion])
            .collect()
    }
}

//! Correctors: small networks that predict the latent after a motion, trained with φ and W frozen.
//!
//! Their input is \[g; (ΔP − μ)/σ\]. The linear corrector predicts ĝ itself; the others predict a
//! residual that is added to g + W⁺ΔP (Sec. A.9). The paper does not give the widths, the number of
//! heads or the scaling of the input; they are our choice.

use ndarray::{Array2, ArrayView1, ArrayView2, Axis, concatenate};
use strum::{EnumString, IntoStaticStr};

use super::attention::Attention;
use super::layers::Dense;
use super::loss::mean_squared_error;
use super::seeded::Seeded;
use super::train::{EpochProgress, fit};
use super::{Adapter, At, Error, Network, Objective, Reading, Real, Samples, TrainConfig};
use crate::cancel::Cancellation;

/// The architecture of a corrector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, EnumString, IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(rename_all = "kebab-case")
)]
pub enum CorrectorKind {
    /// One linear layer.
    Linear,
    /// One hidden layer of width 64.
    #[strum(serialize = "mlp-2")]
    #[cfg_attr(feature = "serde", serde(rename = "mlp-2"))]
    Mlp2,
    /// Two hidden layers of width 128.
    #[strum(serialize = "mlp-3")]
    #[cfg_attr(feature = "serde", serde(rename = "mlp-3"))]
    Mlp3,
    /// One attention block over two tokens, the latent and the motion.
    Attention,
}

impl CorrectorKind {
    /// Every kind, in the order of the paper's table.
    pub const ALL: [Self; 4] = [Self::Linear, Self::Mlp2, Self::Mlp3, Self::Attention];

    /// Its name on the command line, in tables and in files.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Whether the output is a residual, added to g + W⁺ΔP. Otherwise it is ĝ itself.
    pub fn has_residual(self) -> bool {
        self != Self::Linear
    }

    fn widths(self, coordinates: usize) -> Vec<usize> {
        let hidden: &[usize] = match self {
            Self::Linear | Self::Attention => &[],
            Self::Mlp2 => &[64],
            Self::Mlp3 => &[128, 128],
        };
        [coordinates + 6]
            .into_iter()
            .chain(hidden.iter().copied())
            .chain([coordinates])
            .collect()
    }
}

/// Parameters of a corrector.
#[derive(Debug, Clone, PartialEq)]
pub struct Corrector<T> {
    kind: CorrectorKind,
    body: Body<T>,
}

#[derive(Debug, Clone, PartialEq)]
enum Body<T> {
    Dense(Dense<T>),
    Attention(Box<Attention<T>>),
}

impl<T: Real> Corrector<T> {
    /// The initial weights that PyTorch draws from `seed`, for latents of `coordinates` columns.
    pub fn initial(kind: CorrectorKind, coordinates: usize, seed: u64) -> Self {
        Self::random(kind, coordinates, &mut Seeded::new(seed))
    }

    fn random(kind: CorrectorKind, coordinates: usize, random: &mut Seeded) -> Self {
        let body = match kind {
            CorrectorKind::Attention => {
                Body::Attention(Box::new(Attention::random(coordinates, random)))
            }
            _ => Body::Dense(Dense::random(&kind.widths(coordinates), random)),
        };
        Self { kind, body }
    }

    /// Builds a corrector for latents of `coordinates` columns from the tensors that `tensor`
    /// returns for PyTorch's names.
    ///
    /// # Errors
    /// The errors of `tensor`, and [`Error::WeightShape`] when a tensor does not have the shape
    /// that this kind of corrector needs.
    pub fn from_tensors<E: From<Error>>(
        kind: CorrectorKind,
        coordinates: usize,
        mut tensor: impl FnMut(&str) -> Result<Array2<T>, E>,
    ) -> Result<Self, E> {
        let mut corrector = Self::initial(kind, coordinates, 0);
        for (name, into) in corrector
            .names()
            .into_iter()
            .zip(corrector.parameters_mut())
        {
            let read = tensor(&name)?;
            if read.dim() != into.dim() {
                let expected = into.shape().to_vec();
                let actual = read.shape().to_vec();

                return Err(Error::WeightShape {
                    tensor: name,
                    expected,
                    actual,
                }
                .into());
            }

            *into = read;
        }

        Ok(corrector)
    }

    /// The architecture.
    pub fn kind(&self) -> CorrectorKind {
        self.kind
    }

    /// The same weights in another precision.
    pub fn cast<U: Real>(&self) -> Corrector<U> {
        let body = match &self.body {
            Body::Dense(dense) => {
                let cast = |tensor: &Array2<T>| tensor.mapv(|x| U::of(x.f64()));
                Body::Dense(Dense {
                    layers: dense
                        .layers
                        .iter()
                        .map(|layer| layer.each_ref().map(cast))
                        .collect(),
                })
            }
            Body::Attention(attention) => Body::Attention(Box::new(attention.cast())),
        };

        Corrector {
            kind: self.kind,
            body,
        }
    }

    /// Refuses weights that are not finite or do not fit latents of `coordinates` columns.
    pub(super) fn check(&self, coordinates: usize) -> Result<(), Error> {
        let (given, expected) = match &self.body {
            Body::Dense(dense) => (dense.widths(), self.kind.widths(coordinates)),
            Body::Attention(attention) => (vec![attention.coordinates()], vec![coordinates]),
        };

        if given != expected {
            return Err(Error::WeightShape {
                tensor: self.kind.name().to_owned(),
                expected,
                actual: given,
            });
        }

        match self.not_finite() {
            Some(tensor) => Err(Error::WeightsNotFinite { tensor }),
            None => Ok(()),
        }
    }

    /// The network's output for latents (n, k) and z-scored motions (n, 6), shape (n, k).
    pub fn output(&self, latents: ArrayView2<'_, T>, motions: ArrayView2<'_, T>) -> Array2<T> {
        match &self.body {
            Body::Dense(dense) => dense.forward(side_by_side(latents, motions)).output,
            Body::Attention(attention) => {
                attention
                    .forward(latents.to_owned(), motions.to_owned())
                    .output
            }
        }
    }

    /// [`Corrector::output`] for one latent and motion.
    pub(super) fn added(
        &self,
        latent: ArrayView1<'_, T>,
        motion: ArrayView1<'_, T>,
    ) -> ndarray::Array1<T> {
        self.output(latent.insert_axis(Axis(0)), motion.insert_axis(Axis(0)))
            .row(0)
            .to_owned()
    }
}

fn side_by_side<T: Real>(latents: ArrayView2<'_, T>, motions: ArrayView2<'_, T>) -> Array2<T> {
    // This cannot fail: both have one row for each sample.
    concatenate(Axis(1), &[latents, motions]).unwrap_or_default()
}

impl<T: Real> Network<T> for Corrector<T> {
    fn names(&self) -> Vec<String> {
        match &self.body {
            Body::Dense(dense) => dense.names("net"),
            Body::Attention(attention) => attention.names(),
        }
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        match &self.body {
            Body::Dense(dense) => dense.parameters(),
            Body::Attention(attention) => attention.parameters(),
        }
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        match &mut self.body {
            Body::Dense(dense) => dense.parameters_mut(),
            Body::Attention(attention) => attention.parameters_mut(),
        }
    }
}

/// Training data of a corrector, one row per pair.
#[derive(Debug, Clone)]
pub struct CorrectorSamples<T> {
    /// Latents g of the source frames, shape (n, k).
    pub latents: Array2<T>,
    /// Z-scored motions (ΔP − μ)/σ, shape (n, 6).
    pub motions: Array2<T>,
    /// Latents reached by the inverse step, g + W⁺(ΔP − μ)/σ, shape (n, k).
    pub imagined: Array2<T>,
    /// Latents φ(z₂) of the target frames, shape (n, k).
    pub targets: Array2<T>,
}

impl<T: Real> Objective<T> for Corrector<T> {
    type Data = CorrectorSamples<T>;

    fn count(samples: &Self::Data) -> usize {
        samples.latents.nrows()
    }

    fn gradient(&self, samples: &Self::Data, batch: &[usize], _at: At<'_>) -> (f64, Self) {
        let take = |rows: &Array2<T>| rows.select(Axis(0), batch);
        let latents = take(&samples.latents);
        let motions = take(&samples.motions);
        let targets = take(&samples.targets);

        // The target of a residual corrector is the error of the inverse step; that of the linear
        // corrector is the target latent itself.
        let base = if self.kind.has_residual() {
            take(&samples.imagined)
        } else {
            Array2::zeros(targets.dim())
        };

        let mut gradient = self.zeros_like();
        let loss = match (&self.body, &mut gradient.body) {
            (Body::Dense(dense), Body::Dense(into)) => {
                let forward = dense.forward(side_by_side(latents.view(), motions.view()));
                let (loss, d) =
                    mean_squared_error((&forward.output + &base).view(), targets.view());
                dense.backward(&forward, &d, into);

                loss
            }
            (Body::Attention(attention), Body::Attention(into)) => {
                let forward = attention.forward(latents, motions);
                let (loss, d) =
                    mean_squared_error((&forward.output + &base).view(), targets.view());
                attention.backward(&forward, &d, into);

                loss
            }
            // This cannot happen: `zeros_like` keeps the kind of the network.
            _ => f64::NAN,
        };

        (loss, gradient)
    }
}

/// Trains a corrector on an adapter's own training pairs, with φ and W frozen.
///
/// # Errors
/// [`Error::Diverged`] when the loss is not finite, and the errors of [`Adapter::embed`].
pub fn train_corrector(
    kind: CorrectorKind,
    adapter: &Adapter,
    samples: &Samples<f32>,
    config: &TrainConfig,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Corrector<f32>, Error> {
    let samples = corrector_samples(adapter, samples)?;
    let mut random = Seeded::new(config.seed);
    let start = Corrector::random(kind, adapter.coordinate_count(), &mut random);
    let cancel = Cancellation::default();
    fit(&samples, start, config, &mut random, &cancel, progress)
}

fn corrector_samples(
    adapter: &Adapter,
    samples: &Samples<f32>,
) -> Result<CorrectorSamples<f32>, Error> {
    let latents = adapter.embed(samples.features())?;
    let n = samples.pair_count();
    let k = adapter.coordinate_count();
    let mut imagined = Array2::zeros((n, k));

    for (pair, &twist) in samples.twists().iter().enumerate() {
        let here = latents.row(samples.pair(pair)[0]);
        let there = &here + &adapter.step(here, twist, Reading::Affine, 1.0);

        // A mixture's latents end with gate weights, which are not corrected: `zip` stops after the
        // k coordinates.
        imagined
            .row_mut(pair)
            .iter_mut()
            .zip(&there)
            .for_each(|(into, &x)| *into = x as f32);
    }

    // Latents at one end of every pair: 0 is the source, 1 the target.
    let end = |end: usize| {
        Array2::from_shape_fn((n, k), |(pair, column)| {
            latents[(samples.pair(pair)[end], column)] as f32
        })
    };

    let scale = adapter.scale();
    let normalized: Vec<_> = samples
        .twists()
        .iter()
        .map(|&twist| scale.normalized(twist))
        .collect();
    let motions = Array2::from_shape_fn((n, 6), |(pair, component)| {
        normalized[pair][component] as f32
    });

    Ok(CorrectorSamples {
        latents: end(0),
        motions,
        imagined,
        targets: end(1),
    })
}

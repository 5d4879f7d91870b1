//! Training losses on z-scored twists, each with its gradient with respect to the prediction.

use ndarray::{Array2, ArrayView2, Axis, Zip, s};
use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use super::Real;

/// Lower bound on vector lengths, as in PyTorch's `cosine_similarity`.
const COSINE_EPS: f64 = 1e-8;

/// The training loss. Source: SeeSE3, Sec. A.6.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(rename_all = "kebab-case")
)]
pub enum Loss {
    /// Mean squared error over all six components, as in the paper.
    #[default]
    #[strum(serialize = "mse")]
    #[cfg_attr(feature = "serde", serde(rename = "mse"))]
    MeanSquaredError,
    /// One minus the cosine between predicted and true motion, as vectors of six numbers.
    Cosine,
    /// Mean squared error of the three rotation components only.
    Rotation,
}

impl Loss {
    /// Name on the command line and in a manifest.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The loss of predictions (n, 6) against targets (n, 6), and its gradient with respect to the
    /// predictions.
    pub fn value<T: Real>(
        self,
        predicted: ArrayView2<'_, T>,
        target: ArrayView2<'_, T>,
    ) -> (f64, Array2<T>) {
        match self {
            Self::MeanSquaredError => mean_squared_error(predicted, target),
            Self::Cosine => cosine(predicted, target),
            Self::Rotation => {
                let mut gradient = Array2::zeros(predicted.dim());
                let (loss, inner) =
                    mean_squared_error(predicted.slice(s![.., 3..]), target.slice(s![.., 3..]));
                gradient.slice_mut(s![.., 3..]).assign(&inner);

                (loss, gradient)
            }
        }
    }
}

/// The mean over rows and columns of (y − t)², and its gradient with respect to y.
pub(super) fn mean_squared_error<T: Real>(
    predicted: ArrayView2<'_, T>,
    target: ArrayView2<'_, T>,
) -> (f64, Array2<T>) {
    let difference = &predicted - &target;
    let count = difference.len() as f64;
    let loss = difference.iter().map(|x| x.f64() * x.f64()).sum::<f64>() / count;
    (loss, difference * T::of(2.0 / count))
}

fn cosine<T: Real>(predicted: ArrayView2<'_, T>, target: ArrayView2<'_, T>) -> (f64, Array2<T>) {
    let n = predicted.nrows() as f64;
    let mut gradient = Array2::zeros(predicted.dim());
    let mut loss = 0.0;
    for ((y, t), mut d) in predicted
        .axis_iter(Axis(0))
        .zip(target.axis_iter(Axis(0)))
        .zip(gradient.axis_iter_mut(Axis(0)))
    {
        let length = |row: &ndarray::ArrayView1<'_, T>| {
            row.iter()
                .map(|x| x.f64() * x.f64())
                .sum::<f64>()
                .sqrt()
                .max(COSINE_EPS)
        };

        let a = length(&y);
        let c = length(&t);

        let cosine = y
            .iter()
            .zip(&t)
            .map(|(y, t)| y.f64() * t.f64())
            .sum::<f64>()
            / (a * c);
        loss += 1.0 - cosine;

        // ∂cos/∂y = t/(|y||t|) − cos(y, t) · y/|y|²; the loss is 1 − cos.
        Zip::from(&mut d).and(&y).and(&t).for_each(|d, &y, &t| {
            *d = T::of(-(t.f64() / (a * c) - cosine * y.f64() / (a * a)) / n);
        });
    }

    (loss / n, gradient)
}

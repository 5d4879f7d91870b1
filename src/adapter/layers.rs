//! Layers, forward and backward by hand. Rows are samples; weights are (out, in), biases (1, out),
//! as PyTorch's.

use ndarray::{Array2, Axis, Zip};

use super::Real;
use super::seeded::Seeded;

/// Added to a LayerNorm's variance, PyTorch's default.
const LAYER_NORM_EPS: f64 = 1e-5;

/// A weight and a bias uniform in ±1/√fan_in, as PyTorch draws a `Linear`.
pub(super) fn linear_initial<T: Real>(
    inputs: usize,
    outputs: usize,
    random: &mut Seeded,
) -> [Array2<T>; 2] {
    [
        uniform(outputs, inputs, inputs, random),
        uniform(1, outputs, inputs, random),
    ]
}

/// Numbers uniform in ±1/√fan_in.
pub(super) fn uniform<T: Real>(
    rows: usize,
    columns: usize,
    fan_in: usize,
    random: &mut Seeded,
) -> Array2<T> {
    within(rows, columns, (fan_in as f64).sqrt().recip(), random)
}

/// Numbers uniform in ±bound.
pub(super) fn within<T: Real>(
    rows: usize,
    columns: usize,
    bound: f64,
    random: &mut Seeded,
) -> Array2<T> {
    Array2::from_shape_simple_fn((rows, columns), || {
        T::of(f64::from(random.symmetric(bound)))
    })
}

/// x Wᵀ + b.
pub(super) fn linear<T: Real>(
    input: &Array2<T>,
    weight: &Array2<T>,
    bias: &Array2<T>,
) -> Array2<T> {
    input.dot(&weight.t()) + bias
}

/// Takes mean and deviation off every row; what is returned is one over the deviations, shape (n,
/// 1).
pub(super) fn normalise<T: Real>(rows: &mut Array2<T>) -> Array2<T> {
    let width = T::of(rows.ncols() as f64);
    let mut inverse_deviation = Array2::zeros((rows.nrows(), 1));
    for (mut row, mut scale) in rows
        .outer_iter_mut()
        .zip(inverse_deviation.outer_iter_mut())
    {
        let mean = row.sum() / width;
        row.mapv_inplace(|x| x - mean);
        let variance = row.fold(T::zero(), |sum, &x| sum + x * x) / width;
        scale[0] = (variance + T::of(LAYER_NORM_EPS)).sqrt().recip();

        row.mapv_inplace(|x| x * scale[0]);
    }

    inverse_deviation
}

/// The gradient by [`normalise`]'s input, in place of the gradient by its output.
pub(super) fn normalise_backward<T: Real>(
    d: &mut Array2<T>,
    normalised: &Array2<T>,
    inverse_deviation: &Array2<T>,
) {
    let width = T::of(d.ncols() as f64);
    for ((mut row, normalised), scale) in d
        .outer_iter_mut()
        .zip(normalised.outer_iter())
        .zip(inverse_deviation.iter())
    {
        let mean = row.sum() / width;

        let along = row
            .iter()
            .zip(&normalised)
            .fold(T::zero(), |sum, (&d, &x)| sum + d * x)
            / width;
        Zip::from(&mut row)
            .and(&normalised)
            .for_each(|d, &x| *d = *scale * (*d - mean - x * along));
    }
}

/// The normal distribution's cumulative Φ; GELU(x) = x Φ(x), the exact form.
pub(super) fn cumulative<T: Real>(input: &Array2<T>) -> Array2<T> {
    input.mapv(|x| T::of(0.5) * (T::one() + (x * T::of(std::f64::consts::FRAC_1_SQRT_2)).erf()))
}

/// The gradient by GELU's input, in place of the gradient by its output.
pub(super) fn gelu_backward<T: Real>(d: &mut Array2<T>, input: &Array2<T>, cumulative: &Array2<T>) {
    let density_scale = T::of((2.0 * std::f64::consts::PI).sqrt().recip());
    let half = T::of(0.5);

    Zip::from(d)
        .and(input)
        .and(cumulative)
        .for_each(|d, &x, &cumulative| {
            *d *= cumulative + x * density_scale * (-half * x * x).exp();
        });
}

/// Linear layers with GELU between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Dense<T> {
    /// Weight and bias of each.
    pub(super) layers: Vec<[Array2<T>; 2]>,
}

/// What [`Dense::backward`] needs of the forward pass.
pub(crate) struct DenseActivations<T> {
    /// The input of each layer.
    inputs: Vec<Array2<T>>,
    /// Before each GELU, and Φ of it.
    gelus: Vec<[Array2<T>; 2]>,
    pub output: Array2<T>,
}

impl<T: Real> Dense<T> {
    /// Drawn as PyTorch draws it; `widths` are the columns of the input and of each layer's output.
    pub(crate) fn random(widths: &[usize], random: &mut Seeded) -> Self {
        Self {
            layers: widths
                .windows(2)
                .map(|pair| linear_initial(pair[0], pair[1], random))
                .collect(),
        }
    }

    /// Columns of the input and of each layer's output.
    pub(super) fn widths(&self) -> Vec<usize> {
        let input = self.layers.first().map(|[weight, _]| weight.ncols());
        input
            .into_iter()
            .chain(self.layers.iter().map(|[weight, _]| weight.nrows()))
            .collect()
    }

    /// PyTorch's names in a `Sequential` called `prefix`, or of a single `Linear` of that name.
    pub(crate) fn names(&self, prefix: &str) -> Vec<String> {
        let name = |place: usize| match self.layers.len() {
            1 => prefix.to_owned(),
            _ => format!("{prefix}.{}", 2 * place),
        };
        (0..self.layers.len())
            .flat_map(|i| ["weight", "bias"].map(|part| format!("{}.{part}", name(i))))
            .collect()
    }

    pub(crate) fn parameters(&self) -> Vec<&Array2<T>> {
        self.layers.iter().flatten().collect()
    }

    pub(crate) fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.layers.iter_mut().flatten().collect()
    }

    pub(crate) fn forward(&self, input: Array2<T>) -> DenseActivations<T> {
        let mut inputs = Vec::new();
        let mut gelus = Vec::new();
        let mut output = input;
        for (place, [weight, bias]) in self.layers.iter().enumerate() {
            if place > 0 {
                let cumulative = cumulative(&output);
                let passed = &output * &cumulative;
                gelus.push([output, cumulative]);
                output = passed;
            }

            let next = linear(&output, weight, bias);
            inputs.push(output);
            output = next;
        }

        DenseActivations {
            inputs,
            gelus,
            output,
        }
    }

    /// Adds the parameters' gradient to `gradient`; the gradient by the input is returned.
    pub(crate) fn backward(
        &self,
        forward: &DenseActivations<T>,
        d_output: &Array2<T>,
        gradient: &mut Self,
    ) -> Array2<T> {
        let mut d = d_output.clone();
        for place in (0..self.layers.len()).rev() {
            gradient.layers[place][0] += &d.t().dot(&forward.inputs[place]);
            gradient.layers[place][1] += &d.sum_axis(Axis(0));
            d = d.dot(&self.layers[place][0]);

            if place > 0 {
                let [input, cumulative] = &forward.gelus[place - 1];
                gelu_backward(&mut d, input, cumulative);
            }
        }

        d
    }
}

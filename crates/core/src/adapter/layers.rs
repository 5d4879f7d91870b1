//! The layers of the networks, with forward and backward passes written by hand. Rows are samples;
//! weights are (out, in), as in PyTorch, and biases (1, out).

use multiversion::multiversion;
use multiversion::target::target_cfg_f;
use ndarray::{Array1, Array2, Axis, Zip};

use super::Real;
use super::seeded::Seeded;

/// Added to the variance in LayerNorm; PyTorch's default.
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
    // For a single row, matrix-vector is faster: a matrix product first copies the weight into
    // blocks.
    if let (1, Some(row), Some(weight)) = (input.nrows(), input.as_slice(), weight.as_slice()) {
        return Array1::from(dot_products(weight, row)).insert_axis(Axis(0)) + bias;
    }

    input.dot(&weight.t()) + bias
}

/// Terms of a dot product that are summed side by side.
const LANES: usize = 32;

/// The dot products of a vector with the rows of a matrix, by the widest instructions of this
/// processor. The order of the sums is fixed. Loops over indexes: closures would be compiled without
/// those instructions.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn dot_products<T: Real>(matrix: &[T], vector: &[T]) -> Vec<T> {
    let mut products = Vec::with_capacity(matrix.len() / vector.len().max(1));
    let (vector_lanes, vector_rest) = vector.as_chunks::<LANES>();
    for row in matrix.chunks_exact(vector.len().max(1)) {
        let (row_lanes, row_rest) = row.as_chunks::<LANES>();
        let mut sums = [T::zero(); LANES];
        for (row, vector) in row_lanes.iter().zip(vector_lanes) {
            for lane in 0..LANES {
                sums[lane] += row[lane] * vector[lane];
            }
        }

        let mut sum = T::zero();
        for (&x, &y) in row_rest.iter().zip(vector_rest) {
            sum += x * y;
        }
        for lane in sums {
            sum += lane;
        }
        products.push(sum);
    }

    products
}

/// The dot products of a vector with the rows of a matrix, in f64: to the bit those of [`dot_products`] with
/// both in f64, at half the memory. A product of two f32 is exact in f64, so that a fused multiply-add rounds
/// as a multiplication and an addition do.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
pub(super) fn wide_dot_products(matrix: &[f32], vector: &[f32]) -> Vec<f64> {
    let wide: Vec<f64> = vector.iter().copied().map(f64::from).collect();
    let mut products = Vec::with_capacity(matrix.len() / vector.len().max(1));
    let (vector_lanes, vector_rest) = wide.as_chunks::<LANES>();
    for row in matrix.chunks_exact(vector.len().max(1)) {
        let (row_lanes, row_rest) = row.as_chunks::<LANES>();
        let mut sums = [0.0_f64; LANES];
        for (row, vector) in row_lanes.iter().zip(vector_lanes) {
            for lane in 0..LANES {
                let x = f64::from(row[lane]);
                // Without the instruction, mul_add would be a slow call.
                sums[lane] = if target_cfg_f!(target_feature = "fma") {
                    x.mul_add(vector[lane], sums[lane])
                } else {
                    x * vector[lane] + sums[lane]
                };
            }
        }

        let mut sum = 0.0;
        for (&x, &y) in row_rest.iter().zip(vector_rest) {
            sum += f64::from(x) * y;
        }
        for lane in sums {
            sum += lane;
        }
        products.push(sum);
    }

    products
}

/// Normalizes every row to mean 0 and standard deviation 1. Returns the reciprocals of the standard
/// deviations, shape (n, 1).
pub(super) fn normalize<T: Real>(rows: &mut Array2<T>) -> Array2<T> {
    let width = T::of(rows.ncols() as f64);
    let mut inverse_deviation = Array2::zeros((rows.nrows(), 1));
    for (mut row, mut scale) in rows
        .outer_iter_mut()
        .zip(inverse_deviation.outer_iter_mut())
    {
        let mean = row.sum() / width;
        row.mapv_inplace(|x| x - mean);
        let variance = row.dot(&row) / width;
        scale[0] = (variance + T::of(LAYER_NORM_EPS)).sqrt().recip();

        row.mapv_inplace(|x| x * scale[0]);
    }

    inverse_deviation
}

/// Turns `d` from the gradient with respect to the output of [`normalize`] into the gradient with
/// respect to its input.
pub(super) fn normalize_backward<T: Real>(
    d: &mut Array2<T>,
    normalized: &Array2<T>,
    inverse_deviation: &Array2<T>,
) {
    let width = T::of(d.ncols() as f64);
    for ((mut row, normalized), scale) in d
        .outer_iter_mut()
        .zip(normalized.outer_iter())
        .zip(inverse_deviation.iter())
    {
        // With y = (x − mean)/deviation (`normalized`), where mean and deviation depend on x too:
        // dx = (dy − mean(dy) − y · mean(dy ⊙ y)) / deviation.
        let mean = row.sum() / width;

        let along = row.dot(&normalized) / width;
        Zip::from(&mut row)
            .and(&normalized)
            .for_each(|d, &x| *d = *scale * (*d - mean - x * along));
    }
}

/// Φ(x), the cumulative distribution function of the standard normal distribution. Exact GELU is x
/// Φ(x).
pub(super) fn cumulative<T: Real>(input: &Array2<T>) -> Array2<T> {
    input.mapv(T::normal_cumulative)
}

/// Turns `d` from the gradient with respect to GELU's output into the gradient with respect to its
/// input x. The derivative is Φ(x) + x p(x), with p the density of the standard normal
/// distribution.
pub(super) fn gelu_backward<T: Real>(d: &mut Array2<T>, input: &Array2<T>, cumulative: &Array2<T>) {
    Zip::from(d)
        .and(input)
        .and(cumulative)
        .for_each(|d, &x, &cumulative| *d *= cumulative + x * x.normal_density());
}

/// Linear layers with GELU between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Dense<T> {
    /// Weight and bias of each layer.
    pub(super) layers: Vec<[Array2<T>; 2]>,
}

/// Intermediate values of the forward pass that [`Dense::backward`] uses.
pub struct DenseActivations<T> {
    /// The input of each layer.
    inputs: Vec<Array2<T>>,
    /// The input x of each GELU, and Φ(x).
    gelus: Vec<[Array2<T>; 2]>,
    /// The output of the last layer, shape (n, k).
    pub output: Array2<T>,
}

impl<T: Real> Dense<T> {
    /// Initial weights as PyTorch draws them; `widths` are the columns of the input and of each
    /// layer's output.
    pub fn random(widths: &[usize], random: &mut Seeded) -> Self {
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

    /// PyTorch's names of the tensors: in a `Sequential` called `prefix`, or for a single layer in
    /// a `Linear` of that name.
    pub fn names(&self, prefix: &str) -> Vec<String> {
        // In a `Sequential`, the GELUs have the odd indices.
        let name = |place: usize| match self.layers.len() {
            1 => prefix.to_owned(),
            _ => format!("{prefix}.{}", 2 * place),
        };
        (0..self.layers.len())
            .flat_map(|i| ["weight", "bias"].map(|part| format!("{}.{part}", name(i))))
            .collect()
    }

    /// Weight and bias of each layer, in order.
    pub fn parameters(&self) -> Vec<&Array2<T>> {
        self.layers.iter().flatten().collect()
    }

    /// [`Dense::parameters`], mutable.
    pub fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        self.layers.iter_mut().flatten().collect()
    }

    /// The forward pass of rows, shape (n, d).
    pub fn forward(&self, input: Array2<T>) -> DenseActivations<T> {
        let mut inputs = Vec::new();
        let mut gelus = Vec::new();
        let mut output = input;
        for (place, [weight, bias]) in self.layers.iter().enumerate() {
            // A GELU precedes each layer but the first. Its input and Φ are kept for the backward
            // pass.
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

    /// Adds the gradient of the parameters to `gradient` and returns the gradient with respect to
    /// the input.
    pub fn backward(
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the same sums of numbers that were widened before.
    #[test]
    fn products_of_single_numbers_are_exact() {
        for width in [1, 33, 100, 768] {
            let entry =
                |at: usize| ((at * 37 % 101) as f32 * 0.37).sin() * 10_f32.powi((at % 9) as i32);
            let matrix: Vec<f32> = (0..5 * width).map(entry).collect();
            let vector: Vec<f32> = (7..7 + width).map(entry).collect();
            let wide = |values: &[f32]| values.iter().copied().map(f64::from).collect::<Vec<f64>>();

            let expected = dot_products(&wide(&matrix), &wide(&vector));
            assert_eq!(wide_dot_products(&matrix, &vector), expected);
        }
    }

    /// Oracle: the definition, in integers, which f64 and f32 add exactly.
    #[test]
    fn dot_products_are_sums_of_products() {
        for width in [1, 31, 32, 33, 100] {
            let entry = |at: usize| (at * 7 % 11) as i32 - 5;
            let expected: Vec<i32> = (0..3)
                .map(|row| {
                    (0..width)
                        .map(|i| entry(row * width + i) * entry(2 * i))
                        .sum()
                })
                .collect();

            let of = |count: usize, step: usize| -> Vec<f64> {
                (0..count).map(|at| f64::from(entry(at * step))).collect()
            };
            let (matrix, vector) = (of(3 * width, 1), of(width, 2));
            let found = dot_products(&matrix, &vector);
            assert_eq!(
                found,
                expected.iter().map(|&x| f64::from(x)).collect::<Vec<_>>()
            );

            let single = |values: &[f64]| values.iter().map(|&x| x as f32).collect::<Vec<_>>();
            let found = dot_products(&single(&matrix), &single(&vector));
            assert_eq!(
                found,
                expected.iter().map(|&x| x as f32).collect::<Vec<_>>()
            );
        }
    }
}

//! The network of a member of a relational reader: similarities of cells in, a Gaussian density of
//! the motion out; and its training objective.

use ndarray::{Array2, ArrayView1, Axis};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::layers::{cumulative, gelu_backward, linear, linear_initial};
use super::super::phi::{Phi, Widths};
use super::super::seeded::Seeded;
use super::super::{At, Network, Objective, Real};
use super::cells::{CellLayout, Cells};
use super::inputs::{InputLayout, mirrored};
use super::pairs::{DrawnPair, PairSampler};
use crate::geometry::Twist;
use crate::statistics::normal_deviates;

/// Outputs: six means; of the square root R of the information matrix, six logarithms of the
/// diagonal and 15 scaled entries below it. See [`density`].
pub const OUTPUTS: usize = 27;

/// Scale of the twists in the network: meters for v, radians for ω.
pub const TWIST_SCALE: [f64; 6] = [0.3, 0.3, 0.3, 0.4, 0.4, 0.4];

/// Bounds of the logarithm of a diagonal entry of R, in units of [`TWIST_SCALE`]: conditional standard
/// deviations of 7 units to 0.05 units.
const LOG_ROOT: [f64; 2] = [-2.0, 3.0];

/// The factor on the initial weights of the entries of R, which starts R near the identity.
const INITIAL_FACTOR: f64 = 0.1;

/// PyTorch's names of the tensors of the last layer.
const HEAD_NAMES: [&str; 2] = ["5.weight", "5.bias"];

/// Parameters of a member: Linear → LayerNorm → GELU → Linear → GELU → Linear.
#[derive(Debug, Clone, PartialEq)]
pub struct RelationalNetwork<T> {
    /// The first two linear layers.
    body: Phi<T>,
    /// Weight and bias of the last layer.
    head: [Array2<T>; 2],
}

/// A Gaussian density of a twist, in units of [`TWIST_SCALE`].
///
/// With e = y − mean, u = R e is standard normal. R is the square root of the information matrix:
/// lower triangular, with RᵀR = Σ⁻¹.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Density {
    /// The mean.
    pub mean: [f64; 6],
    /// R, row by row; zeros above the diagonal.
    pub root: [[f64; 6]; 6],
    /// The logarithm of R's determinant.
    pub log_determinant: f64,
}

impl Density {
    /// The logarithm of the density at y, up to the constant −3 ln 2π.
    pub fn log_likelihood(&self, y: &[f64; 6]) -> f64 {
        let mut squares = 0.0;
        for (i, row) in self.root.iter().enumerate() {
            let u: f64 = (0..=i).map(|j| row[j] * (y[j] - self.mean[j])).sum();
            squares += u * u;
        }

        self.log_determinant - squares / 2.0
    }
}

/// The density of a row of [`OUTPUTS`] outputs: the mean, then d and c with R_ii = exp d_i and
/// R_ij = c_ij exp d_i for j < i.
pub fn density<T: Real>(outputs: ArrayView1<'_, T>) -> Density {
    let mut found = Density {
        mean: [0.0; 6],
        root: [[0.0; 6]; 6],
        log_determinant: 0.0,
    };

    let mut coupling = 12;
    for i in 0..6 {
        let log_root = outputs[6 + i].f64().clamp(LOG_ROOT[0], LOG_ROOT[1]);
        found.mean[i] = outputs[i].f64();
        found.root[i][i] = log_root.exp();
        found.log_determinant += log_root;

        for j in 0..i {
            found.root[i][j] = outputs[coupling].f64() * log_root.exp();
            coupling += 1;
        }
    }

    found
}

/// The negative log-likelihood of y under a row of outputs, without its constant, and its gradient
/// with respect to the outputs.
fn loss<T: Real>(outputs: ArrayView1<'_, T>, y: &[f64; 6], gradient: &mut [f64]) -> f64 {
    let found = density(outputs);
    let error: [f64; 6] = std::array::from_fn(|i| y[i] - found.mean[i]);
    gradient.fill(0.0);

    let mut coupling = 12;
    for i in 0..6 {
        let root = found.root[i];
        let u: f64 = (0..=i).map(|j| root[j] * error[j]).sum();

        for j in 0..=i {
            gradient[j] -= u * root[j];
        }
        for error in &error[..i] {
            gradient[coupling] = u * root[i] * error;
            coupling += 1;
        }

        // A clamped logarithm does not move.
        let given = outputs[6 + i].f64();
        if given > LOG_ROOT[0] && given < LOG_ROOT[1] {
            gradient[6 + i] = u * u - 1.0;
        }
    }

    -found.log_likelihood(y)
}

impl<T: Real> RelationalNetwork<T> {
    /// Initial weights of a seed. Linear layers are drawn as in PyTorch; the rows of precisions and
    /// couplings are scaled down.
    pub fn initial(inputs: usize, hidden: usize, seed: u64) -> Self {
        let widths = Widths {
            feature: inputs,
            hidden,
            latent: hidden,
        };
        let mut random = Seeded::new(seed);
        let body = Phi::random(widths, &mut random);
        let mut head = linear_initial(hidden, OUTPUTS, &mut random);
        for output in 6..OUTPUTS {
            let scale = |x: &mut T| *x *= T::of(INITIAL_FACTOR);
            head[0].row_mut(output).iter_mut().for_each(scale);
            head[1].column_mut(output).iter_mut().for_each(scale);
        }

        Self { body, head }
    }

    /// The outputs for rows of inputs, shape (n, 27).
    pub fn outputs(&self, inputs: Array2<T>) -> Array2<T> {
        let between = self.body.forward(&inputs).latents;
        let hidden = &between * &cumulative(&between);
        linear(&hidden, &self.head[0], &self.head[1])
    }

    /// Width of the hidden layers.
    pub fn hidden_dim(&self) -> usize {
        self.body.hidden_dim()
    }
}

impl<T: Real> Network<T> for RelationalNetwork<T> {
    fn names(&self) -> Vec<String> {
        let names = Phi::<T>::NAMES.into_iter().chain(HEAD_NAMES);
        names.map(str::to_owned).collect()
    }

    fn parameters(&self) -> Vec<&Array2<T>> {
        self.body
            .parameters()
            .into_iter()
            .chain(&self.head)
            .collect()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>> {
        let body = self.body.parameters_mut().into_iter();
        body.chain(&mut self.head).collect()
    }
}

/// Pairs per epoch. Pairs are drawn anew for every batch, so an epoch is only a unit of progress.
pub const PAIRS_PER_EPOCH: usize = 25_600;

/// Training data: the cells of all images, and a source of pairs.
#[derive(Debug, Clone)]
pub struct RelationalSamples {
    layout: CellLayout,
    inputs: InputLayout,
    cells: Cells,
    pairs: PairSampler,
}

impl RelationalSamples {
    /// Training data of images that `pairs` refers to by their position in `cells`.
    pub fn new(layout: &CellLayout, cells: Cells, pairs: PairSampler) -> Self {
        Self {
            inputs: InputLayout::of(layout),
            layout: layout.clone(),
            cells,
            pairs,
        }
    }

    /// Number of inputs of the network.
    pub fn input_count(&self) -> usize {
        self.inputs.width()
    }

    /// Inputs and targets of `count` pairs, drawn from the seed and the step. Half of the pairs are
    /// mirrored, and all similarities get Gaussian noise of the configured size. Targets are in
    /// units of [`TWIST_SCALE`].
    fn batch<T: Real>(&self, count: usize, at: At<'_>) -> (Array2<T>, Vec<[f64; 6]>) {
        let mut random = ChaCha8Rng::seed_from_u64(at.config.seed);
        random.set_stream(at.step);

        let mut inputs = Array2::zeros((count, self.inputs.width()));
        let mut targets = Vec::with_capacity(count);
        let mut row = vec![0.0f32; self.inputs.width()];
        for mut into in inputs.outer_iter_mut() {
            let DrawnPair { rows, motion } = self.pairs.draw(&mut random);
            let mut similarities = self.cells.pair(rows[0], rows[1]);
            let mut target = in_units(&motion);

            if random.random::<bool>() {
                for (part, &grid) in similarities.iter_mut().zip(self.layout.grids()) {
                    mirrored(part, grid);
                }
                target = mirrored_twist(target);
            }

            for part in &mut similarities {
                let noise = normal_deviates(&mut random, part.len());
                for (value, deviate) in part.iter_mut().zip(noise) {
                    *value += (at.config.noise * deviate) as f32;
                }
            }

            self.inputs
                .write(similarities.iter().map(|part| part.view()), &mut row);
            into.iter_mut()
                .zip(&row)
                .for_each(|(into, &x)| *into = T::of(f64::from(x)));
            targets.push(target);
        }

        (inputs, targets)
    }
}

/// A twist in units of [`TWIST_SCALE`].
pub fn in_units(twist: &Twist) -> [f64; 6] {
    let vector = twist.to_vector();
    std::array::from_fn(|i| vector[i] / TWIST_SCALE[i])
}

/// The motion between two mirrored images: x of v, and y and z of ω change sign.
fn mirrored_twist([vx, vy, vz, wx, wy, wz]: [f64; 6]) -> [f64; 6] {
    [-vx, vy, vz, wx, -wy, -wz]
}

impl<T: Real> Objective<T> for RelationalNetwork<T> {
    type Data = RelationalSamples;

    fn count(_: &Self::Data) -> usize {
        PAIRS_PER_EPOCH
    }

    fn gradient(&self, samples: &Self::Data, batch: &[usize], at: At<'_>) -> (f64, Self) {
        let (inputs, targets) = samples.batch(batch.len(), at);
        self.loss_gradient(inputs, &targets)
    }
}

impl<T: Real> RelationalNetwork<T> {
    /// The mean negative log-likelihood of targets, in units of [`TWIST_SCALE`], for rows of inputs, and
    /// its gradient.
    fn loss_gradient(&self, inputs: Array2<T>, targets: &[[f64; 6]]) -> (f64, Self) {
        let forward = self.body.forward(&inputs);
        let between = cumulative(&forward.latents);
        let hidden = &forward.latents * &between;
        let outputs = linear(&hidden, &self.head[0], &self.head[1]);

        let count = targets.len().max(1) as f64;
        let mut total = 0.0;
        let mut d_outputs = Array2::zeros(outputs.dim());
        let mut of_row = [0.0; OUTPUTS];
        let rows = outputs.outer_iter().zip(targets);
        for ((row, target), mut d_row) in rows.zip(d_outputs.outer_iter_mut()) {
            total += loss(row, target, &mut of_row) / count;
            d_row
                .iter_mut()
                .zip(of_row)
                .for_each(|(into, d)| *into = T::of(d / count));
        }

        let mut gradient = Self {
            body: self.body.zeros(),
            head: [
                d_outputs.t().dot(&hidden),
                d_outputs.sum_axis(Axis(0)).insert_axis(Axis(0)),
            ],
        };
        let mut d_between = d_outputs.dot(&self.head[0]);
        gelu_backward(&mut d_between, &forward.latents, &between);
        self.body
            .backward_whole(&inputs, &forward, &d_between, &mut gradient.body);

        (total, gradient)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix6, Vector6};

    use super::*;
    use crate::geometry::exp;

    fn wave(index: usize) -> f64 {
        ((index * index) as f64 * 0.37 + 0.5).sin()
    }

    /// Oracle: the general formula of a Gaussian density, with nalgebra's inverse and determinant.
    #[test]
    fn the_likelihood_is_that_of_a_gaussian() {
        let outputs = ndarray::Array1::from_shape_fn(OUTPUTS, wave);
        let found = density(outputs.view());
        let root = Matrix6::from_fn(|i, j| found.root[i][j]);
        let covariance = (root.transpose() * root).try_inverse().unwrap();

        let y: [f64; 6] = std::array::from_fn(|i| wave(i + 40));
        let error = Vector6::from_fn(|i, _| y[i] - found.mean[i]);
        let squares = (error.transpose() * covariance.try_inverse().unwrap() * error)[(0, 0)];
        let expected = -0.5 * (squares + covariance.determinant().ln());

        assert!((found.log_likelihood(&y) - expected).abs() < 1e-9);
    }

    /// Oracle: central differences of the loss.
    #[test]
    fn the_gradient_is_that_of_the_loss() {
        let outputs = ndarray::Array1::from_shape_fn(OUTPUTS, wave);
        let y: [f64; 6] = std::array::from_fn(|i| wave(i + 40));
        let mut gradient = [0.0; OUTPUTS];
        loss(outputs.view(), &y, &mut gradient);

        let mut unused = [0.0; OUTPUTS];
        for place in 0..OUTPUTS {
            let mut at = |step: f64| {
                let mut moved = outputs.clone();
                moved[place] += step;
                loss(moved.view(), &y, &mut unused)
            };
            let expected = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((gradient[place] - expected).abs() < 1e-6, "output {place}");
        }
    }

    /// Oracle: the definition. Mirroring the world left to right turns a pose T into M T M with M =
    /// diag(−1, 1, 1, 1).
    #[test]
    fn a_mirrored_twist_is_the_motion_of_the_mirrored_camera() {
        let twist = [0.3, -0.2, 0.5, 0.1, -0.4, 0.2];
        let pose = |twist: [f64; 6]| exp(&Twist::from_vector(&twist.into())).to_homogeneous();
        let mirror = nalgebra::Matrix4::from_diagonal(&[-1.0, 1.0, 1.0, 1.0].into());

        let expected = mirror * pose(twist) * mirror;
        assert!((pose(mirrored_twist(twist)) - expected).norm() < 1e-12);
    }

    /// Oracle: central differences of the loss, for some numbers of every tensor.
    #[test]
    fn the_gradient_of_the_network_is_that_of_the_loss() {
        let network = RelationalNetwork::<f64>::initial(9, 7, 3);
        let inputs = Array2::from_shape_fn((4, 9), |(row, column)| wave(row * 9 + column));
        let targets: Vec<[f64; 6]> = (0..4)
            .map(|row| std::array::from_fn(|i| wave(row * 6 + i + 90)))
            .collect();
        let (_, gradient) = network.loss_gradient(inputs.clone(), &targets);

        for (tensor, found) in gradient.parameters().into_iter().enumerate() {
            for place in [0, found.len() / 2, found.len() - 1] {
                let loss = |step: f64| {
                    let mut moved = network.clone();
                    let weights = moved.parameters_mut().swap_remove(tensor);
                    *weights.iter_mut().nth(place).unwrap() += step;
                    moved.loss_gradient(inputs.clone(), &targets).0
                };
                let expected = (loss(1e-6) - loss(-1e-6)) / 2e-6;
                let found = *found.iter().nth(place).unwrap();
                assert!((found - expected).abs() < 1e-6, "tensor {tensor}, {place}");
            }
        }
    }
}

//! What every trained network has in common: named tensors, and AdamW over them.
//!
//! Tensors have the names of PyTorch's state dicts. Vectors are stored as (1, n) and scalars as (1,
//! 1).

use ndarray::{Array2, Zip};

use super::{Real, TrainConfig};

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const ADAM_EPS: f64 = 1e-8;
const CLIP_EPS: f64 = 1e-6;

/// Parameters that are trained together, or anything of the same shape, such as their gradients.
pub trait Network<T: Real>: Clone {
    /// PyTorch's names of the tensors.
    fn names(&self) -> Vec<String>;

    /// The tensors, in the order of the names.
    fn parameters(&self) -> Vec<&Array2<T>>;

    /// The tensors for modification, in the order of the names.
    fn parameters_mut(&mut self) -> Vec<&mut Array2<T>>;

    /// A network of the same shape in which every number is zero.
    fn zeros_like(&self) -> Self {
        let mut zeros = self.clone();
        zeros
            .parameters_mut()
            .into_iter()
            .for_each(|tensor| tensor.fill(T::zero()));

        zeros
    }

    /// The name of the first tensor that holds a number that is not finite.
    fn not_finite(&self) -> Option<String> {
        let bad = |tensor: &&Array2<T>| tensor.iter().any(|x| !x.is_finite());
        self.names()
            .into_iter()
            .zip(self.parameters())
            .find(|(_, tensor)| bad(tensor))
            .map(|(name, _)| name)
    }
}

/// A network that can be trained: it has a loss and the loss's gradient.
pub trait Objective<T: Real>: Network<T> {
    /// The training data.
    type Data;

    /// How many samples there are.
    fn count(data: &Self::Data) -> usize;

    /// The loss on a batch of samples, and its gradient with respect to every parameter.
    fn gradient(&self, data: &Self::Data, batch: &[usize], at: At<'_>) -> (f64, Self);
}

/// The settings of a training run and how far it has come.
#[derive(Debug, Clone, Copy)]
pub struct At<'a> {
    /// The settings.
    pub config: &'a TrainConfig,
    /// Optimiser steps taken so far.
    pub step: u64,
}

/// AdamW with clipping of the gradient's global norm. Weight decay is decoupled and applies to
/// every parameter.
pub(super) struct AdamW<T> {
    first_moments: Vec<Array2<T>>,
    second_moments: Vec<Array2<T>>,
    steps: i32,
}

impl<T: Real> AdamW<T> {
    pub fn new(network: &impl Network<T>) -> Self {
        let zeros = || {
            network
                .parameters()
                .into_iter()
                .map(|tensor| Array2::zeros(tensor.dim()))
                .collect()
        };

        Self {
            first_moments: zeros(),
            second_moments: zeros(),
            steps: 0,
        }
    }

    /// Takes one optimiser step and returns the global norm of the gradient before clipping.
    pub fn step<N: Network<T>>(
        &mut self,
        weights: &mut N,
        gradient: &N,
        config: &TrainConfig,
    ) -> f64 {
        let gradient = gradient.parameters();
        let squares: f64 = gradient
            .iter()
            .flat_map(|tensor| tensor.iter())
            .map(|x| x.f64() * x.f64())
            .sum();
        let gradient_norm = squares.sqrt();

        // A gradient longer than `clip_norm` is scaled down to that length, over all tensors
        // together.
        let clip = T::of((config.clip_norm / (gradient_norm + CLIP_EPS)).min(1.0));
        self.steps += 1;
        let beta_1 = T::of(BETA_1);
        let beta_2 = T::of(BETA_2);

        // Adam's moments start at zero and are too small at first: `rate` corrects the first
        // moment for it, `root` the second.
        let decay = T::of(1.0 - config.learning_rate * config.weight_decay);
        let rate = T::of(config.learning_rate / (1.0 - BETA_1.powi(self.steps)));
        let root = T::of((1.0 - BETA_2.powi(self.steps)).sqrt());
        let rest_1 = T::of(1.0 - BETA_1);

        let rest_2 = T::of(1.0 - BETA_2);
        let eps = T::of(ADAM_EPS);
        let moments = self.first_moments.iter_mut().zip(&mut self.second_moments);
        for ((weight, gradient), (first, second)) in weights
            .parameters_mut()
            .into_iter()
            .zip(gradient)
            .zip(moments)
        {
            Zip::from(weight)
                .and(gradient)
                .and(first)
                .and(second)
                .for_each(|w, &g, m, v| {
                    let g = g * clip;
                    *m = *m * beta_1 + g * rest_1;
                    *v = *v * beta_2 + g * g * rest_2;
                    *w = *w * decay - rate * *m / (v.sqrt() / root + eps);
                });
        }

        gradient_norm
    }
}

//! Training: AdamW with decoupled decay on every parameter, global-norm clipping, seeded order.
//!
//! A frame occurs in many pairs, so φ runs once for each distinct frame of a batch; the gradient of its latent is
//! the sum over its pairs. On one machine the same seed gives the same bits; a seed draws the weights and orders that
//! PyTorch draws from it (`torch.manual_seed`, the module, then `torch.randperm` an epoch).

use super::seeded::Seeded;
use super::siamese::Widths;
use super::{Error, LATENT_DIM, Real, Siamese, TargetScale, mean_squared_error};
use crate::geometry::Twist;
use ndarray::{Array2, ArrayView2, Axis, Zip};

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const ADAM_EPS: f64 = 1e-8;
const CLIP_EPS: f64 = 1e-6;

/// Settings that change the numbers; recorded with the adapter.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainConfig {
    /// Passes over the pairs.
    pub epochs: usize,
    /// Pairs in a step; the last, shorter batch of an epoch is kept.
    pub batch: usize,
    /// Constant.
    pub learning_rate: f64,
    /// Decoupled, on every parameter.
    pub weight_decay: f64,
    /// The largest global norm of a gradient.
    pub clip_norm: f64,
    /// Columns between the two linear layers.
    pub hidden: usize,
    /// Columns of a latent.
    pub latent: usize,
    /// Of the initial weights and of the order of the pairs.
    pub seed: u64,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            epochs: 10,
            batch: 512,
            learning_rate: 1e-3,
            weight_decay: 1e-2,
            clip_norm: 1.0,
            hidden: 64,
            latent: LATENT_DIM,
            seed: 0,
        }
    }
}

/// What is learned from: features of any number of rooms one below the other, and pairs of their rows.
#[derive(Debug, Clone)]
pub struct Samples<T> {
    features: Array2<T>,
    pairs: Vec<[usize; 2]>,
    targets: Array2<T>,
    scale: TargetScale,
}

impl<T: Real> Samples<T> {
    /// `features` (n, d); `pairs` of its rows, source first; the true `twists` of those pairs.
    ///
    /// # Errors
    /// [`Error::NoPairs`] when there is none, or not one twist for each; [`Error::NoMotion`].
    pub fn new(features: ArrayView2<'_, f32>, pairs: Vec<[usize; 2]>, twists: &[Twist]) -> Result<Self, Error> {
        if pairs.is_empty() || pairs.len() != twists.len() || pairs.iter().flatten().any(|&row| row >= features.nrows())
        {
            return Err(Error::NoPairs);
        }
        let scale = TargetScale::of(twists);
        if twists.iter().all(|twist| (twist.to_vector() - scale.mean).amax() < super::STILL) {
            return Err(Error::NoMotion);
        }
        let normalised: Vec<_> = twists.iter().map(|&twist| scale.normalised(twist)).collect();
        let targets = Array2::from_shape_fn((twists.len(), 6), |(row, column)| T::of(normalised[row][column]));
        Ok(Self { features: features.mapv(|x| T::of(f64::from(x))), pairs, targets, scale })
    }

    /// Mean and deviation of the twists.
    pub fn scale(&self) -> &TargetScale {
        &self.scale
    }

    /// How many pairs there are.
    pub fn pair_count(&self) -> usize {
        self.pairs.len()
    }
}

/// One step of the optimiser, as it was before the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Mean squared error of the batch.
    pub loss: f64,
    /// Global norm of the gradient before clipping.
    pub gradient_norm: f64,
}

/// The state of a training run.
pub struct Trainer<'a, T> {
    samples: &'a Samples<T>,
    config: TrainConfig,
    weights: Siamese<T>,
    first_moment: Siamese<T>,
    second_moment: Siamese<T>,
    steps: i32,
    slots: Vec<usize>,
}

impl<'a, T: Real> Trainer<'a, T> {
    /// Begins at `weights`.
    pub fn new(samples: &'a Samples<T>, weights: Siamese<T>, config: TrainConfig) -> Self {
        let (first_moment, second_moment) = (weights.zeros_like(), weights.zeros_like());
        let slots = vec![usize::MAX; samples.features.nrows()];
        Self { samples, config, weights, first_moment, second_moment, steps: 0, slots }
    }

    /// The weights as they are now.
    pub fn weights(&self) -> &Siamese<T> {
        &self.weights
    }

    /// Loss and gradient of a batch of pairs, before clipping.
    pub fn gradient(&mut self, batch: &[usize]) -> (f64, Siamese<T>) {
        let (frames, pair_slots) = self.distinct_frames(batch);
        let forward = self.weights.forward(self.samples.features.select(Axis(0), &frames));
        let latent = |end: usize| {
            let rows: Vec<usize> = pair_slots.iter().map(|slots| slots[end]).collect();
            forward.latents.select(Axis(0), &rows)
        };
        let steps = latent(1) - latent(0);
        let predicted = steps.dot(&self.weights.motion_matrix().t());
        let targets = self.samples.targets.select(Axis(0), batch);
        let (loss, d_predicted) = mean_squared_error(predicted.view(), targets.view());
        let mut gradient = self.weights.zeros_like();
        gradient.add_to_motion(d_predicted.t().dot(&steps));
        let d_steps = d_predicted.dot(&self.weights.motion_matrix());
        let mut d_latents = Array2::zeros(forward.latents.dim());
        for (slots, d_step) in pair_slots.iter().zip(d_steps.outer_iter()) {
            let mut target = d_latents.row_mut(slots[1]);
            target += &d_step;
            let mut source = d_latents.row_mut(slots[0]);
            source -= &d_step;
        }
        self.weights.backward(&forward, &d_latents, &mut gradient);
        (loss, gradient)
    }

    /// One step on the pairs that `batch` names.
    pub fn step(&mut self, batch: &[usize]) -> StepReport {
        let (loss, gradient) = self.gradient(batch);
        let squares: f64 = gradient.tensors().iter().flat_map(|tensor| tensor.iter()).map(|x| x.f64() * x.f64()).sum();
        let gradient_norm = squares.sqrt();
        let clip = T::of((self.config.clip_norm / (gradient_norm + CLIP_EPS)).min(1.0));
        self.steps += 1;
        let (beta_1, beta_2) = (T::of(BETA_1), T::of(BETA_2));
        let decay = T::of(1.0 - self.config.learning_rate * self.config.weight_decay);
        let rate = T::of(self.config.learning_rate / (1.0 - BETA_1.powi(self.steps)));
        let root = T::of((1.0 - BETA_2.powi(self.steps)).sqrt());
        let (rest_1, rest_2, eps) = (T::of(1.0 - BETA_1), T::of(1.0 - BETA_2), T::of(ADAM_EPS));
        let moments = self.first_moment.tensors_mut().into_iter().zip(self.second_moment.tensors_mut());
        for ((weight, gradient), (first, second)) in
            self.weights.tensors_mut().into_iter().zip(gradient.tensors()).zip(moments)
        {
            Zip::from(weight).and(gradient).and(first).and(second).for_each(|w, &g, m, v| {
                let g = g * clip;
                *m = *m * beta_1 + g * rest_1;
                *v = *v * beta_2 + g * g * rest_2;
                *w = *w * decay - rate * *m / (v.sqrt() / root + eps);
            });
        }
        StepReport { loss, gradient_norm }
    }

    /// The distinct rows of a batch and, for each pair, the places of its two ends among them.
    fn distinct_frames(&mut self, batch: &[usize]) -> (Vec<usize>, Vec<[usize; 2]>) {
        let mut frames = Vec::new();
        let mut place = |row: usize| {
            if self.slots[row] == usize::MAX {
                self.slots[row] = frames.len();
                frames.push(row);
            }
            self.slots[row]
        };
        let pair_slots = batch.iter().map(|&pair| self.samples.pairs[pair].map(&mut place)).collect();
        frames.iter().for_each(|&row| self.slots[row] = usize::MAX);
        (frames, pair_slots)
    }
}

/// How far a training run is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochProgress {
    /// Epochs done, from 1.
    pub done: usize,
    /// Epochs in all.
    pub epochs: usize,
    /// Mean loss of the epoch.
    pub loss: f64,
}

/// Trains from seeded weights and returns the last ones.
///
/// # Errors
/// [`Error::Diverged`] when the loss stops being finite.
///
/// Source: SeeSE3, sec. 2.4.
pub fn train(
    samples: &Samples<f32>,
    config: &TrainConfig,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Siamese<f32>, Error> {
    let widths = Widths { feature: samples.features.ncols(), hidden: config.hidden, latent: config.latent };
    let mut random = Seeded::new(config.seed);
    let mut trainer = Trainer::new(samples, Siamese::random(widths, &mut random), config.clone());
    for epoch in 1..=config.epochs {
        let order = random.permutation(samples.pair_count());
        let losses: Vec<f64> = order.chunks(config.batch.max(1)).map(|batch| trainer.step(batch).loss).collect();
        let loss = crate::scores::mean(&losses);
        if !loss.is_finite() {
            return Err(Error::Diverged { epoch, loss });
        }
        progress(EpochProgress { done: epoch, epochs: config.epochs, loss });
    }
    Ok(trainer.weights)
}

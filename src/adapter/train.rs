//! Training: any network, in seeded order.
//!
//! A frame occurs in many pairs, so φ runs once for each distinct frame of a batch; the gradient of
//! its latent is the sum over its pairs. On one machine the same seed gives the same bits; a seed
//! draws the weights and orders that PyTorch draws from it (`torch.manual_seed`, the module, then
//! `torch.randperm` an epoch).

use super::network::AdamW;
use super::phi::Widths;
use super::seeded::Seeded;
use super::{At, Error, LATENT_DIM, Loss, Mixing, Mixture, Objective, Real, Samples};

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
    /// Columns of a chart's latent, the paper's geo_dim.
    pub latent: usize,
    /// Charts, the paper's K.
    pub charts: usize,
    /// How the charts are mixed; those mixed evenly are learned apart, each for its share of the
    /// epochs.
    pub mixing: Mixing,
    /// What is minimised.
    pub loss: Loss,
    /// Whether features are z-scored by the training frames' statistics; it ends up in the first
    /// layer's weights.
    pub standardise: bool,
    /// Deviation of the noise that is added to every feature at every step, in units of the
    /// features as they are learned.
    pub noise: f64,
    /// Decay of the running average of the weights that is returned instead of the last weights; 0
    /// for none.
    pub average: f64,
    /// Whether μ is taken as zero and σ as the root mean square: then zero motion stays put in
    /// every reading.
    pub through_zero: bool,
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
            charts: 1,
            mixing: Mixing::Gate,
            loss: Loss::MeanSquaredError,
            standardise: false,
            noise: 0.0,
            average: 0.0,
            through_zero: false,
            seed: 0,
        }
    }
}

/// One step of the optimiser, as it was before the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Loss of the batch.
    pub loss: f64,
    /// Global norm of the gradient before clipping.
    pub gradient_norm: f64,
}

/// The state of a training run.
pub struct Trainer<'a, T: Real, N: Objective<T>> {
    data: &'a N::Data,
    config: TrainConfig,
    weights: N,
    optimiser: AdamW<T>,
    steps: u64,
}

impl<'a, T: Real, N: Objective<T>> Trainer<'a, T, N> {
    /// Begins at `weights`.
    pub fn new(data: &'a N::Data, weights: N, config: TrainConfig) -> Self {
        let optimiser = AdamW::new(&weights);
        Self {
            data,
            config,
            weights,
            optimiser,
            steps: 0,
        }
    }

    /// The weights as they are now.
    pub fn weights(&self) -> &N {
        &self.weights
    }

    /// Loss and gradient of a batch of samples, before clipping.
    pub fn gradient(&self, batch: &[usize]) -> (f64, N) {
        self.weights.gradient(
            self.data,
            batch,
            At {
                config: &self.config,
                step: self.steps,
            },
        )
    }

    /// One step on the samples that `batch` names.
    pub fn step(&mut self, batch: &[usize]) -> StepReport {
        let (loss, gradient) = self.gradient(batch);
        self.steps += 1;
        let gradient_norm = self
            .optimiser
            .step(&mut self.weights, &gradient, &self.config);

        StepReport {
            loss,
            gradient_norm,
        }
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

/// Trains from `start` and returns the last weights, or their running average.
///
/// # Errors
/// [`Error::Diverged`] when the loss stops being finite.
pub(crate) fn fit<T: Real, N: Objective<T>>(
    data: &N::Data,
    start: N,
    config: &TrainConfig,
    random: &mut Seeded,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<N, Error> {
    let mut average = (config.average > 0.0).then(|| start.clone());
    let mut trainer = Trainer::new(data, start, config.clone());
    for epoch in 1..=config.epochs {
        let order = random.permutation(N::count(data));
        let mut losses = Vec::new();
        for batch in order.chunks(config.batch.max(1)) {
            losses.push(trainer.step(batch).loss);

            if let Some(average) = &mut average {
                // Shorter at first, or the random weights of the start would stay in a short run.
                let steps = trainer.steps as f64;
                let decay = config.average.min((1.0 + steps) / (10.0 + steps));
                move_towards(average, &trainer.weights, 1.0 - decay);
            }
        }

        let loss = crate::scores::mean(&losses);
        if !loss.is_finite() {
            return Err(Error::Diverged { epoch, loss });
        }

        progress(EpochProgress {
            done: epoch,
            epochs: config.epochs,
            loss,
        });
    }

    Ok(average.unwrap_or(trainer.weights))
}

/// Moves every number by a share of the way to another.
fn move_towards<T: Real, N: Objective<T>>(average: &mut N, weights: &N, share: f64) {
    for (into, weight) in average
        .parameters_mut()
        .into_iter()
        .zip(weights.parameters())
    {
        into.zip_mut_with(weight, |into, &weight| {
            *into += (weight - *into) * T::of(share)
        });
    }
}

/// Trains an adapter's network from seeded weights and returns the last ones.
///
/// # Errors
/// [`Error::Diverged`] when the loss stops being finite, [`Error::Charts`].
///
/// Source: SeeSE3, sec. 2.4; mixtures sec. 2.7.
pub fn train(
    samples: &Samples<f32>,
    config: &TrainConfig,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Mixture<f32>, Error> {
    if config.charts == 0 || config.charts > super::MAX_CHARTS {
        return Err(Error::Charts {
            count: config.charts,
        });
    }

    if config.charts > 1 && config.mixing == Mixing::Gate && config.standardise {
        return Err(Error::GatedStandardised);
    }
    if config.charts == 1 || config.mixing == Mixing::Gate {
        return train_together(samples, config, progress);
    }

    let epochs = config.epochs.div_ceil(config.charts);
    let mut charts = Vec::with_capacity(config.charts);
    for member in 0..config.charts {
        // Seeds of members do not meet those of other runs, which count up by one.
        let seed = u64::from(
            (config.seed as u32).wrapping_add((member as u32).wrapping_mul(MEMBER_SEED_STEP)),
        );

        let alone = TrainConfig {
            charts: 1,
            epochs,
            seed,
            ..config.clone()
        };

        let done = member * epochs;
        let trained = train_together(samples, &alone, &mut |epoch| {
            progress(EpochProgress {
                done: done + epoch.done,
                epochs: config.charts * epochs,
                ..epoch
            });
        })?;

        charts.extend(trained.charts().iter().cloned());
    }

    Mixture::even(charts)
}

/// Between the seeds of two members of an ensemble.
const MEMBER_SEED_STEP: u32 = 0x0100_0193;

fn train_together(
    samples: &Samples<f32>,
    config: &TrainConfig,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Mixture<f32>, Error> {
    let widths = Widths {
        feature: samples.feature_dim(),
        hidden: config.hidden,
        latent: config.latent,
    };

    let mut random = Seeded::new(config.seed);
    let start = Mixture::random(widths, config.charts, &mut random);
    if !config.standardise {
        return fit(samples, start, config, &mut random, progress);
    }

    let (standardised, [mean, deviation]) = samples.standardised();
    let mut network = fit(&standardised, start, config, &mut random, progress)?;
    network.fold_standardisation(&mean, &deviation);

    Ok(network)
}

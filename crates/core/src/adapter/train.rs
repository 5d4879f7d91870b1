//! Training of any network, reproducible from a seed.
//!
//! A frame occurs in many pairs: φ runs once per distinct frame of a batch, and the gradient of a
//! latent is summed over the frame's pairs. On one machine, the same seed gives identical bits.
//! Initial weights and sample orders equal PyTorch's after `torch.manual_seed`, construction of the
//! module, and one `torch.randperm` per epoch.

use super::network::AdamW;
use super::phi::Widths;
use super::seeded::Seeded;
use super::{At, Error, LATENT_DIM, Loss, Mixing, Mixture, Objective, Real, Samples};
use crate::cancel::Cancellation;

/// Training settings. They are recorded with the adapter.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct TrainConfig {
    /// Number of passes over the pairs.
    pub epochs: usize,
    /// Pairs per optimizer step. The last batch of an epoch may be smaller; it is not dropped.
    pub batch: usize,
    /// The learning rate, constant over the run.
    pub learning_rate: f64,
    /// Decoupled weight decay, applied to every parameter.
    pub weight_decay: f64,
    /// Gradient clipping: the maximum global norm.
    pub clip_norm: f64,
    /// Width of φ's hidden layer.
    pub hidden: usize,
    /// Columns of a chart's latent, the paper's geo_dim.
    pub latent: usize,
    /// Number of charts, the paper's K.
    pub charts: usize,
    /// How the charts are mixed. The charts of an ensemble are trained separately, each for 1/K of
    /// the epochs.
    pub mixing: Mixing,
    /// Training loss.
    pub loss: Loss,
    /// Whether features are z-scored by the statistics of the training frames. After training, the
    /// scaling is folded into the first layer.
    #[cfg_attr(feature = "serde", serde(alias = "standardise"))]
    pub standardize: bool,
    /// Standard deviation of the Gaussian noise added to the features at every step. The unit is
    /// that of the features after z-scoring, if `standardize` is set.
    pub noise: f64,
    /// Decay of the exponential moving average of the weights, which is the result of the training;
    /// at 0, the last weights are.
    pub average: f64,
    /// Whether targets are scaled with μ = 0 and σ = root mean square. Zero motion then leaves the
    /// latent unchanged in every reading.
    pub through_zero: bool,
    /// Seed of the initial weights, the order of the pairs and the noise.
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
            standardize: false,
            noise: 0.0,
            average: 0.0,
            through_zero: false,
            seed: 0,
        }
    }
}

/// Loss and gradient norm of one optimizer step, before the update of the weights.
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
    optimizer: AdamW<T>,
    steps: u64,
}

impl<'a, T: Real, N: Objective<T>> Trainer<'a, T, N> {
    /// Starts a training run from `weights`.
    pub fn new(data: &'a N::Data, weights: N, config: TrainConfig) -> Self {
        let optimizer = AdamW::new(&weights);
        Self {
            data,
            config,
            weights,
            optimizer,
            steps: 0,
        }
    }

    /// The current weights.
    pub fn weights(&self) -> &N {
        &self.weights
    }

    /// The loss on a batch of samples at the current weights, and its gradient before clipping.
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

    /// Takes one optimizer step on the samples with the indices `batch`.
    pub fn step(&mut self, batch: &[usize]) -> StepReport {
        let (loss, gradient) = self.gradient(batch);
        self.steps += 1;
        let gradient_norm = self
            .optimizer
            .step(&mut self.weights, &gradient, &self.config);

        StepReport {
            loss,
            gradient_norm,
        }
    }
}

/// The state of a training run at the end of an epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochProgress {
    /// Completed epochs, including this one.
    pub done: usize,
    /// Number of epochs in the whole run.
    pub epochs: usize,
    /// Mean of the batch losses of the epoch.
    pub loss: f64,
}

/// Trains from `start`. Returns the averaged weights if `config.average` is above 0, else the last
/// weights.
///
/// # Errors
/// [`Error::Diverged`] when the loss is not finite, [`Error::Cancelled`] once `cancel` is set.
pub fn fit<T: Real, N: Objective<T>>(
    data: &N::Data,
    start: N,
    config: &TrainConfig,
    random: &mut Seeded,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<N, Error> {
    let mut average = (config.average > 0.0).then(|| start.clone());
    let mut trainer = Trainer::new(data, start, config.clone());
    for epoch in 1..=config.epochs {
        let order = random.permutation(N::count(data));
        let mut losses = Vec::new();
        for batch in order.chunks(config.batch.max(1)) {
            cancel.check()?;
            losses.push(trainer.step(batch).loss);

            if let Some(average) = &mut average {
                // A shorter averaging window in the first steps; otherwise the initial weights
                // would dominate the average of a short run.
                let steps = trainer.steps as f64;
                let decay = config.average.min((1.0 + steps) / (10.0 + steps));
                move_towards(average, &trainer.weights, 1.0 - decay);
            }
        }

        let loss = crate::statistics::mean(&losses);
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

/// Moves `average` toward `weights` by the fraction `share` of their difference.
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

/// Trains an adapter's network from random initial weights.
///
/// # Errors
/// [`Error::Diverged`] when the loss is not finite, [`Error::Charts`] when the number of charts is
/// 0 or above [`super::MAX_CHARTS`], [`Error::GatedStandardized`] for z-scored features with a
/// gate.
///
/// Source: SeeSE3, Sec. A.2; mixtures Sec. A.11.
pub fn train(
    samples: &Samples<f32>,
    config: &TrainConfig,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Mixture<f32>, Error> {
    if config.charts == 0 || config.charts > super::MAX_CHARTS {
        return Err(Error::Charts {
            count: config.charts,
        });
    }

    if config.charts > 1 && config.mixing == Mixing::Gate && config.standardize {
        return Err(Error::GatedStandardized);
    }

    // A single chart, or charts with a gate, are one network; the charts of an ensemble are trained
    // separately.
    if config.charts == 1 || config.mixing == Mixing::Gate {
        return train_together(samples, config, cancel, progress);
    }

    // The epochs are divided among the charts, so that an ensemble takes about as many steps as a
    // single adapter.
    let epochs = config.epochs.div_ceil(config.charts);
    let mut charts = Vec::with_capacity(config.charts);
    for member in 0..config.charts {
        // Experiments use consecutive seeds; the wide spacing of the members' seeds avoids
        // collisions between runs.
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
        let trained = train_together(samples, &alone, cancel, &mut |epoch| {
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

/// Continues the training of a single-chart network; `samples` must be scaled with the μ and σ that
/// the network was trained with. Widths and charts of `config` are ignored; the seed sets the
/// sample order and the noise.
///
/// # Errors
/// [`Error::Diverged`] when the loss is not finite, [`Error::Charts`] when the network has more
/// than one chart.
pub fn train_further(
    samples: &Samples<f32>,
    start: &Mixture<f32>,
    config: &TrainConfig,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Mixture<f32>, Error> {
    if start.chart_count() != 1 {
        return Err(Error::Charts {
            count: start.chart_count(),
        });
    }

    let mut random = Seeded::new(config.seed);
    if !config.standardize {
        return fit(
            samples,
            start.clone(),
            config,
            &mut random,
            cancel,
            progress,
        );
    }

    // The network takes raw features: it is converted for z-scored features, trained, and converted
    // back.
    let (standardized, [mean, deviation]) = samples.standardized();
    let mut unfolded = start.clone();
    unfolded.unfold_standardization(&mean, &deviation);

    let mut network = fit(
        &standardized,
        unfolded,
        config,
        &mut random,
        cancel,
        progress,
    )?;
    network.fold_standardization(&mean, &deviation);
    Ok(network)
}

/// Distance between the seeds of two successive members of an ensemble.
const MEMBER_SEED_STEP: u32 = 0x0100_0193;

fn train_together(
    samples: &Samples<f32>,
    config: &TrainConfig,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Mixture<f32>, Error> {
    let widths = Widths {
        feature: samples.feature_dim(),
        hidden: config.hidden,
        latent: config.latent,
    };

    let mut random = Seeded::new(config.seed);
    let start = Mixture::random(widths, config.charts, &mut random);
    if !config.standardize {
        return fit(samples, start, config, &mut random, cancel, progress);
    }

    // Train on z-scored features, then fold the scaling into the first layer, so that the network
    // takes raw features.
    let (standardized, [mean, deviation]) = samples.standardized();
    let mut network = fit(&standardized, start, config, &mut random, cancel, progress)?;
    network.fold_standardization(&mean, &deviation);

    Ok(network)
}

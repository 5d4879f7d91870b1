//! Training of any network, with the order of the samples drawn from a seed.
//!
//! A frame occurs in many pairs, so φ runs once for each distinct frame of a batch, and the
//! gradient of a frame's latent is the sum over its pairs. On one machine the same seed gives the
//! same bits. A seed gives the initial weights and the orders that PyTorch draws from it by
//! `torch.manual_seed`, the construction of the module, and one `torch.randperm` for each epoch.

use super::network::AdamW;
use super::phi::Widths;
use super::seeded::Seeded;
use super::{At, Error, LATENT_DIM, Loss, Mixing, Mixture, Objective, Real, Samples};

/// Settings that change the trained weights. They are recorded with the adapter.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainConfig {
    /// Passes over the pairs.
    pub epochs: usize,
    /// Pairs in one step. The last batch of an epoch may be shorter; it is not dropped.
    pub batch: usize,
    /// The learning rate, constant over the run.
    pub learning_rate: f64,
    /// Decoupled weight decay, applied to every parameter.
    pub weight_decay: f64,
    /// The largest global norm of a gradient; a longer gradient is scaled down to it.
    pub clip_norm: f64,
    /// Width of φ's hidden layer.
    pub hidden: usize,
    /// Columns of a chart's latent, the paper's geo_dim.
    pub latent: usize,
    /// Number of charts, the paper's K.
    pub charts: usize,
    /// How the charts are mixed. Charts that are mixed evenly are trained separately, each for its
    /// share of the epochs.
    pub mixing: Mixing,
    /// The loss that is minimised.
    pub loss: Loss,
    /// Whether features are z-scored by the training frames' statistics. After training, the
    /// scaling is folded into the weights of the first layer.
    pub standardise: bool,
    /// Standard deviation of the Gaussian noise that is added to every feature at every step, in
    /// the units of the features in training: z-scored ones if `standardise` is set.
    pub noise: f64,
    /// Decay of a running average of the weights, which is returned instead of the last weights. At
    /// 0 there is no averaging.
    pub average: f64,
    /// Whether targets are scaled with μ = 0 and σ the root mean square, so that zero motion leaves
    /// the latent unchanged in every reading.
    pub through_zero: bool,
    /// Seed of the initial weights, of the order of the pairs and of the noise.
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

/// Loss and gradient of one optimiser step, both before the weights changed.
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
    /// Starts a training run from `weights`.
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

    /// Takes one optimiser step on the samples whose indices are in `batch`.
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

/// The state of a training run at the end of an epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochProgress {
    /// Epochs done, including this one.
    pub done: usize,
    /// Number of epochs in the whole run.
    pub epochs: usize,
    /// Mean loss of the epoch.
    pub loss: f64,
}

/// Trains from `start`. Returns the running average of the weights if the settings ask for one,
/// else the last weights.
///
/// # Errors
/// [`Error::Diverged`] when the loss stops being finite.
pub fn fit<T: Real, N: Objective<T>>(
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
                // The averaging window is shorter in the first steps; otherwise the random initial
                // weights would still dominate the average at the end of a short run.
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

/// Moves every number of `average` by the fraction `share` of the way to its counterpart in
/// `weights`.
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

/// Trains an adapter's network from weights drawn from the seed.
///
/// # Errors
/// [`Error::Diverged`] when the loss stops being finite, [`Error::Charts`] when the number of
/// charts is 0 or above [`super::MAX_CHARTS`], [`Error::GatedStandardised`] when features are to be
/// standardised for charts under a gate.
///
/// Source: SeeSE3, Sec. A.2; mixtures Sec. A.11.
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

    // A single chart, or charts with their gate, are one network. Only an ensemble is trained in
    // parts.
    if config.charts == 1 || config.mixing == Mixing::Gate {
        return train_together(samples, config, progress);
    }

    // The members of an ensemble share the epochs, so that it takes about as many steps as a
    // single adapter.
    let epochs = config.epochs.div_ceil(config.charts);
    let mut charts = Vec::with_capacity(config.charts);
    for member in 0..config.charts {
        // Runs with several seeds count them up by one; the wide spacing of the members' seeds
        // keeps one run's members from repeating another's.
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

/// Goes on training a network of one chart, on samples whose targets have the network's own scale.
/// The settings' widths, charts and seed of weights play no role.
///
/// # Errors
/// [`Error::Diverged`] when the loss stops being finite, [`Error::Charts`] when the network has
/// more than one chart.
pub fn train_further(
    samples: &Samples<f32>,
    start: &Mixture<f32>,
    config: &TrainConfig,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Mixture<f32>, Error> {
    if start.chart_count() != 1 {
        return Err(Error::Charts {
            count: start.chart_count(),
        });
    }

    let mut random = Seeded::new(config.seed);
    if !config.standardise {
        return fit(samples, start.clone(), config, &mut random, progress);
    }

    // The network takes features as the encoder gives them: it is turned into one of z-scored
    // features, trained, and turned back.
    let (standardised, [mean, deviation]) = samples.standardised();
    let mut unfolded = start.clone();
    unfolded.unfold_standardisation(&mean, &deviation);

    let mut network = fit(&standardised, unfolded, config, &mut random, progress)?;
    network.fold_standardisation(&mean, &deviation);
    Ok(network)
}

/// Distance between the seeds of two successive members of an ensemble.
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

    // Fit on z-scored features, and then fold the scaling into the first layer, so that the
    // trained network takes features as the encoder gives them.
    let (standardised, [mean, deviation]) = samples.standardised();
    let mut network = fit(&standardised, start, config, &mut random, progress)?;
    network.fold_standardisation(&mean, &deviation);

    Ok(network)
}

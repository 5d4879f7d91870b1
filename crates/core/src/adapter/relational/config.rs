//! Settings of a relational reader, and its training.

use super::super::seeded::Seeded;
use super::super::train::fit;
use super::super::{EpochProgress, Error, TrainConfig};
use super::RelationalNetwork;
use super::network::RelationalSamples;
use crate::cancel::Cancellation;

/// Distance between the seeds of two members.
const MEMBER_SEED_STEP: u64 = 0x0100_0193;

/// Settings of a relational reader. They are recorded with the adapter.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RelationalConfig {
    /// Number of networks, whose densities are averaged.
    pub members: usize,
    /// Epochs of [`super::PAIRS_PER_EPOCH`] pairs, for each member.
    pub epochs: usize,
    /// Pairs per optimizer step.
    pub batch: usize,
    /// The learning rate, constant over the run.
    pub learning_rate: f64,
    /// Decoupled weight decay, applied to every parameter.
    pub weight_decay: f64,
    /// Width of both hidden layers.
    pub hidden: usize,
    /// Standard deviation of the Gaussian noise added to the similarities at every step.
    pub noise: f64,
    /// Decay of the exponential moving average of the weights, which is the result.
    pub average: f64,
    /// The largest number of frames between the two frames of a near pair.
    pub longest_stride: usize,
    /// Share of the pairs that are any two frames of a room.
    pub far_share: f64,
    /// Seed of the initial weights, the pairs and the noise.
    pub seed: u64,
}

impl Default for RelationalConfig {
    fn default() -> Self {
        Self {
            members: 1,
            epochs: 24,
            batch: 256,
            learning_rate: 1e-3,
            weight_decay: 1e-2,
            hidden: 256,
            noise: 0.05,
            average: 0.99,
            longest_stride: 40,
            far_share: 0.4,
            seed: 0,
        }
    }
}

/// Trains the members of a reader, one after the other.
///
/// # Errors
/// [`Error::Diverged`] when the loss is not finite, [`Error::Cancelled`] once `cancel` is set.
pub fn train_relational(
    samples: &RelationalSamples,
    config: &RelationalConfig,
    cancel: &Cancellation,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<Vec<RelationalNetwork<f32>>, Error> {
    let mut members = Vec::with_capacity(config.members);
    for member in 0..config.members {
        let seed = config
            .seed
            .wrapping_add((member as u64).wrapping_mul(MEMBER_SEED_STEP));
        let optimizer = TrainConfig {
            epochs: config.epochs,
            batch: config.batch,
            learning_rate: config.learning_rate,
            weight_decay: config.weight_decay,
            noise: config.noise,
            average: config.average,
            seed,
            ..TrainConfig::default()
        };

        let start = RelationalNetwork::initial(samples.input_count(), config.hidden, seed);
        let done = member * config.epochs;
        members.push(fit(
            samples,
            start,
            &optimizer,
            &mut Seeded::new(seed),
            cancel,
            &mut |epoch| {
                progress(EpochProgress {
                    done: done + epoch.done,
                    epochs: config.members * config.epochs,
                    ..epoch
                });
            },
        )?);
    }

    Ok(members)
}

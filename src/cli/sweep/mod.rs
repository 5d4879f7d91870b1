//! `seese3 sweep`: many at once, over layers or over adapters.

mod adapters;
mod formulations;
mod journal;
mod layers;
pub mod one;

use clap::{Args, Subcommand};

#[derive(Debug, Args)]
pub struct Sweep {
    #[command(subcommand)]
    over: Over,
}

#[derive(Debug, Subcommand)]
enum Over {
    /// M1 to M4 over the layers of a features set, the best by each
    Layers(layers::Layers),
    /// Adapters over latent sizes, charts, learning rates, losses and seeds: resumable, in shards,
    /// a row a run
    Adapters(adapters::Adapters),
    /// The adapter beside the paper's alternatives A to D
    Formulations(formulations::Formulations),
}

impl Sweep {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.over {
            Over::Layers(layers) => layers.run().await,
            Over::Adapters(adapters) => adapters.run().await,
            Over::Formulations(formulations) => formulations.run().await,
        }
    }
}

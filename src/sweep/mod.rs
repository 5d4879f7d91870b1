//! `seese3 sweep`: many training runs at once, over layers, adapters or formulations.

mod adapters;
mod formulations;
mod journal;
mod layers;

use clap::{Args, Subcommand};

#[derive(Debug, Args)]
pub struct Sweep {
    #[command(subcommand)]
    over: SweepKind,
}

#[derive(Debug, Subcommand)]
enum SweepKind {
    /// M1 to M4 of every layer of an encoder's features, with the best layer by each metric
    Layers(layers::Layers),
    /// Adapters over a grid of latent sizes, charts, learning rates, losses and seeds; resumable
    /// and shardable, one row per run
    Adapters(adapters::Adapters),
    /// Compare the adapter with the paper's alternatives A to D
    Formulations(formulations::Formulations),
}

impl Sweep {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.over {
            SweepKind::Layers(layers) => layers.run().await,
            SweepKind::Adapters(adapters) => adapters.run().await,
            SweepKind::Formulations(formulations) => formulations.run().await,
        }
    }
}

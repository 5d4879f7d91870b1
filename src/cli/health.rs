//! `seese3 health`: whether a server is ready to answer.

use anyhow::bail;
use clap::Args;

use super::ask::Server;
use super::say;

#[derive(Debug, Args)]
pub struct Health {
    #[command(flatten)]
    server: Server,
    /// What to check: a gRPC service's full name, or rooms/NAME; the whole server if empty
    #[arg(long, default_value = "")]
    name: String,
}

impl Health {
    pub async fn run(self) -> anyhow::Result<()> {
        if !self.server.connect().await?.serves(&self.name).await? {
            bail!("the server is not serving: it is still loading, or shutting down");
        }

        say("serving");
        Ok(())
    }
}

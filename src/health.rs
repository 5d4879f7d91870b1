//! `seese3 health`: whether a server is ready to answer.

use anyhow::bail;
use clap::Args;
use serde_json::json;

use super::ask::Server;
use super::output::{JsonOutput, say};

#[derive(Debug, Args)]
pub struct Health {
    #[command(flatten)]
    server: Server,
    /// What to check: a gRPC service's full name, or rooms/NAME; the whole server if omitted
    #[arg(default_value = "", hide_default_value = true)]
    name: String,
    #[command(flatten)]
    json: JsonOutput,
}

impl Health {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let is_serving = self.server.connect().await?.serves(&self.name).await?;
        self.json.write(&json!({ "serving": is_serving }))?;
        if !is_serving {
            bail!("the server is not serving: it is still loading, or shutting down");
        }

        say("serving");
        Ok(())
    }
}

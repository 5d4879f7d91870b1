//! The options `--store` and `--json`, of commands that work on a store.

use clap::Args;

use super::output::JsonOutput;
use seese3_store::Store;

/// The store of a command without `--store` and without `SEESE3_STORE`.
pub const DEFAULT_STORE: &str = "store";

#[derive(Debug, Args)]
pub struct StoreAndJson {
    /// The store: a folder, or a URL of a bucket (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = DEFAULT_STORE)]
    pub store: String,
    #[command(flatten)]
    pub json: JsonOutput,
}

impl StoreAndJson {
    /// Opens the store, after checking that the JSON file can be written.
    pub fn open(&self) -> anyhow::Result<Store> {
        self.json.begin()?;
        Ok(Store::open(&self.store)?)
    }

    /// Opens the store of a command that publishes in it. A store that cannot be written is refused
    /// here, and not after minutes of computing.
    pub async fn open_to_publish(&self) -> anyhow::Result<Store> {
        let store = self.open()?;
        store.check_writable().await?;
        Ok(store)
    }
}

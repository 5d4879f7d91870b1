//! `seese3 import adapter`: publishes an adapter that another program trained.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use serde_json::json;

use crate::output::{JsonOutput, say, say_published};
use crate::store_option::DEFAULT_STORE;
use seese3_store::{ForeignAdapter, Store, read_foreign_adapter};

/// Maximum size of the weights, bytes.
const WEIGHTS_BYTES: u64 = 1 << 30;

#[derive(Debug, Args)]
pub struct ImportAdapter {
    /// A folder with adapter.json and weights.safetensors, see docs/store.md
    path: PathBuf,
    /// Name of the adapter in the store
    #[arg(long)]
    name: String,
    /// The store: a folder, created if it does not exist, or a URL of a bucket (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = DEFAULT_STORE)]
    store: String,
    #[command(flatten)]
    json: JsonOutput,
}

impl ImportAdapter {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let read = |name: &str, most: u64| {
            let file = self.path.join(name);
            let bytes = seese3_files::read(&file, most);
            bytes.with_context(|| format!("{} cannot be read", file.display()))
        };
        let description = read("adapter.json", seese3_files::SMALL_FILE_BYTES)?;
        let weights = read("weights.safetensors", WEIGHTS_BYTES)?;
        let ForeignAdapter {
            adapter,
            record,
            features,
        } = read_foreign_adapter(&description, &weights)
            .with_context(|| self.path.display().to_string())?;

        let store = Store::create(&self.store)?;
        let published = store.publish_adapter(&self.name, &adapter, &record, features.view());
        let published = published.await?;
        say(format_args!(
            "features '{}' of {} columns, latents of {}; without scores and an error model, it navigates and does not \
             track",
            adapter.source().name,
            adapter.source().dim,
            adapter.latent_dim()
        ));
        say_published(&store, &format!("adapter '{}'", self.name), &published);
        self.json.write(&json!({
            "adapter": self.name,
            "revision": published.revision,
            "created": published.is_new,
        }))
    }
}

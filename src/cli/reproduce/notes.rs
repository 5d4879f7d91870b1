//! What the sections hand on: claims, and the adapters that their numbers are of.

use ndarray::Array2;
use serde_json::{Value, json};

use super::Loaded;
use super::claims::Claim;
use crate::adapter::{Adapter, TrainingRecord};
use crate::store::Store;

/// What was found on the way.
#[derive(Default)]
pub struct Notes {
    /// In the order of the sections.
    pub claims: Vec<Claim>,
    /// To be published.
    pub adapters: Vec<Learned>,
}

/// An adapter that a row of a table is of.
pub struct Learned {
    /// The name that it is published under.
    pub name: String,
    pub adapter: Adapter,
    pub record: TrainingRecord,
    /// Rows that become its golden inputs.
    golden: Array2<f32>,
}

/// Rows of a room that are kept for an adapter's golden inputs.
const GOLDEN: usize = 64;

impl Learned {
    /// An adapter of `what`, learned from rooms of which `room` is one.
    pub fn new(what: &str, room: &Loaded, adapter: Adapter, record: TrainingRecord) -> Self {
        let features = &room.1;
        let rows = features.rows();
        let golden = rows
            .slice(ndarray::s![..rows.nrows().min(GOLDEN), ..])
            .to_owned();

        Self {
            name: published_name(what, &features.source().name),
            adapter,
            record,
            golden,
        }
    }
}

/// The name of the adapter of `what`.
pub fn published_name(what: &str, features: &str) -> String {
    format!("reproduced.{what}.{features}")
}

impl Notes {
    /// The adapter of `what`, if it was learned.
    pub fn adapter(&self, what: &str, features: &str) -> Option<&Adapter> {
        let name = published_name(what, features);
        self.adapters
            .iter()
            .find(|learned| learned.name == name)
            .map(|learned| &learned.adapter)
    }

    /// Publishes the adapters: name, revision and protocol of each.
    pub async fn publish(&self, store: &Store) -> anyhow::Result<Value> {
        let mut published = Vec::with_capacity(self.adapters.len());
        for Learned {
            name,
            adapter,
            record,
            golden,
        } in &self.adapters
        {
            let revision = store
                .publish_adapter(name, adapter, record, golden.view())
                .await?
                .revision;

            published.push(json!({
                "name": name,
                "revision": revision,
                "preset": record.preset,
                "seed": record.config.seed,
                "epochs": record.config.epochs,
                "charts": record.config.charts,
                "split": record.split.name(),
                "stride": record.stride,
                "pairs": record.pair_count,
                "rooms": record.rooms.len(),
                "calibration_rooms": record.calibrated_on.len(),
            }));
        }

        Ok(Value::Array(published))
    }
}

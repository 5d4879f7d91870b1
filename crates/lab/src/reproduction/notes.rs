//! What the sections pass on to the end of the run: claims, and the adapters behind their numbers.

use ndarray::Array2;

use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::training::RoomData;

use super::Claim;

/// How many feature rows of a room, from the first on, are kept for an adapter's golden inputs.
const GOLDEN_ROWS: usize = 64;

/// Claims and adapters collected while the sections run.
#[derive(Default)]
pub struct Notes {
    /// In the order of the sections.
    pub claims: Vec<Claim>,
    /// Adapters to publish after the last section.
    pub adapters: Vec<ReproducedAdapter>,
}

/// A trained adapter that a row of a table reports on.
pub struct ReproducedAdapter {
    /// The name under which it is to be published.
    pub name: String,
    /// The adapter.
    pub adapter: Adapter,
    /// How it was trained.
    pub record: TrainingRecord,
    /// Feature rows to take its golden inputs from, shape (n, d).
    pub golden_features: Array2<f32>,
}

impl ReproducedAdapter {
    /// Names an adapter after `what`, the room or the plan that it was trained for. `data` has
    /// features of the adapter's source and gives the golden inputs.
    pub fn new(what: &str, data: &RoomData<'_>, adapter: Adapter, record: TrainingRecord) -> Self {
        let rows = data.features.rows();
        let golden_features = rows
            .slice(ndarray::s![..rows.nrows().min(GOLDEN_ROWS), ..])
            .to_owned();

        Self {
            name: published_name(what, &data.features.source().name),
            adapter,
            record,
            golden_features,
        }
    }
}

/// The name under which the adapter of `what`, a room or a plan, is published.
pub fn published_name(what: &str, features: &str) -> String {
    format!("reproduced.{what}.{features}")
}

impl Notes {
    /// The adapter of `what` with these features, if this run has trained it.
    pub fn adapter(&self, what: &str, features: &str) -> Option<&Adapter> {
        let name = published_name(what, features);
        self.adapters
            .iter()
            .find(|reproduced| reproduced.name == name)
            .map(|reproduced| &reproduced.adapter)
    }
}

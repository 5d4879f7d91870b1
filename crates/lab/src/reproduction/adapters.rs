//! Adapters that the sections collect for the end of the run.

use ndarray::Array2;

use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::training::RoomData;

/// Number of leading feature rows of a room kept for an adapter's golden inputs.
const GOLDEN_ROWS: usize = 64;

/// Adapters to publish after the last section.
#[derive(Default)]
pub struct Adapters(pub Vec<ReproducedAdapter>);

/// A trained adapter of a table row.
pub struct ReproducedAdapter {
    /// The name for publishing.
    pub name: String,
    /// The adapter.
    pub adapter: Adapter,
    /// Its training record.
    pub record: TrainingRecord,
    /// Feature rows for its golden inputs, shape (n, d).
    pub golden_features: Array2<f32>,
}

impl ReproducedAdapter {
    /// Names an adapter after `what`, its room or its plan. `data` provides the golden inputs; its
    /// features must have the adapter's source.
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

/// The published name of the adapter of `what`, a room or a plan.
pub fn published_name(what: &str, features: &str) -> String {
    format!("reproduced.{what}.{features}")
}

impl Adapters {
    /// The adapter of `what` with these features, if this run trained it.
    pub fn reproduced(&self, what: &str, features: &str) -> Option<&ReproducedAdapter> {
        let name = published_name(what, features);
        self.0.iter().find(|reproduced| reproduced.name == name)
    }
}

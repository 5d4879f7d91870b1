//! Adapters that another program trained, for instance PyTorch.

use std::collections::BTreeMap;

use ndarray::Array2;
use serde::Deserialize;

use super::Error;
use super::adapter_files::vector6;
use super::tensors::{TensorReader, read_weights};
use seese3_core::Cause;
use seese3_core::adapter::{
    Adapter, Mixing, Mixture, PairPlan, TargetScale, TrainConfig, TrainingRecord,
};
use seese3_core::features::FeatureSource;
use seese3_core::motion_scores::MotionScores;
use seese3_core::room::{RoomId, is_plain_name};
use seese3_core::splits::Split;

/// The value of `format` in the description.
const FORMAT: &str = "seese3 adapter 1";

/// The content of `adapter.json`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    /// Always [`FORMAT`].
    format: String,
    /// The source of the training features.
    feature_source: FeatureSource,
    /// The rooms of the training set with their revisions. Evaluations tell by them what leaks.
    rooms: BTreeMap<RoomId, u64>,
    /// Frames from source to target.
    stride: u32,
    epochs: usize,
    #[serde(default)]
    seed: u64,
    #[serde(default = "whole")]
    split: Split,
    #[serde(default = "elsewhere")]
    preset: String,
}

fn whole() -> Split {
    Split::Whole
}

fn elsewhere() -> String {
    "elsewhere".to_owned()
}

/// An adapter that another program trained. It has no scores and no error model: it navigates, and
/// does not track.
#[derive(Debug)]
pub struct ForeignAdapter {
    /// The adapter, of one chart.
    pub adapter: Adapter,
    /// What is known of its training.
    pub record: TrainingRecord,
    /// Some features that it was trained on, (n, d).
    pub features: Array2<f32>,
}

/// Reads an adapter from `adapter.json` and `weights.safetensors`. The tensors are those of a
/// PyTorch `state_dict`: `phi.0.weight` (h, d), `phi.0.bias`, `phi.1.weight`, `phi.1.bias` (h,) of
/// the LayerNorm, `phi.3.weight` (k, h), `phi.3.bias` and `W.weight` (6, k), f32; besides them the
/// mean `target.mean` and the population standard deviation `target.deviation` (6,) of the training
/// motions, f64, meters and radians, and some training features `features` (n, d), f32.
///
/// # Errors
/// [`Error::Damaged`], which names the file, if one of them is not valid or the two do not belong
/// together.
pub fn read_foreign_adapter(description: &[u8], weights: &[u8]) -> Result<ForeignAdapter, Error> {
    const DESCRIPTION: &str = "adapter.json";
    const WEIGHTS: &str = "weights.safetensors";
    let damaged = |file: &str, problem: Cause| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let described: Description =
        serde_json::from_slice(description).map_err(|error| damaged(DESCRIPTION, error.into()))?;
    if described.format != FORMAT {
        let problem = format!(
            "is of format '{}'; this program reads '{FORMAT}'",
            described.format
        );
        return Err(damaged(DESCRIPTION, problem.into()));
    }
    if described.stride == 0 {
        return Err(damaged(DESCRIPTION, "has a stride of 0".into()));
    }

    let tensors = TensorReader::new(WEIGHTS, weights)?;
    let network = Mixture::from_tensors(1, Mixing::Gate, |name| read_weights(&tensors, name));
    let network = network.map_err(|error| error.within(WEIGHTS))?;
    let scale = TargetScale {
        mean: vector6(&tensors, "target.mean", WEIGHTS)?,
        deviation: vector6(&tensors, "target.deviation", WEIGHTS)?,
    };
    let features = tensors.f32("features")?;
    if features.is_empty() {
        let problem = "'features' has no rows: give some training features, at least one row";
        return Err(damaged(WEIGHTS, problem.into()));
    }
    let name = &described.feature_source.name;
    if !is_plain_name(name) {
        let problem = format!("'feature_source.name': '{name}' is no name of a feature set");
        return Err(damaged(DESCRIPTION, problem.into()));
    }
    let config = TrainConfig {
        epochs: described.epochs,
        seed: described.seed,
        hidden: tensors.f32("phi.0.weight")?.nrows(),
        latent: network.coordinate_count(),
        ..TrainConfig::default()
    };
    let adapter = Adapter::new(described.feature_source, network, scale)
        .map_err(|error| damaged(WEIGHTS, error.into()))?;

    let unknown = MotionScores::of(&[], &[]);
    Ok(ForeignAdapter {
        adapter,
        record: TrainingRecord {
            preset: described.preset,
            split: described.split,
            stride: described.stride,
            pairs: PairPlan::Stride(described.stride),
            rooms: described.rooms.into_iter().collect(),
            calibrated_on: Vec::new(),
            config,
            pair_count: 0,
            test: unknown,
            room_tests: Vec::new(),
            train: unknown,
            train_mean_r2: f64::NAN,
            relational: None,
        },
        features,
    })
}

//! Scores M1 to M4 of one feature set in one room: one row of the table over an encoder's layers.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::motion_scores::MotionScores;
use seese3_core::splits::Split;
use seese3_core::statistics::{deviation, mean};
use seese3_core::training::{RoomData, TrainingPlan};

use super::Error;
use super::folds::FoldedMotions;
use crate::formulations::read_by_adapter;
use crate::probes::{MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe};

/// Settings of a row, besides its room and features.
#[derive(Debug, Clone)]
pub struct LayerProtocol {
    /// How M1 compares neighbors.
    pub mutual_knn: MutualKnn,
    /// Frames before and after each frame that M2 excludes as neighbors.
    pub gap: usize,
    /// Stride of M3 and M4, and training settings of M4. Its split and seed are overridden.
    pub plan: TrainingPlan,
    /// Train/test splits of M3 and M4: one split, or the folds of a recording.
    pub splits: Vec<Split>,
    /// Number of M4 adapters per split, with seeds from 0.
    pub seeds: u64,
}

/// M1 to M4 of one feature set in one room. R² values are over the test pairs of all splits
/// together.
#[derive(Debug, Clone, Serialize)]
pub struct LayerScores {
    /// The features' name.
    pub features: String,
    /// The encoder of the features.
    pub encoder: String,
    /// The room.
    pub room: String,
    /// Width of a feature.
    #[serde(rename = "columns")]
    pub dim: usize,
    /// Mutual k-NN.
    pub m1: MutualKnnShare,
    /// The intrinsic dimension.
    pub m2: LayerDimension,
    /// Ridge regression.
    pub m3: RidgeScore,
    /// The adapter.
    pub m4: AdapterScores,
    /// R² of the constant baseline, which always predicts the mean training motion.
    pub constant_r2: f64,
}

/// M1 of a layer.
#[derive(Debug, Clone, Serialize)]
pub struct MutualKnnShare {
    /// Mutual k-NN score, 0 to 1.
    pub value: f64,
}

/// M2 of a layer.
#[derive(Debug, Clone, Serialize)]
pub struct LayerDimension {
    /// Intrinsic dimension by TwoNN.
    pub twonn: f64,
    /// Intrinsic dimension by maximum likelihood.
    pub mle: f64,
    /// Number of rows left out as copies of an earlier row.
    pub dropped_rows: usize,
}

/// M3 of a layer.
#[derive(Debug, Clone, Serialize)]
pub struct RidgeScore {
    /// R² of ridge regression.
    pub r2: f64,
}

/// M4 of a layer.
#[derive(Debug, Clone, Serialize)]
pub struct AdapterScores {
    /// Mean over seeds of the R².
    pub r2: f64,
    /// Mean over seeds of the R² of translation.
    pub translation: f64,
    /// Mean over seeds of the R² of rotation.
    pub rotation: f64,
    /// Sample standard deviation over seeds of the R².
    pub deviation: f64,
    /// The R² of each seed.
    pub runs: Vec<f64>,
}

/// Scores one feature set in one room.
///
/// # Errors
/// [`Error::Probe`] or [`Error::Training`] when the room is too short for a probe.
pub fn score_layer(data: &RoomData<'_>, protocol: &LayerProtocol) -> Result<LayerScores, Error> {
    let room = data.room;
    let rows = data.features.rows();
    let plan = &protocol.plan;

    let m1 = mutual_knn(rows, room.poses(), &protocol.mutual_knn)?;
    let m2 = intrinsic_dimension(rows, protocol.gap)?;

    let splits = &protocol.splits;
    let ridge = FoldedMotions::of(splits, |split| {
        Ok(vec![ridge_probe(rows, room, split, plan.stride)?])
    })?;

    let adapter = |seed: u64| -> Result<MotionScores, Error> {
        let run = FoldedMotions::of(splits, |split| {
            let plan = TrainingPlan {
                split,
                ..plan.with_seed(seed)
            };
            Ok(read_by_adapter(&[*data], &plan, &mut |_| ())?.0)
        })?;
        Ok(run.scores())
    };
    let adapters: Vec<MotionScores> = (0..protocol.seeds)
        .into_par_iter()
        .map(adapter)
        .collect::<Result<_, Error>>()?;
    let m4_runs: Vec<f64> = adapters.iter().map(|scores| scores.overall).collect();
    let m4 = MotionScores::mean(&adapters);

    let source = data.features.source();
    Ok(LayerScores {
        features: source.name.clone(),
        encoder: source.encoder.clone(),
        room: room.id().to_string(),
        dim: source.dim,
        m1: MutualKnnShare { value: m1 },
        m2: LayerDimension {
            twonn: m2.two_nn.linear,
            mle: m2.mle_biased.harmonic,
            dropped_rows: m2.dropped,
        },
        m3: RidgeScore {
            r2: ridge.scores().overall,
        },
        m4: AdapterScores {
            r2: mean(&m4_runs),
            translation: m4.translation,
            rotation: m4.rotation,
            deviation: deviation(&m4_runs),
            runs: m4_runs,
        },
        constant_r2: ridge.constant_r2(),
    })
}

//! One run of a sweep over adapters.

use std::time::Instant;

use sha2::{Digest, Sha256};

use super::super::rooms::lesson;
use crate::adapter::PairPlan;
use crate::features::Features;
use crate::report::SweepRow;
use crate::store::StoredRoom;
use crate::training::{Recipe, learn};

/// Does a run; one that fails says why in its row.
pub fn done(room: &(StoredRoom, Features), recipe: &Recipe, mut row: SweepRow) -> SweepRow {
    let begun = Instant::now();

    match learn(&[lesson(room)], recipe, &mut |_| ()) {
        Ok((_, record)) => row.score(&record.test, &record.train),
        Err(error) => row.failure = error.to_string(),
    }

    row.seconds = begun.elapsed().as_secs_f64();
    row
}

/// What poses and features are, whatever they are called: another store may call others by the same
/// names.
pub fn content((stored, features): &(StoredRoom, Features)) -> String {
    let mut digest = Sha256::new();
    features
        .rows()
        .iter()
        .for_each(|x| digest.update(x.to_le_bytes()));

    let poses = stored
        .room
        .poses()
        .iter()
        .map(crate::geometry::Pose::to_homogeneous);
    poses.for_each(|pose| pose.iter().for_each(|x| digest.update(x.to_le_bytes())));

    digest
        .finalize()
        .iter()
        .take(16)
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

/// What decides a run; its scores are still empty.
pub fn row(
    (stored, features): &(StoredRoom, Features),
    content: &str,
    recipe: &Recipe,
) -> SweepRow {
    let config = &recipe.config;
    let row = SweepRow {
        key: String::new(),
        room: stored.room.id().to_string(),
        room_revision: stored.revision,
        format: stored.room.provenance().format.clone(),
        frames: stored.room.frame_count(),
        features: features.source().name.clone(),
        preset: recipe.preset.name().to_owned(),
        split: recipe.split.name().to_owned(),
        stride: recipe.stride,
        geo_dim: config.latent,
        charts: config.charts,
        mixing: config.mixing.name().to_owned(),
        pairs: match &recipe.pairs {
            PairPlan::Stride(stride) => format!("stride {stride}"),
            PairPlan::Range(range) => {
                format!("{} of strides {}-{}", range.count, range.low, range.high)
            }
        },
        lr: config.learning_rate,
        loss: config.loss.name().to_owned(),
        epochs: config.epochs,
        batch: config.batch,
        weight_decay: config.weight_decay,
        hidden: config.hidden,
        seed: config.seed,
        n: 0,
        overall: None,
        translation: None,
        rotation: None,
        direction: None,
        magnitude: None,
        train_overall: None,
        seconds: 0.0,
        failure: String::new(),
    };

    SweepRow {
        key: format!("{}@{} {content} {recipe:?}", row.room, row.room_revision),
        ..row
    }
}

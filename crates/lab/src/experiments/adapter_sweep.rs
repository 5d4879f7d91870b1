//! A sweep over adapters: one row per run, with its settings and its scores.

use std::time::Instant;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use seese3_core::adapter::{PairPlan, TrainConfig};
use seese3_core::motion_scores::MotionScores;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};

/// Number of bytes of the room content hash used in a run's key.
const CONTENT_BYTES: usize = 16;

/// The settings and scores of one run. R² values are null if R² is undefined or the run failed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SweepRow {
    /// Unique key of the run: room, revision, content hash and all settings.
    pub key: String,
    /// The room.
    pub room: String,
    /// Its revision in the store.
    pub room_revision: u64,
    /// How the room was recorded, for instance `7scenes` or `studio corridor`.
    pub format: String,
    /// Frames of the room.
    pub frames: usize,
    /// The name of the features.
    pub features: String,
    /// The preset that the settings are based on.
    pub preset: String,
    /// The train/test split.
    pub split: String,
    /// Frames from source to target in the test pairs.
    pub stride: u32,
    /// Width of a chart's latent.
    pub geo_dim: usize,
    /// Number of charts.
    pub charts: usize,
    /// How the charts are mixed.
    pub mixing: String,
    /// The training pairs, in words.
    pub pairs: String,
    /// The learning rate.
    pub lr: f64,
    /// The training loss.
    pub loss: String,
    /// Passes over the training pairs.
    pub epochs: usize,
    /// Pairs per optimizer step.
    pub batch: usize,
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Width of φ's hidden layer.
    pub hidden: usize,
    /// Seed of the initial weights, the batch order and the sampled pairs.
    pub seed: u64,
    /// Number of test pairs.
    pub n: usize,
    /// Test R², mean over the six components.
    pub overall: Option<f64>,
    /// Test R², mean over the components of v.
    pub translation: Option<f64>,
    /// Test R², mean over the components of ω.
    pub rotation: Option<f64>,
    /// Test R² of the direction of v.
    pub direction: Option<f64>,
    /// Test R² of the length of v.
    pub magnitude: Option<f64>,
    /// Training R², mean over the six components.
    pub train_overall: Option<f64>,
    /// Wall time of the run, seconds.
    pub seconds: f64,
    /// Why the run failed; empty if it has scores.
    pub failure: String,
}

impl SweepRow {
    /// Copies the scores of a finished run into the row; a score that is not finite becomes null.
    pub fn score(&mut self, test: &MotionScores, train: &MotionScores) {
        let known = |value: f64| value.is_finite().then_some(value);
        self.n = test.n;
        self.overall = known(test.overall);
        self.translation = known(test.translation);

        self.rotation = known(test.rotation);
        self.direction = known(test.direction);
        self.magnitude = known(test.magnitude);
        self.train_overall = known(train.overall);
    }

    /// The settings that a grid varies. Runs of one protocol with equal settings differ only in
    /// room and seed.
    pub fn configuration(&self) -> (usize, usize, String, String, String) {
        // The learning rate is compared as text, since floating-point numbers have no total
        // order.
        (
            self.geo_dim,
            self.charts,
            self.lr.to_string(),
            self.loss.clone(),
            self.features.clone(),
        )
    }
}

/// Executes the run of a row and fills in its scores, or the reason for its failure.
pub fn run(data: &RoomData<'_>, plan: &TrainingPlan, mut row: SweepRow) -> SweepRow {
    let begun = Instant::now();

    match train_adapter(std::slice::from_ref(data), plan, &mut |_| ()) {
        Ok((_, record)) => row.score(&record.test, &record.train),
        Err(error) => row.failure = error.to_string(),
    }

    row.seconds = begun.elapsed().as_secs_f64();
    row
}

/// Hash of a room's poses and features, hexadecimal. It keeps runs apart when another store has
/// other content under the same names.
pub fn content(data: &RoomData<'_>) -> String {
    let mut digest = Sha256::new();
    for value in data.features.rows() {
        digest.update(value.to_le_bytes());
    }

    for pose in data.room.poses() {
        for value in pose.to_homogeneous().iter() {
            digest.update(value.to_le_bytes());
        }
    }

    hex::encode(&digest.finalize()[..CONTENT_BYTES])
}

/// The row of a pending run: its settings, without scores. `content` is the hash from [`content`].
pub fn row(data: &RoomData<'_>, content: &str, plan: &TrainingPlan) -> SweepRow {
    let config = &plan.config;
    let room = data.room.id().to_string();

    SweepRow {
        key: format!("{room}@{} {content} {}", data.revision, settings(plan)),
        room,
        room_revision: data.revision,
        format: data.room.provenance().format.clone(),
        frames: data.room.frame_count(),
        features: data.features.source().name.clone(),
        preset: plan.preset.name().to_owned(),
        split: plan.split.name().to_owned(),
        stride: plan.stride,
        geo_dim: config.latent,
        charts: config.charts,
        mixing: config.mixing.name().to_owned(),
        pairs: pairs_in_words(&plan.pairs),
        lr: config.learning_rate,
        loss: config.loss.name().to_owned(),
        epochs: config.epochs,
        batch: config.batch,
        weight_decay: config.weight_decay,
        hidden: config.hidden,
        seed: config.seed,
        ..SweepRow::default()
    }
}

fn pairs_in_words(pairs: &PairPlan) -> String {
    match pairs {
        PairPlan::Stride(stride) => format!("stride {stride}"),
        PairPlan::Range(range) => {
            format!("{} of strides {}-{}", range.count, range.low, range.high)
        }
    }
}

/// Every setting that affects a run's scores, in one line.
fn settings(plan: &TrainingPlan) -> String {
    // Destructured with no `..`, so that a new setting breaks the build here.
    let TrainingPlan {
        preset,
        split,
        stride,
        pairs,
        config,
        least_steps,
        correctors,
    } = plan;
    let TrainConfig {
        epochs,
        batch,
        learning_rate,
        weight_decay,
        clip_norm,
        hidden,
        latent,
        charts,
        mixing,
        loss,
        standardize,
        noise,
        average,
        through_zero,
        seed,
    } = config;

    let correctors: Vec<&str> = correctors.iter().map(|kind| kind.name()).collect();
    format!(
        "preset={} split={} stride={stride} pairs=[{}] epochs={epochs} least_steps={least_steps} batch={batch} \
         learning_rate={learning_rate:e} weight_decay={weight_decay:e} clip_norm={clip_norm:e} \
         hidden={hidden} geo_dim={latent} charts={charts} mixing={} loss={} \
         standardise={standardize} noise={noise:e} average={average:e} \
         through_zero={through_zero} seed={seed} correctors=[{}]",
        preset.name(),
        split.name(),
        pairs_in_words(pairs),
        mixing.name(),
        loss.name(),
        correctors.join(","),
    )
}

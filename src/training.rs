//! From a room's features and poses to an adapter and its scores.

use ndarray::ArrayView2;

use crate::adapter::{self, Adapter, EpochProgress, Preset, Samples, TrainConfig, TrainingRecord, train};
use crate::features::Features;
use crate::geometry::{Pose, Twist, body_twist};
use crate::pairs::{self, Pair, Split};
use crate::room::{Room, RoomId};
use crate::scores::{MotionScores, constant_r2};

/// Why nothing was learned.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error {
    #[error(transparent)]
    Pairs(#[from] pairs::Error),
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    #[error("room '{room}' has {frame_count} frames, features '{features}' have {rows} rows")]
    FeatureRows { room: RoomId, frame_count: usize, features: String, rows: usize },
    #[error("epochs must be 1 to {MAX_EPOCHS}, got {epochs}")]
    Epochs { epochs: usize },
}

/// The most passes over the pairs.
pub const MAX_EPOCHS: usize = 100_000;

/// What decides the numbers of a training run, besides its room.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// The protocol.
    pub preset: Preset,
    /// How frames are kept apart.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
    /// Passes over the pairs; the preset's when none is given.
    pub epochs: Option<usize>,
    /// Of weights, order and drawn pairs.
    pub seed: u64,
}

/// A room as it lies in the store.
#[derive(Debug, Clone, Copy)]
pub struct Lesson<'a> {
    /// Where the frames were.
    pub room: &'a Room,
    /// The room's revision.
    pub revision: u64,
    /// What was seen, row by frame.
    pub features: &'a Features,
}

/// Trains an adapter on one room and scores it on the room's test pairs.
///
/// # Errors
/// [`Error`], when the room is too short, its features do not fit, or training fails.
///
/// Source: SeeSE3, M4 (sec. 2.4).
pub fn learn(
    lesson: Lesson<'_>,
    recipe: &Recipe,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<(Adapter, TrainingRecord), Error> {
    let (room, rows) = (lesson.room, lesson.features.rows());
    let frame_count = room.frame_count();
    if rows.nrows() != frame_count {
        let features = lesson.features.source().name.clone();
        return Err(Error::FeatureRows { room: room.id().clone(), frame_count, features, rows: rows.nrows() });
    }
    let preset = recipe.preset.config(recipe.seed);
    let config = TrainConfig { epochs: recipe.epochs.unwrap_or(preset.epochs), ..preset };
    if config.epochs == 0 || config.epochs > MAX_EPOCHS {
        return Err(Error::Epochs { epochs: config.epochs });
    }
    let test_pairs = recipe.split.test_pairs(room.timeline(), recipe.stride)?;
    let train_pairs = recipe.preset.plan(recipe.stride).pairs(recipe.split, room.timeline(), recipe.seed)?;
    let twists = motions(room.poses(), &train_pairs);
    let ends = train_pairs.iter().map(|pair| [pair.source.row(), pair.target.row()]).collect();
    let samples = Samples::new(rows, ends, &twists)?;
    let network = train(&samples, &config, progress)?;
    let adapter = Adapter::new(lesson.features.source().clone(), network, samples.scale().clone())?;
    let truth = motions(room.poses(), &test_pairs);
    let record = TrainingRecord {
        preset: recipe.preset.name().to_owned(),
        split: recipe.split,
        stride: recipe.stride,
        rooms: vec![(room.id().clone(), lesson.revision)],
        config,
        pair_count: train_pairs.len(),
        test: MotionScores::of(&truth, &predictions(&adapter, rows, &test_pairs)?),
        train: MotionScores::of(&twists, &predictions(&adapter, rows, &train_pairs)?),
        train_mean_r2: constant_r2(&truth, &samples.scale().mean),
    };
    Ok((adapter, record))
}

/// The true motions of pairs, each in its source's body frame.
fn motions(poses: &[Pose], pairs: &[Pair]) -> Vec<Twist> {
    pairs.iter().map(|pair| body_twist(&poses[pair.source.row()], &poses[pair.target.row()])).collect()
}

fn predictions(adapter: &Adapter, rows: ArrayView2<'_, f32>, pairs: &[Pair]) -> Result<Vec<Twist>, Error> {
    let latents = adapter.embed(rows)?;
    let motion = |pair: &Pair| adapter.motion(latents.row(pair.source.row()), latents.row(pair.target.row()));
    Ok(pairs.iter().map(motion).collect())
}

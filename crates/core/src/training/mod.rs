//! Training: features and poses of rooms in, an adapter and its scores out.

mod relational;

pub use relational::{relational_predictions, train_reader};

use ndarray::{Array2, ArrayView2, s};

use crate::adapter::{
    self, Adapter, CorrectorKind, EpochProgress, MAX_CHARTS, Mixing, PairPlan, Preset, Samples,
    TrainConfig, TrainingRecord, train, train_corrector,
};
use crate::cancel::Cancellation;
use crate::features::Features;
use crate::geometry::{Pose, Twist, body_twist};
use crate::motion_scores::{MotionScores, constant_r2};
use crate::room::{Room, RoomId};
use crate::splits::{self, Pair, Split};
use crate::statistics::mean_of_known;

/// Why training or calibration failed.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(transparent)]
    Pairs(#[from] splits::Error),
    #[error("room '{room}': {problem}")]
    RoomPairs {
        room: RoomId,
        problem: splits::Error,
    },
    #[error(transparent)]
    Adapter(#[from] adapter::Error),
    #[error("room '{room}' has {frame_count} frames, features '{features}' have {rows} rows")]
    FeatureRows {
        room: RoomId,
        frame_count: usize,
        features: String,
        rows: usize,
    },
    #[error("features '{features}' of rooms '{first}' and '{room}' come from different sources")]
    UnlikeFeatures {
        features: String,
        first: RoomId,
        room: RoomId,
    },
    #[error(
        "alternative formulations need one chart, mean squared error and unscaled features; use a paper preset"
    )]
    NotPlain,
    #[error("training needs at least one room")]
    NoRoom,
    #[error("{what} must be {least} to {most}, got {given}")]
    Setting {
        what: &'static str,
        least: usize,
        most: usize,
        given: usize,
    },
    #[error("{what} must be finite and {bound}, got {given}")]
    Rate {
        what: &'static str,
        bound: &'static str,
        given: f64,
    },
}

/// Maximum number of epochs.
pub const MAX_EPOCHS: usize = 100_000;
/// Maximum number of columns of a chart's latent.
pub const MAX_LATENT_DIM: usize = 4_096;
/// Maximum number of pairs per optimizer step.
const MAX_BATCH: usize = 1 << 20;
/// Epochs of a corrector; the paper does not state them.
pub const CORRECTOR_EPOCHS: usize = 200;

/// All settings of a training run except its rooms.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingPlan {
    /// The preset that the settings started from.
    pub preset: Preset,
    /// Split of the frames into training and test.
    pub split: Split,
    /// Frames from source to target in the test pairs.
    pub stride: u32,
    /// Selection of the training pairs.
    pub pairs: PairPlan,
    /// Optimizer settings, and the seed of the weights, the order of pairs and the sampled pairs.
    pub config: TrainConfig,
    /// Minimum number of optimizer steps; epochs are added to those of `config` until it is
    /// reached.
    pub least_steps: usize,
    /// Correctors to train after the adapter: [`CORRECTOR_EPOCHS`] epochs of mean squared error on
    /// its latents, with the other optimizer settings and the seed of `config`.
    pub correctors: Vec<CorrectorKind>,
}

impl TrainingPlan {
    /// The pairs and settings of a preset, without correctors.
    pub fn of(preset: Preset, split: Split, stride: u32, seed: u64) -> Self {
        let pairs = preset.plan(stride);
        let config = preset.config(seed);

        Self {
            preset,
            split,
            stride,
            pairs,
            config,
            least_steps: preset.least_steps(),
            correctors: Vec::new(),
        }
    }

    /// The same plan with another seed.
    #[must_use]
    pub fn with_seed(&self, seed: u64) -> Self {
        let mut plan = self.clone();
        plan.config.seed = seed;
        plan
    }

    /// Optimizer settings for `pair_count` pairs, with enough epochs for the minimum number of
    /// steps.
    pub fn config_for(&self, pair_count: usize) -> TrainConfig {
        let batches = pair_count.div_ceil(self.config.batch.max(1)).max(1);
        TrainConfig {
            epochs: self.config.epochs.max(self.least_steps.div_ceil(batches)),
            ..self.config.clone()
        }
    }

    /// Validates the settings.
    ///
    /// # Errors
    /// [`Error::Setting`] or [`Error::Rate`] for a number out of range, [`Error::Adapter`] for a
    /// duplicate corrector and for z-scored features with a gate.
    pub fn check(&self) -> Result<(), Error> {
        self.check_counts()?;
        self.check_rates()?;

        // An adapter has at most one corrector of a kind.
        let twice = |(at, kind): (usize, &CorrectorKind)| self.correctors[..at].contains(kind);
        if let Some((_, kind)) = self
            .correctors
            .iter()
            .enumerate()
            .find(|&given| twice(given))
        {
            return Err(Error::Adapter(adapter::Error::CorrectorTwice {
                name: kind.name(),
            }));
        }

        if self.config.standardize && self.config.charts > 1 && self.config.mixing == Mixing::Gate {
            return Err(Error::Adapter(adapter::Error::GatedStandardized));
        }

        Ok(())
    }

    fn check_counts(&self) -> Result<(), Error> {
        let config = &self.config;
        for (what, given, least, most) in [
            ("epochs", config.epochs, 1, MAX_EPOCHS),
            ("batch", config.batch, 1, MAX_BATCH),
            ("hidden columns", config.hidden, 1, MAX_LATENT_DIM),
            ("geo_dim", config.latent, 6, MAX_LATENT_DIM),
            ("charts", config.charts, 1, MAX_CHARTS),
        ] {
            if !(least..=most).contains(&given) {
                return Err(Error::Setting {
                    what,
                    least,
                    most,
                    given,
                });
            }
        }

        Ok(())
    }

    /// Otherwise NaN or infinity would only be detected during training.
    fn check_rates(&self) -> Result<(), Error> {
        let config = &self.config;
        let is_positive = |value: f64| value.is_finite() && value > 0.0;
        for (what, given) in [
            ("the learning rate", config.learning_rate),
            ("the clipping norm", config.clip_norm),
        ] {
            if !is_positive(given) {
                let bound = "positive";
                return Err(Error::Rate { what, bound, given });
            }
        }

        for (what, given) in [
            ("the noise", config.noise),
            ("the weight decay", config.weight_decay),
        ] {
            if given != 0.0 && !is_positive(given) {
                let bound = "not negative";
                return Err(Error::Rate { what, bound, given });
            }
        }

        if !(0.0..1.0).contains(&config.average) {
            return Err(Error::Rate {
                what: "the decay of the average",
                bound: "at least 0 and under 1",
                given: config.average,
            });
        }

        Ok(())
    }
}

/// A room for training or evaluation, with one of its feature sets.
#[derive(Debug, Clone, Copy)]
pub struct RoomData<'a> {
    /// The room: its frames and their poses.
    pub room: &'a Room,
    /// The room's revision in the store.
    pub revision: u64,
    /// The room's features, one row per frame.
    pub features: &'a Features,
}

/// Trains one adapter on all rooms and scores it on each room's test pairs.
///
/// # Errors
/// [`Error`] when there is no room, a room is too short for the split, the features of the rooms
/// differ in source, a setting is out of range, or training diverges.
///
/// Source: SeeSE3, M4 (Eq. 3, Sec. A.2); cross-room training Sec. A.10.
pub fn train_adapter(
    room_data: &[RoomData<'_>],
    plan: &TrainingPlan,
    progress: &mut dyn FnMut(EpochProgress),
) -> Result<(Adapter, TrainingRecord), Error> {
    plan.check()?;
    check_rooms(room_data)?;

    // Test pairs are selected before training, so that a room that is too short fails early.
    let tests = test_pairs(room_data, plan)?;
    let samples = samples(room_data, plan)?;
    let trained_with = plan.config_for(samples.pair_count());
    let cancel = Cancellation::default();
    let network = train(&samples, &trained_with, &cancel, progress)?;
    let adapter = Adapter::new(
        room_data[0].features.source().clone(),
        network,
        samples.scale().clone(),
    )?;

    let mut correctors = Vec::with_capacity(plan.correctors.len());

    // Only the number of epochs differs from the adapter's settings.
    let config = TrainConfig {
        epochs: CORRECTOR_EPOCHS,
        ..plan.config.clone()
    };

    for &kind in &plan.correctors {
        correctors.push(train_corrector(
            kind,
            &adapter,
            &samples,
            &config,
            &mut |_| (),
        )?);
    }

    let adapter = adapter.with_correctors(correctors)?;
    let mut room_tests = Vec::with_capacity(room_data.len());
    let mut train_mean_r2 = Vec::with_capacity(room_data.len());

    // Each room is scored separately: in the mean, rooms have equal weight, not pairs.
    for (data, pairs) in room_data.iter().zip(&tests) {
        let truth = motions(data.room.poses(), pairs);
        room_tests.push(MotionScores::of(
            &truth,
            &predictions(&adapter, data.features.rows(), pairs)?,
        ));

        // Baseline: R² of predicting the mean training motion μ for every test pair.
        train_mean_r2.push(constant_r2(&truth, &samples.scale().mean));
    }

    let record = TrainingRecord {
        preset: plan.preset.name().to_owned(),
        split: plan.split,
        stride: plan.stride,
        pairs: plan.pairs.clone(),
        rooms: room_data
            .iter()
            .map(|data| (data.room.id().clone(), data.revision))
            .collect(),
        calibrated_on: Vec::new(),
        config: trained_with,
        pair_count: samples.pair_count(),
        test: MotionScores::mean(&room_tests),
        room_tests,
        train: train_scores(&adapter, &samples)?,
        train_mean_r2: mean_of_known(&train_mean_r2),
        relational: None,
    };

    Ok((adapter, record))
}

/// Training pairs of the rooms, with the features of all rooms stacked.
///
/// # Errors
/// [`Error::Pairs`] when a room has no training pair under the plan, [`Error::Adapter`] when all
/// pairs have the same motion.
pub fn samples(room_data: &[RoomData<'_>], plan: &TrainingPlan) -> Result<Samples<f32>, Error> {
    let timelines: Vec<_> = room_data.iter().map(|data| data.room.timeline()).collect();
    let drawn = plan.pairs.pairs(plan.split, &timelines, plan.config.seed)?;

    // The rooms are stacked; `first_rows` holds the first row of each room.
    let mut first_rows = Vec::with_capacity(room_data.len());
    let mut count = 0;
    for data in room_data {
        first_rows.push(count);
        count += data.room.frame_count();
    }

    let columns = room_data
        .first()
        .map_or(0, |data| data.features.source().dim);
    let mut features = Array2::zeros((count, columns));

    let mut poses = Vec::with_capacity(count);
    for (data, &first) in room_data.iter().zip(&first_rows) {
        features
            .slice_mut(s![first..first + data.room.frame_count(), ..])
            .assign(&data.features.rows());
        poses.extend_from_slice(data.room.poses());
    }

    // Pairs index frames of a room; samples index rows of the stack.
    let rows = |(room, pair): (usize, Pair)| {
        [pair.source, pair.target].map(|frame| first_rows[room] + frame.row())
    };
    let samples = Samples::new(
        features.view(),
        poses,
        drawn.into_iter().map(rows).collect(),
    )?;

    // With μ = 0 and σ the root mean square, zero motion leaves the latent unchanged in every
    // reading.
    Ok(if plan.config.through_zero {
        samples.through_zero()?
    } else {
        samples
    })
}

/// Test pairs of each room; empty under [`Split::Whole`], which holds out no pairs.
pub fn test_pairs(
    room_data: &[RoomData<'_>],
    plan: &TrainingPlan,
) -> Result<Vec<Vec<Pair>>, Error> {
    let of = |data: &RoomData<'_>| {
        if plan.split == Split::Whole {
            return Ok(Vec::new());
        }

        let pairs = plan.split.test_pairs(data.room.timeline(), plan.stride);

        // With several rooms, the error names the room without test pairs.
        pairs.map_err(|problem| match room_data.len() {
            1 => Error::Pairs(problem),
            _ => Error::RoomPairs {
                room: data.room.id().clone(),
                problem,
            },
        })
    };

    room_data.iter().map(of).collect()
}

/// Checks that every room has one feature row per frame and that all features have the same source.
///
/// # Errors
/// [`Error::NoRoom`], [`Error::FeatureRows`] or [`Error::UnlikeFeatures`].
pub fn check_rooms(room_data: &[RoomData<'_>]) -> Result<(), Error> {
    let first = room_data.first().ok_or(Error::NoRoom)?;
    for data in room_data {
        let frame_count = data.room.frame_count();
        let rows = data.features.rows().nrows();
        let features = data.features.source().name.clone();
        if rows != frame_count {
            return Err(Error::FeatureRows {
                room: data.room.id().clone(),
                frame_count,
                features,
                rows,
            });
        }

        // An adapter is trained on features of a single encoder, layer and pooling.
        let source = first.features.source();
        let own = data.features.source();
        if !own.is_like(source) || own.dim != source.dim {
            let first = first.room.id().clone();
            let room = data.room.id().clone();

            return Err(Error::UnlikeFeatures {
                features,
                first,
                room,
            });
        }
    }

    Ok(())
}

/// True motions of pairs, in the body frame of the source camera.
pub fn motions(poses: &[Pose], pairs: &[Pair]) -> Vec<Twist> {
    pairs
        .iter()
        .map(|pair| body_twist(&poses[pair.source.row()], &poses[pair.target.row()]))
        .collect()
}

/// Predicted motions of pairs, from the features of their two frames.
///
/// # Errors
/// As [`Adapter::embed`].
pub fn predictions(
    adapter: &Adapter,
    rows: ArrayView2<'_, f32>,
    pairs: &[Pair],
) -> Result<Vec<Twist>, adapter::Error> {
    let latents = adapter.embed(rows)?;
    let motion = |pair: &Pair| {
        adapter.motion(
            latents.row(pair.source.row()),
            latents.row(pair.target.row()),
        )
    };

    Ok(pairs.iter().map(motion).collect())
}

fn train_scores(adapter: &Adapter, samples: &Samples<f32>) -> Result<MotionScores, Error> {
    let latents = adapter.embed(samples.features())?;
    let motion = |pair: usize| {
        let [from, to] = samples.pair(pair);
        adapter.motion(latents.row(from), latents.row(to))
    };
    let predicted: Vec<Twist> = (0..samples.pair_count()).map(motion).collect();

    Ok(MotionScores::of(samples.twists(), &predicted))
}

//! Fits an adapter to the mapped frames of one room and cross-validates its motion estimates.

use std::sync::Arc;

use super::folds::{Fold, folds};
use super::localizer::Localizer;
use super::pairs::{PAIRS, longest_rows, pairs};
use super::rules::{HeldOutView, ReadingRules};
use super::{Error, check_mapped};
use seese3_core::adapter::{
    self, Adapter, EpochProgress, PairPlan, Samples, TrainConfig, TrainingRecord, train,
    train_further,
};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::{Twist, body_twist};
use seese3_core::motion_scores::{MotionScores, constant_r2};
use seese3_core::room::FrameId;
use seese3_core::splits::{Split, StrideRange};
use seese3_core::training::{RoomData, check_rooms};

/// Minimum number of mapped frames for a fit.
pub const FEWEST_MAPPED_FRAMES: usize = 20;
/// Preset name in the training record of a fitted adapter.
pub const FITTED_PRESET: &str = "fitted";
/// Epochs of one training, about 590 steps in total.
const EPOCHS: usize = 10;

/// Total epochs of a fit: one training for the adapter and one for each of the four folds.
pub const FITTING_EPOCHS: u64 = 5 * EPOCHS as u64;

/// An adapter fitted to a room, with its cross-validated reading rules.
#[derive(Debug, Clone)]
pub struct Fitted {
    /// The adapter.
    pub adapter: Arc<Adapter>,
    /// Rules measured on held-out mapped frames.
    pub rules: ReadingRules,
    /// Training record of the adapter.
    pub record: TrainingRecord,
}

/// How a fit reports its progress and is stopped.
#[derive(Clone, Copy)]
pub struct FitRun<'a> {
    /// Called after each epoch, [`FITTING_EPOCHS`] times in all, from several threads.
    pub progress: &'a (dyn Fn(EpochProgress) + Sync),
    /// Stops the fit.
    pub cancel: &'a Cancellation,
}

/// Never set.
static NEVER: Cancellation = Cancellation::new();

impl FitRun<'static> {
    /// A run without progress that cannot be stopped.
    pub const UNWATCHED: Self = Self {
        progress: &|_| (),
        cancel: &NEVER,
    };
}

/// Fits an adapter to the mapped frames of a room; `mapped` must be in ascending order.
///
/// Training continues from the weights of `base`, an adapter of other rooms, if that has one chart;
/// otherwise it starts from new weights. `base` also remains a motion estimator of its own, see
/// [`ReadingRules`]. Five models are trained in parallel.
///
/// # Errors
/// - [`Error::FewFrames`] or [`Error::MappedFrames`] for invalid mapped frames.
/// - [`Error::Training`] if features and room do not match.
/// - [`Error::Adapter`] if `base` has another feature source or training fails, for example because
///   the camera does not move.
/// - [`Error::Adapter`] with `Cancelled` once `run.cancel` is set.
/// - [`Error::AllAlike`] if the features of the mapped frames are identical.
pub fn fit(
    data: &RoomData<'_>,
    mapped: &[FrameId],
    base: Option<&Arc<Adapter>>,
    seed: u64,
    run: FitRun<'_>,
) -> Result<Fitted, Error> {
    check_rooms(std::slice::from_ref(data))?;
    check_mapped(data.room, mapped, FEWEST_MAPPED_FRAMES)?;
    if let Some(base) = base {
        base.check_source(data.features.source())?;
    }

    // The adapter and the models of the folds are independent: train them in parallel.
    let folds = folds(mapped);
    let tried = |fold: &Fold| trials(data, fold, base, seed, run);
    let (trained, tried) = std::thread::scope(|scope| {
        let tried: Vec<_> = folds
            .iter()
            .map(|fold| scope.spawn(|| tried(fold)))
            .collect();
        let trained = trained(data, mapped, base, seed, run);

        let tried: Vec<_> = tried
            .into_iter()
            .map(|thread| {
                thread
                    .join()
                    .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            })
            .collect();
        (trained, tried)
    });

    let mut trials = Vec::new();
    for tried in tried {
        trials.extend(tried?);
    }

    let (adapter, samples) = trained?;
    let record = record(data, mapped, &adapter, &samples, seed)?;
    Ok(Fitted {
        adapter: Arc::new(adapter),
        rules: ReadingRules::measured(trials)?,
        record,
    })
}

/// Training settings. The network is wider and trains for more steps than for many rooms, to
/// distinguish neighboring views. Noise regularizes the small number of frames.
fn config(seed: u64) -> TrainConfig {
    TrainConfig {
        epochs: EPOCHS,
        learning_rate: 3e-3,
        hidden: 128,
        standardize: true,
        noise: 0.5,
        average: 0.99,
        through_zero: true,
        seed,
        ..TrainConfig::default()
    }
}

/// Trains an adapter on the given mapped frames; returns it with its samples.
fn trained(
    data: &RoomData<'_>,
    mapped: &[FrameId],
    base: Option<&Arc<Adapter>>,
    seed: u64,
    run: FitRun<'_>,
) -> Result<(Adapter, Samples<f32>), Error> {
    let samples = Samples::new(
        data.features.rows(),
        data.room.poses().to_vec(),
        pairs(data.room, mapped, seed),
    )?;

    let config = config(seed);
    let mut progress = |epoch| (run.progress)(epoch);
    let base = base.filter(|base| base.network().chart_count() == 1);
    let (network, samples) = match base {
        Some(base) => {
            let samples = samples.with_scale(base.scale().clone())?;
            let network =
                train_further(&samples, base.network(), &config, run.cancel, &mut progress)?;
            (network, samples)
        }
        None => {
            let samples = samples.through_zero()?;
            (
                train(&samples, &config, run.cancel, &mut progress)?,
                samples,
            )
        }
    };

    let source = data.features.source().clone();
    let adapter = Adapter::new(source, network, samples.scale().clone())?;
    Ok((adapter, samples))
}

/// Estimates the motions of a fold's held-out frames with an adapter trained without them.
fn trials(
    data: &RoomData<'_>,
    fold: &Fold,
    base: Option<&Arc<Adapter>>,
    seed: u64,
    run: FitRun<'_>,
) -> Result<Vec<HeldOutView>, Error> {
    let (adapter, _) = trained(data, &fold.mapped, base, seed, run)?;
    let localizer = Localizer::new(data, &fold.mapped, base.cloned(), Some(Arc::new(adapter)))?;

    fold.left_out
        .iter()
        .map(|frame| {
            let feature = data.features.rows().row(frame.row()).to_vec();
            let readings = localizer.read(&feature)?;
            let mapped_pose = localizer.pose(readings.nearest.frame);
            let truth = body_twist(mapped_pose, &data.room.poses()[frame.row()]);
            Ok(HeldOutView {
                readings,
                truth,
                is_interleaved: fold.is_interleaved,
            })
        })
        .collect()
}

fn record(
    data: &RoomData<'_>,
    mapped: &[FrameId],
    adapter: &Adapter,
    samples: &Samples<f32>,
    seed: u64,
) -> Result<TrainingRecord, adapter::Error> {
    let longest = longest_rows(mapped);
    let latents = adapter.embed(samples.features())?;
    let predicted: Vec<Twist> = (0..samples.pair_count())
        .map(|pair| {
            let [from, to] = samples.pair(pair);
            adapter.motion(latents.row(from), latents.row(to))
        })
        .collect();

    // The final adapter is trained on all mapped frames, so there are no test scores.
    let untested = MotionScores::of(&[], &[]);
    let truth = samples.twists();
    Ok(TrainingRecord {
        preset: FITTED_PRESET.to_owned(),
        split: Split::Whole,
        stride: longest,
        pairs: PairPlan::Range(StrideRange {
            low: 1,
            high: longest,
            count: PAIRS,
        }),
        rooms: vec![(data.room.id().clone(), data.revision)],
        calibrated_on: Vec::new(),
        config: TrainConfig {
            hidden: adapter.network().charts()[0].phi.hidden_dim(),
            latent: adapter.coordinate_count(),
            ..config(seed)
        },
        pair_count: samples.pair_count(),
        room_tests: vec![untested],
        test: untested,
        train: MotionScores::of(truth, &predicted),
        train_mean_r2: constant_r2(truth, &samples.scale().mean),
        relational: None,
    })
}

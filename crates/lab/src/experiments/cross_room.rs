//! Cross-room evaluation: scores of an adapter in held-out rooms, and comparison of navigators
//! there.
//!
//! Confidence intervals resample rooms, not pairs, because the pairs of one room are correlated.

use std::collections::BTreeMap;
use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Serialize, Serializer};

use seese3_core::adapter::{Adapter, RelationalConfig, TrainingRecord};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Baselines, Protocol, Row, TestPairs, evaluate};
use seese3_core::motion_scores::MotionScores;
use seese3_core::navigation::{IndexKind, Navigator, NavigatorKind};
use seese3_core::room::RoomId;
use seese3_core::statistics::{Rate, RoomMean, bootstrap_mean};
use seese3_core::training::{
    RoomData, TrainingPlan, motions, predictions, train_adapter, train_reader,
};
use seese3_robot::calibration::{Calibrated, calibrate_retrieval};

use super::Error;
use crate::json;

/// Lower clip of R² in a clipped mean. R² has no lower bound, so one bad room would dominate the
/// mean.
pub const CLIPPED_R2: f64 = -1.0;

/// max(R², [`CLIPPED_R2`]); NaN stays NaN.
pub fn clipped_r2(r2: f64) -> f64 {
    r2.clamp(CLIPPED_R2, f64::INFINITY)
}

/// A score by which the best of several is chosen; a score that is NaN is never the best.
pub fn or_worst(score: f64) -> f64 {
    if score.is_nan() {
        f64::NEG_INFINITY
    } else {
        score
    }
}

/// The scores of an adapter in one room.
#[derive(Debug, Clone, Serialize)]
pub struct RoomOutcome {
    /// The room.
    #[serde(serialize_with = "json::shown")]
    pub room: RoomId,
    /// Number of candidate frames of retrieval.
    #[serde(rename = "candidates")]
    pub candidate_count: usize,
    /// R² of the motions of its test pairs.
    #[serde(serialize_with = "json::shaped::<json::MotionJson, _, _>")]
    pub motion: MotionScores,
    /// Baselines to compare R² with.
    #[serde(serialize_with = "json::shaped::<json::BaselinesJson, _, _>")]
    pub baselines: Baselines,
    /// One row per navigator; in JSON, the hit rates by navigator.
    #[serde(rename = "hit", serialize_with = "first_hits")]
    pub rows: Vec<Row>,
}

/// Serializes each navigator's Hit@ε at the first threshold, sorted by name.
fn first_hits<S: Serializer>(rows: &[Row], to: S) -> Result<S::Ok, S::Error> {
    let hit = |row: &Row| Some((row.name.clone(), row.retrieval.hits.first()?.1));
    let hits: BTreeMap<String, Rate> = rows.iter().filter_map(hit).collect();
    hits.serialize(to)
}

/// A room that could not be evaluated.
#[derive(Debug, Clone, Serialize)]
pub struct Skipped {
    /// The room.
    pub room: String,
    /// The reason.
    pub why: String,
}

impl RoomOutcome {
    /// A navigator's Hit@ε at the first threshold of the protocol.
    pub fn hit_rate(&self, navigator: &str) -> Option<Rate> {
        let row = self.rows.iter().find(|row| row.name == navigator)?;
        row.retrieval.hits.first().map(|(_, rate)| *rate)
    }
}

/// Results of one adapter in the held-out rooms.
#[derive(Debug, Clone)]
pub struct CrossRoomRun {
    /// Rooms that the adapter was trained on.
    pub training_rooms: Vec<String>,
    /// Rooms that the adapter was calibrated on.
    pub calibration_rooms: Vec<String>,
    /// Seed of the training run.
    pub seed: u64,
    /// One outcome per held-out room.
    pub outcomes: Vec<RoomOutcome>,
    /// Rooms that could not be evaluated.
    pub skipped: Vec<Skipped>,
}

impl CrossRoomRun {
    /// Names of the evaluated navigators, in evaluation order.
    pub fn navigators(&self) -> Vec<&str> {
        self.outcomes.first().map_or(Vec::new(), |outcome| {
            outcome.rows.iter().map(|row| row.name.as_str()).collect()
        })
    }

    /// Hit rates of a navigator, one per room in which it was evaluated.
    pub fn hit_rates(&self, navigator: &str) -> Vec<f64> {
        self.outcomes
            .iter()
            .filter_map(|outcome| outcome.hit_rate(navigator))
            .map(|rate| rate.rate)
            .collect()
    }

    /// Overall R² of the motions, one value per room.
    pub fn r2(&self) -> Vec<f64> {
        self.outcomes
            .iter()
            .map(|outcome| outcome.motion.overall)
            .collect()
    }
}

/// How an adapter is trained on some rooms and evaluated in others.
pub struct CrossRoomPlan<'a> {
    /// How the adapter is trained, with its seed.
    pub training: &'a TrainingPlan,
    /// Settings of a relational reader to train beside it, if any.
    pub relational: Option<RelationalConfig>,
    /// Number of rooms, taken from the end of the list, used for calibration instead of training.
    pub calibration_rooms: usize,
    /// How the held-out rooms are evaluated.
    pub protocol: &'a Protocol,
}

/// The result of [`train_and_test`].
pub struct CrossRoomResult {
    /// The adapter, calibrated for retrieval if there were calibration rooms.
    pub adapter: Adapter,
    /// Its training record.
    pub record: TrainingRecord,
    /// Its results in the held-out rooms.
    pub run: CrossRoomRun,
}

/// Progress callbacks of [`train_and_test`].
pub struct CrossRoomProgress<'a> {
    /// Called after every epoch of the training.
    pub epoch: &'a (dyn Fn() + Sync),
    /// Called after every held-out room.
    pub room: &'a (dyn Fn() + Sync),
}

/// Trains an adapter on `rooms` and evaluates it in the rooms `held_out`.
///
/// # Errors
/// [`Error`] when the training or the calibration fails. A held-out room that cannot be evaluated
/// is skipped; the run records the reason.
pub fn train_and_test(
    rooms: &[RoomData<'_>],
    held_out: &[RoomData<'_>],
    plan: &CrossRoomPlan<'_>,
    progress: &CrossRoomProgress<'_>,
) -> Result<CrossRoomResult, Error> {
    let trained = train_and_calibrate(rooms, plan, progress)?;
    test_trained(trained, rooms, held_out, plan, progress)
}

/// The training rooms and the calibration rooms of a plan.
fn parted<'a, 'b>(
    rooms: &'a [RoomData<'b>],
    plan: &CrossRoomPlan<'_>,
) -> Result<(&'a [RoomData<'b>], &'a [RoomData<'b>]), Error> {
    let training_rooms = rooms.len().checked_sub(plan.calibration_rooms);
    let training_rooms = training_rooms.ok_or_else(|| {
        Error::Input(format!(
            "cannot use {} of {} rooms for calibration",
            plan.calibration_rooms,
            rooms.len()
        ))
    })?;
    Ok(rooms.split_at(training_rooms))
}

/// Trains an adapter on `rooms`, of which the last ones calibrate it.
///
/// # Errors
/// [`Error`] when the training or the calibration fails.
pub fn train_and_calibrate(
    rooms: &[RoomData<'_>],
    plan: &CrossRoomPlan<'_>,
    progress: &CrossRoomProgress<'_>,
) -> Result<(Adapter, TrainingRecord), Error> {
    let (training, calibration) = parted(rooms, plan)?;
    let (mut adapter, mut record) =
        train_adapter(training, plan.training, &mut |_| (progress.epoch)())?;
    if let Some(config) = &plan.relational {
        let reader = train_reader(training, plan.training.split, config, &mut |_| {
            (progress.epoch)()
        })?;
        adapter = adapter.with_relational(reader)?;
        record.relational = Some(config.clone());
    }
    if calibration.is_empty() {
        return Ok((adapter, record));
    }

    let Calibrated {
        adapter, record, ..
    } = calibrate_retrieval(adapter, record, calibration)?;
    Ok((adapter, record))
}

/// Evaluates an adapter of [`train_and_calibrate`] in the rooms `held_out`.
///
/// # Errors
/// [`Error::Input`] if there are more calibration rooms than rooms. A held-out room that cannot be
/// evaluated is skipped; the run records the reason.
pub fn test_trained(
    (adapter, record): (Adapter, TrainingRecord),
    rooms: &[RoomData<'_>],
    held_out: &[RoomData<'_>],
    plan: &CrossRoomPlan<'_>,
    progress: &CrossRoomProgress<'_>,
) -> Result<CrossRoomResult, Error> {
    let (training, calibration) = parted(rooms, plan)?;

    let mut run = CrossRoomRun {
        training_rooms: names(training),
        calibration_rooms: names(calibration),
        seed: plan.training.config.seed,
        outcomes: Vec::new(),
        skipped: Vec::new(),
    };
    for outcome in outcomes(
        &Arc::new(adapter.clone()),
        &record,
        held_out,
        plan.protocol,
        progress.room,
    ) {
        match outcome {
            Ok(outcome) => run.outcomes.push(outcome),
            Err((room, why)) => run.skipped.push(Skipped {
                room: room.to_string(),
                why: why.to_string(),
            }),
        }
    }

    Ok(CrossRoomResult {
        adapter,
        record,
        run,
    })
}

fn names(rooms: &[RoomData<'_>]) -> Vec<String> {
    rooms
        .iter()
        .map(|data| data.room.id().to_string())
        .collect()
}

/// Evaluates an adapter in each of several rooms, in parallel. Results are in the order of the
/// rooms; a room that cannot be evaluated yields an error (A-25). `done` is called after each room.
pub fn outcomes(
    adapter: &Arc<Adapter>,
    record: &TrainingRecord,
    room_data: &[RoomData<'_>],
    protocol: &Protocol,
    done: &(dyn Fn() + Sync),
) -> Vec<Result<RoomOutcome, (RoomId, Error)>> {
    let of = |data: &RoomData<'_>| {
        let outcome = outcome(adapter, record, data, protocol)
            .map_err(|error| (data.room.id().clone(), error));
        done();
        outcome
    };
    room_data.par_iter().map(of).collect()
}

fn outcome(
    adapter: &Arc<Adapter>,
    record: &TrainingRecord,
    data: &RoomData<'_>,
    protocol: &Protocol,
) -> Result<RoomOutcome, Error> {
    let room = Arc::new(data.room.clone());
    let navigator = Navigator::new(
        room.clone(),
        data.features,
        adapter.clone(),
        IndexKind::Exact,
    )?;

    let report = evaluate(
        &navigator,
        protocol,
        &Cancellation::default(),
        &mut |_, _| (),
    )?;

    // Motion scores use the same test pairs as the retrieval scores above.
    let pairs = protocol
        .split
        .test_pairs(room.timeline(), protocol.stride)?;
    let predicted = predictions(adapter, data.features.rows(), &pairs)?;

    Ok(RoomOutcome {
        room: room.id().clone(),
        motion: MotionScores::of(&motions(room.poses(), &pairs), &predicted),
        rows: report.rows,
        candidate_count: report.candidate_count,
        baselines: Baselines::of(
            adapter.scale(),
            record.optimizer_steps(),
            &room,
            &TestPairs {
                split: protocol.split,
                stride: protocol.stride,
            },
            false,
        )?,
    })
}

/// The fraction of rooms in which a navigator's hit rate is strictly above Identity's. `None` when
/// no room has both.
pub fn wins(outcomes: &[RoomOutcome], navigator: &str) -> Option<Rate> {
    let identity = NavigatorKind::Identity.name();
    let pairs: Vec<(f64, f64)> = outcomes
        .iter()
        .filter_map(|outcome| {
            Some((
                outcome.hit_rate(navigator)?.rate,
                outcome.hit_rate(&identity)?.rate,
            ))
        })
        .collect();

    let won = pairs
        .iter()
        .filter(|(ours, identity)| ours > identity)
        .count();

    (!pairs.is_empty()).then(|| Rate::of(won, pairs.len()))
}

/// R² over rooms: what the paper's scaling curves show (Sec. 5).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MotionSummary {
    /// Rooms whose overall R² is above 0.
    pub positive: Rate,
    /// Rooms whose overall R² is above 0.3.
    #[serde(rename = "above_0.3")]
    pub above_0_3: Rate,
    /// The largest overall R².
    pub best: f64,
    /// Mean of max(R², −1), our variant: it still separates bad from worse.
    #[serde(rename = "clipped_mean")]
    pub clipped: RoomMean,
    /// Mean of max(R², 0), the paper's.
    #[serde(rename = "clipped_mean_at_0")]
    pub clipped_at_zero: RoomMean,
}

impl MotionSummary {
    /// Summarizes one overall R² per room. Rooms with NaN are skipped; `None` when no room remains.
    pub fn of(r2: &[f64], seed: u64) -> Option<Self> {
        let known: Vec<f64> = r2.iter().copied().filter(|r2| !r2.is_nan()).collect();
        let above =
            |least: f64| Rate::of(known.iter().filter(|&&r2| r2 > least).count(), known.len());
        let clipped_at = |least: f64| {
            let clipped: Vec<f64> = known.iter().map(|r2| r2.max(least)).collect();
            bootstrap_mean(&clipped, seed)
        };

        (!known.is_empty()).then(|| Self {
            positive: above(0.0),
            above_0_3: above(0.3),
            best: known.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            clipped: clipped_at(CLIPPED_R2),
            clipped_at_zero: clipped_at(0.0),
        })
    }
}

/// The first `count` of `of` rooms in a seeded random order. With one seed, a smaller choice is a
/// subset of a larger one.
pub fn nested_choice(count: usize, of: usize, seed: u64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..of).collect();
    let mut random = ChaCha8Rng::seed_from_u64(seed);

    // Fisher–Yates shuffle of all rooms: the order must not depend on `count`.
    for place in 0..of.saturating_sub(1) {
        let other = random.random_range(place..of);
        order.swap(place, other);
    }

    order.truncate(count);
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: of three rooms one is won, one lost, one tied, and a tie is no win.
    #[test]
    fn a_win_is_strictly_more_hits_than_identity() {
        let retrieval = |hits: usize| seese3_core::eval::RetrievalScores {
            top1: Rate::of(0, 10),
            hits: vec![(0.1, Rate::of(hits, 10))],
            twist_error_mean: 0.0,
            twist_error_median: 0.0,
            translation_m_median: 0.0,
            rotation_rad_median: 0.0,
            pose_recalls: Vec::new(),
            pairs: Vec::new(),
        };

        let row = |name: &str, hits| Row {
            name: name.to_owned(),
            n: 10,
            latent: None,
            retrieval: retrieval(hits),
            hits_over_identity: Vec::new(),
            leaks: false,
        };

        let outcome = |ours, identity| RoomOutcome {
            room: RoomId::new("r").unwrap(),
            motion: MotionScores::of(&[], &[]),
            rows: vec![row("identity", identity), row("ours", ours)],
            candidate_count: 10,
            baselines: Baselines {
                constant_r2: 0.0,
                variance_ratio: 1.0,
                nearest_pose: None,
                optimizer_steps: 1,
            },
        };
        let won = wins(&[outcome(5, 4), outcome(3, 4), outcome(4, 4)], "ours").unwrap();

        assert_eq!((won.successes(), won.n), (1, 3));
        assert!(wins(&[outcome(5, 4)], "theirs").is_none());
    }

    /// Oracle: by hand.
    #[test]
    fn r2_of_rooms_is_clipped_and_counted() {
        let summary = MotionSummary::of(&[0.5, 0.1, -7.0, f64::NAN], 0).unwrap();
        assert_eq!((summary.positive.rate, summary.positive.n), (2.0 / 3.0, 3));
        assert_eq!((summary.above_0_3.rate, summary.best), (1.0 / 3.0, 0.5));
        assert!((summary.clipped.mean + 0.4 / 3.0).abs() < 1e-12);

        assert!(MotionSummary::of(&[f64::NAN], 0).is_none());
    }

    /// Oracle: the definition: no room twice, and the smaller choice within the larger one.
    #[test]
    fn smaller_choices_are_within_larger_ones() {
        let small = nested_choice(5, 100, 3);
        let large = nested_choice(50, 100, 3);
        assert_eq!(small, large[..5]);

        let distinct: std::collections::HashSet<_> = large.iter().collect();
        assert_eq!(distinct.len(), 50);
        assert_ne!(large, nested_choice(50, 100, 4));
    }
}

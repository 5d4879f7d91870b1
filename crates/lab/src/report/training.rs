//! Test scores of adapters trained with several seeds, for `seese3 train`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::json::{MotionJson, RateJson};
use super::table::aligned;
use crate::experiments::seeds::TrainingRun;
use seese3_core::adapter::{PairPlan, TrainingRecord};
use seese3_core::eval::LEAST_CONSTANT_R2;
use seese3_core::statistics::{deviation, mean};

/// Minimum number of test pairs for a meaningful score.
const FEWEST_TEST_PAIRS: usize = 10;

/// R² by part of the motion, one line per seed; with several seeds also their mean and sample
/// standard deviation.
pub fn training_table(runs: &[TrainingRun]) -> String {
    let head = [
        "seed",
        "overall",
        "transl.",
        "rotation",
        "direct.",
        "magnit.",
        "train R²",
        "R² of mean",
        "Hit@0.1",
        "s",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];

    // In the column order, from `overall` on.
    let numbers = |run: &TrainingRun| {
        let test = &run.record.test;
        let hit = run.hit_rate.rate;

        [
            test.overall,
            test.translation,
            test.rotation,
            test.direction,
            test.magnitude,
            run.record.train.overall,
            run.record.train_mean_r2,
            hit,
            run.seconds,
        ]
    };

    for run in runs {
        let mut cells = vec![run.record.config.seed.to_string()];
        cells.extend(numbers(run).into_iter().map(number_text));
        lines.push(cells);
    }

    // A single seed has no standard deviation.
    if runs.len() > 1 {
        for (label, of) in [("mean", mean as fn(&[f64]) -> f64), ("± sd", deviation)] {
            let mut cells = vec![label.to_owned()];
            cells.extend((0..9).map(|column| {
                let values: Vec<f64> = runs.iter().map(|run| numbers(run)[column]).collect();
                number_text(of(&values))
            }));

            lines.push(cells);
        }
    }

    aligned(&lines)
}

/// A warning about the table: the adapter is worse than the constant, or there are too few test
/// pairs. `None` if neither is the case.
pub fn training_remark(runs: &[TrainingRun]) -> Option<String> {
    let test_count = runs.first()?.record.test.n;
    if test_count == 0 {
        return None;
    }
    if test_count < FEWEST_TEST_PAIRS {
        return Some(format!(
            "{test_count} test pairs are too few to rate the adapter"
        ));
    }

    let mean_of = |value: fn(&TrainingRun) -> f64| -> f64 {
        mean(&runs.iter().map(value).collect::<Vec<f64>>())
    };
    let read = mean_of(|run| run.record.test.overall);
    let constant = mean_of(|run| run.record.train_mean_r2);
    if read >= constant {
        return None;
    }

    let verdict = if constant >= LEAST_CONSTANT_R2 {
        "the adapter does not generalize to them"
    } else {
        "the constant is so far below 0 that they cannot rate the adapter; try another --split"
    };
    Some(format!(
        "the mean training motion predicts these pairs better (R² {constant:.3} against {read:.3}): {verdict}"
    ))
}

/// Formats a score. An undefined score, as of a test without pairs, is a dash.
fn number_text(value: f64) -> String {
    if value.is_finite() {
        format!("{value:.3}")
    } else {
        "–".to_owned()
    }
}

/// The JSON record of `seese3 train`: one entry per seed, and the shared protocol.
#[derive(Debug, Serialize)]
pub struct TrainingJson {
    runs: Vec<RunJson>,
    adapter: PublishedJson,
    protocol: Option<ProtocolJson>,
}

#[derive(Debug, Serialize)]
struct RunJson {
    seed: u64,
    test: MotionJson,
    train: MotionJson,
    train_mean_r2: f64,
    /// Test scores by room, in the order of the protocol's rooms.
    rooms: Vec<MotionJson>,
    inverse_poincare_affine: HitsJson,
    seconds: f64,
}

#[derive(Debug, Serialize)]
struct HitsJson {
    /// Hit rates, keyed by ε as text.
    hit: BTreeMap<&'static str, RateJson>,
}

#[derive(Debug, Serialize)]
struct PublishedJson {
    name: String,
    revision: u64,
}

#[derive(Debug, Serialize)]
struct ProtocolJson {
    preset: String,
    split: &'static str,
    stride: u32,
    rooms: Vec<TrainedRoomJson>,
    training_pairs: usize,
    /// The shortest and the longest stride of training pairs sampled from a range.
    drawn_from_strides: Option<[u32; 2]>,
    epochs: usize,
    optimiser_steps: u64,
    batch: usize,
    learning_rate: f64,
    weight_decay: f64,
    clip_norm: f64,
    hidden: usize,
    latent: usize,
    charts: usize,
    mixing: &'static str,
    loss: &'static str,
    standardised_features: bool,
    noise: f64,
    weight_average: f64,
    through_zero: bool,
    calibrated_on: Vec<String>,
    twist: &'static str,
    /// Degrees of freedom of the σ that standardizes the training twists: 0, the population
    /// deviation. Deviations over seeds, elsewhere in these files, are sample deviations.
    deviation_ddof: u32,
}

#[derive(Debug, Serialize)]
struct TrainedRoomJson {
    room: String,
    revision: u64,
}

/// Builds the JSON record of a training: the runs of all seeds, and the published adapter.
pub fn training_json(runs: &[TrainingRun], adapter: &str, revision: u64) -> TrainingJson {
    TrainingJson {
        runs: runs.iter().map(run_json).collect(),
        adapter: PublishedJson {
            name: adapter.to_owned(),
            revision,
        },
        // The runs differ only in their seed, so the protocol of the first run holds for all.
        protocol: runs.first().map(|run| protocol_json(&run.record)),
    }
}

fn run_json(run: &TrainingRun) -> RunJson {
    RunJson {
        seed: run.record.config.seed,
        test: (&run.record.test).into(),
        train: (&run.record.train).into(),
        train_mean_r2: run.record.train_mean_r2,
        rooms: run.record.room_tests.iter().map(MotionJson::from).collect(),
        inverse_poincare_affine: HitsJson {
            hit: BTreeMap::from([("0.1", (&run.hit_rate).into())]),
        },
        seconds: run.seconds,
    }
}

fn protocol_json(record: &TrainingRecord) -> ProtocolJson {
    let config = &record.config;
    let rooms = record.rooms.iter().map(|(room, revision)| TrainedRoomJson {
        room: room.to_string(),
        revision: *revision,
    });
    let calibrated_on = record
        .calibrated_on
        .iter()
        .map(|(room, _)| room.to_string());

    ProtocolJson {
        preset: record.preset.clone(),
        split: record.split.name(),
        stride: record.stride,
        rooms: rooms.collect(),
        training_pairs: record.pair_count,
        drawn_from_strides: match &record.pairs {
            PairPlan::Stride(_) => None,
            PairPlan::Range(range) => Some([range.low, range.high]),
        },
        epochs: config.epochs,
        optimiser_steps: record.optimiser_steps(),
        batch: config.batch,
        learning_rate: config.learning_rate,
        weight_decay: config.weight_decay,
        clip_norm: config.clip_norm,
        hidden: config.hidden,
        latent: config.latent,
        charts: config.charts,
        mixing: config.mixing.name(),
        loss: config.loss.name(),
        standardised_features: config.standardise,
        noise: config.noise,
        weight_average: config.average,
        through_zero: config.through_zero,
        calibrated_on: calibrated_on.collect(),
        twist: "body frame, (v, omega), metres and radians",
        deviation_ddof: 0,
    }
}

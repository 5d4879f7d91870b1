//! Test scores of adapters trained with several seeds, for `seese3 train`.

use std::collections::BTreeMap;

use serde::ser::SerializeStruct;
use serde::{Serialize, Serializer};

use super::table::Table;
use crate::experiments::seeds::TrainingRun;
use crate::json::MotionJson;
use seese3_core::adapter::{PairPlan, TrainingRecord};
use seese3_core::eval::LEAST_CONSTANT_R2;
use seese3_core::statistics::{deviation, mean};

/// Minimum number of test pairs for a meaningful score.
const FEWEST_TEST_PAIRS: usize = 10;

/// R² by part of the motion, one line per seed; with several seeds also their mean and sample
/// standard deviation.
pub fn training_table(runs: &[TrainingRun]) -> Table {
    type Score = fn(&TrainingRun) -> f64;
    let columns: [(&str, Score); 9] = [
        ("overall", |run| run.record.test.overall),
        ("transl.", |run| run.record.test.translation),
        ("rotation", |run| run.record.test.rotation),
        ("direct.", |run| run.record.test.direction),
        ("magnit.", |run| run.record.test.magnitude),
        ("train R²", |run| run.record.train.overall),
        ("R² of mean", |run| run.record.train_mean_r2),
        ("Hit@0.1", |run| run.hit_rate.rate),
        ("s", |run| run.seconds),
    ];

    let titles = columns.map(|(title, _)| title).join(" | ");
    let mut table = Table::new(&format!("seed | {titles}"));
    for run in runs {
        let cells = columns.map(|(_, of)| number_text(of(run)));
        table.row(run.record.config.seed.to_string(), cells);
    }

    // A single seed has no standard deviation.
    if runs.len() > 1 {
        for (label, over) in [("mean", mean as fn(&[f64]) -> f64), ("± sd", deviation)] {
            let over_runs = |of| over(&runs.iter().map(of).collect::<Vec<f64>>());
            table.row(label, columns.map(|(_, of)| number_text(over_runs(of))));
        }
    }

    table
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
        "the mean training motion predicts these pairs better (R² {constant:.3} against {read:.3}):\n{verdict}"
    ))
}

/// How the gate of the first run mixes its charts, as text; `None` without a gate.
pub fn gating_text(runs: &[TrainingRun]) -> Option<String> {
    let gating = runs.first()?.gating.as_ref()?;
    let weights: Vec<String> = gating
        .mean_weights
        .iter()
        .map(|weight| format!("{weight:.2}"))
        .collect();
    Some(format!(
        "gate: temperature {:.2}, mean entropy of a frame's weights {:.2} (equal weights 1, one chart 0), mean weights {}",
        gating.temperature,
        gating.entropy,
        weights.join(", ")
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
pub struct TrainingJson<'a> {
    runs: Vec<RunJson<'a>>,
    adapter: PublishedJson<'a>,
    protocol: Option<ProtocolJson<'a>>,
}

#[derive(Debug, Serialize)]
struct PublishedJson<'a> {
    name: &'a str,
    revision: u64,
}

#[derive(Debug, Serialize)]
struct RoomJson<'a> {
    room: &'a str,
    revision: u64,
}

/// Builds the JSON record of a training: the runs of all seeds, and the published adapter.
pub fn training_json<'a>(
    runs: &'a [TrainingRun],
    adapter: &'a str,
    revision: u64,
) -> TrainingJson<'a> {
    TrainingJson {
        runs: runs.iter().map(RunJson).collect(),
        adapter: PublishedJson {
            name: adapter,
            revision,
        },
        // The runs differ only in their seed, so the protocol of the first run holds for all.
        protocol: runs.first().map(|run| ProtocolJson(&run.record)),
    }
}

#[derive(Debug)]
struct RunJson<'a>(&'a TrainingRun);

impl Serialize for RunJson<'_> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let TrainingRun {
            record: training,
            hit_rate,
            seconds,
            gating,
        } = self.0;
        let rooms: Vec<MotionJson> = training.room_tests.iter().map(MotionJson::from).collect();
        let hit = BTreeMap::from([("hit", BTreeMap::from([("0.1", hit_rate)]))]);

        let mut record = to.serialize_struct("Run", 8)?;
        record.serialize_field("seed", &training.config.seed)?;
        record.serialize_field("test", &MotionJson::from(&training.test))?;
        record.serialize_field("train", &MotionJson::from(&training.train))?;
        record.serialize_field("train_mean_r2", &training.train_mean_r2)?;
        // Test scores by room, in the order of the protocol's rooms.
        record.serialize_field("rooms", &rooms)?;
        record.serialize_field("inverse_poincare_affine", &hit)?;
        record.serialize_field("seconds", seconds)?;
        record.serialize_field("gating", gating)?;
        record.end()
    }
}

#[derive(Debug)]
struct ProtocolJson<'a>(&'a TrainingRecord);

impl Serialize for ProtocolJson<'_> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let training = self.0;
        let config = &training.config;

        let rooms = training.rooms.iter().map(|(room, revision)| RoomJson {
            room: room.as_str(),
            revision: *revision,
        });
        let calibrated_on = training.calibrated_on.iter().map(|(room, _)| room.as_str());

        // The shortest and the longest stride of training pairs sampled from a range.
        let drawn_from_strides = match &training.pairs {
            PairPlan::Stride(_) => None,
            PairPlan::Range(range) => Some([range.low, range.high]),
        };

        let mut record = to.serialize_struct("Protocol", 24)?;
        record.serialize_field("preset", &training.preset)?;
        record.serialize_field("split", training.split.name())?;
        record.serialize_field("stride", &training.stride)?;
        record.serialize_field("rooms", &rooms.collect::<Vec<_>>())?;
        record.serialize_field("training_pairs", &training.pair_count)?;
        record.serialize_field("drawn_from_strides", &drawn_from_strides)?;
        record.serialize_field("epochs", &config.epochs)?;
        record.serialize_field("optimizer_steps", &training.optimizer_steps())?;
        record.serialize_field("batch", &config.batch)?;
        record.serialize_field("learning_rate", &config.learning_rate)?;
        record.serialize_field("weight_decay", &config.weight_decay)?;
        record.serialize_field("clip_norm", &config.clip_norm)?;
        record.serialize_field("hidden", &config.hidden)?;
        record.serialize_field("latent", &config.latent)?;
        record.serialize_field("charts", &config.charts)?;
        record.serialize_field("mixing", config.mixing.name())?;
        record.serialize_field("loss", config.loss.name())?;
        record.serialize_field("standardized_features", &config.standardize)?;
        record.serialize_field("noise", &config.noise)?;
        record.serialize_field("weight_average", &config.average)?;
        record.serialize_field("through_zero", &config.through_zero)?;
        record.serialize_field("calibrated_on", &calibrated_on.collect::<Vec<_>>())?;
        record.serialize_field("twist", "body frame, (v, omega), meters and radians")?;
        // Degrees of freedom of the σ that standardizes the training twists: 0, the population
        // deviation. Deviations over seeds, elsewhere in these files, are sample deviations.
        record.serialize_field("deviation_ddof", &0)?;
        record.end()
    }
}

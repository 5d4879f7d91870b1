//! Results as JSON, for other programs. Keys are stable; a value that is undefined is null.

use serde_json::{Map, Value, json};

use crate::experiments::seeds::TrainingRun;
use seese3_core::adapter::{PairPlan, TrainingRecord};
use seese3_core::eval::{Report, RetrievalScores, Row};
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{Rate, deviation, mean};

/// The record of `seese3 train`: one entry per seed, and the protocol that they share.
pub fn training_json(runs: &[TrainingRun], adapter: &str, revision: u64) -> Value {
    // The runs differ in their seed alone, so that the protocol of the first one holds for all.
    let protocol = runs
        .first()
        .map_or(Value::Null, |run| protocol_json(&run.record));

    let runs: Vec<Value> = runs.iter().map(run_json).collect();
    json!({ "runs": runs, "adapter": { "name": adapter, "revision": revision }, "protocol": protocol })
}

fn run_json(run: &TrainingRun) -> Value {
    json!({
        "seed": run.record.config.seed,
        "test": motion_json(&run.record.test),
        "train": motion_json(&run.record.train),
        "train_mean_r2": run.record.train_mean_r2,
        "rooms": run.record.room_tests.iter().map(motion_json).collect::<Vec<_>>(),
        "inverse_poincare_affine": { "hit": { "0.1": rate_json(&run.hit_rate) } },
        "seconds": run.seconds,
    })
}

/// R² by part of the motion: mean and sample standard deviation over the runs in which it is
/// defined.
pub(super) fn parts_json(runs: &[MotionScores]) -> Value {
    let part = |figure: fn(&MotionScores) -> f64| {
        let values: Vec<f64> = runs
            .iter()
            .map(figure)
            .filter(|value| !value.is_nan())
            .collect();
        json!({ "mean": mean(&values), "sd": deviation(&values) })
    };

    json!({
        "overall": part(|run| run.overall),
        "translation": part(|run| run.translation),
        "rotation": part(|run| run.rotation),
        "direction": part(|run| run.direction),
        "magnitude": part(|run| run.magnitude),
    })
}

/// R² by component and part.
pub(super) fn motion_json(scores: &MotionScores) -> Value {
    json!({
        "n": scores.n,
        "r2": {
            "components": scores.components,
            "overall": scores.overall,
            "translation": scores.translation,
            "rotation": scores.rotation,
            "direction": scores.direction,
            "magnitude": scores.magnitude,
        },
        "direction_pairs_dropped": scores.direction_pairs_dropped,
    })
}

fn protocol_json(record: &TrainingRecord) -> Value {
    let rooms: Vec<Value> = record
        .rooms
        .iter()
        .map(|(room, revision)| json!({ "room": room.as_str(), "revision": revision }))
        .collect();

    let calibrated_on: Vec<&str> = record
        .calibrated_on
        .iter()
        .map(|(room, _)| room.as_str())
        .collect();

    // Training pairs have one stride or are drawn from a range of strides; only a range stands
    // here.
    let range = match &record.pairs {
        PairPlan::Stride(_) => Value::Null,
        PairPlan::Range(range) => json!([range.low, range.high]),
    };

    // `deviation_ddof` is that of the σ which standardises the training twists: the
    // population deviation. Deviations over seeds, elsewhere in these files, are sample
    // deviations.
    json!({
        "preset": record.preset,
        "split": record.split.name(),
        "stride": record.stride,
        "rooms": rooms,
        "training_pairs": record.pair_count,
        "drawn_from_strides": range,
        "epochs": record.config.epochs,
        "batch": record.config.batch,
        "learning_rate": record.config.learning_rate,
        "weight_decay": record.config.weight_decay,
        "clip_norm": record.config.clip_norm,
        "hidden": record.config.hidden,
        "latent": record.config.latent,
        "charts": record.config.charts,
        "mixing": record.config.mixing.name(),
        "loss": record.config.loss.name(),
        "standardised_features": record.config.standardise,
        "noise": record.config.noise,
        "weight_average": record.config.average,
        "through_zero": record.config.through_zero,
        "calibrated_on": calibrated_on,
        "twist": "body frame, (v, omega), metres and radians",
        "deviation_ddof": 0,
    })
}

/// The record of `seese3 evaluate`. The entries of `context` (room, features and adapter) are
/// merged into the protocol.
pub fn evaluation_json(report: &Report, context: Map<String, Value>) -> Value {
    let mut protocol = Map::new();
    protocol.insert("split".to_owned(), json!(report.protocol.split.name()));
    protocol.insert("stride".to_owned(), json!(report.protocol.stride));
    protocol.insert("n".to_owned(), json!(report.n));

    protocol.insert("candidates".to_owned(), json!(report.candidate_count));

    protocol.insert(
        "source_excluded".to_owned(),
        json!(report.protocol.exclude_source.is_some()),
    );

    protocol.insert("thresholds".to_owned(), json!(report.protocol.thresholds));
    protocol.insert("seed".to_owned(), json!(report.protocol.seed));
    protocol.insert("steps".to_owned(), json!(report.protocol.steps));
    protocol.insert("mode".to_owned(), json!(report.protocol.mode.name()));

    protocol.insert("index".to_owned(), json!("exact"));
    protocol.extend(context);
    let rows: Vec<Value> = report.rows.iter().map(row_json).collect();

    json!({ "navigators": rows, "protocol": protocol })
}

fn row_json(row: &Row) -> Value {
    let mut object = Map::new();
    object.insert("name".to_owned(), json!(row.name));
    object.insert("n".to_owned(), json!(row.n));
    object.insert("mse".to_owned(), json!(row.latent.map(|latent| latent.mse)));

    object.insert("r2".to_owned(), json!(row.latent.map(|latent| latent.r2)));

    object.insert(
        "r2_uniform".to_owned(),
        json!(row.latent.map(|latent| latent.r2_uniform)),
    );

    // Retrieval scores are keys of the row itself, beside those of the latents.
    if let Value::Object(retrieval) = retrieval_json(&row.retrieval) {
        object.extend(retrieval);
    }

    Value::Object(object)
}

fn retrieval_json(scores: &RetrievalScores) -> Value {
    let hits: Map<String, Value> = scores
        .hits
        .iter()
        .map(|(epsilon, rate)| (epsilon.to_string(), rate_json(rate)))
        .collect();

    let recalls: Vec<Value> = scores
        .pose_recalls
        .iter()
        .map(|recall| {
            json!({
                "translation_m": recall.translation_m,
                "rotation_deg": recall.rotation_deg,
                "rate": recall.rate.rate, "low": recall.rate.low, "high": recall.rate.high,
            })
        })
        .collect();

    json!({
        "top1": scores.top1.rate,
        "top1_interval": rate_json(&scores.top1),
        "hit": hits,
        "twist_error": { "mean": scores.twist_error_mean, "median": scores.twist_error_median },
        "median_translation_m": scores.translation_m_median,
        "median_rotation_deg": scores.rotation_rad_median.to_degrees(),
        "recall": recalls,
    })
}

pub(super) fn rate_json(rate: &Rate) -> Value {
    json!({ "rate": rate.rate, "low": rate.low, "high": rate.high })
}

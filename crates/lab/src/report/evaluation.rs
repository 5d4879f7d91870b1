//! Scores of navigators on the pairs of one room, for `seese3 evaluate`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::json::{BaselinesJson, MotionJson, RateJson};
use super::table::aligned;
use seese3_core::eval::{Baselines, PoseRecall, Report, RetrievalScores, Row};
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::Rate;

/// Two tables with one line per navigator. The first has latent scores and Hit@ε with 95 %
/// intervals; the second has median pose errors and joint recalls.
pub fn evaluation_table(report: &Report) -> String {
    let mut head: Vec<String> = ["navigator", "n", "MSE", "R²", "Top-1"]
        .map(str::to_owned)
        .to_vec();

    head.extend(
        report
            .protocol
            .thresholds
            .iter()
            .map(|epsilon| format!("Hit@{epsilon} [95 %]")),
    );

    let mut lines = vec![head];
    lines.extend(report.rows.iter().map(hit_cells));

    let mut second = vec![
        [
            "navigator",
            "median m",
            "median °",
            "5 cm 5°",
            "10 cm 5°",
            "50 cm 5°",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];

    second.extend(report.rows.iter().map(pose_cells));
    format!("{}\n{}", aligned(&lines), aligned(&second))
}

fn hit_cells(row: &Row) -> Vec<String> {
    let latent = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
    let mut cells = vec![
        row.name.clone(),
        row.n.to_string(),
        latent(row.latent.map(|latent| latent.mse)),
        latent(row.latent.map(|latent| latent.r2)),
        format!("{:.3}", row.retrieval.top1.rate),
    ];

    cells.extend(row.retrieval.hits.iter().map(|(_, rate)| interval(rate)));
    cells
}

fn pose_cells(row: &Row) -> Vec<String> {
    let mut cells = vec![
        row.name.clone(),
        format!("{:.3}", row.retrieval.translation_m_median),
        format!("{:.2}", row.retrieval.rotation_rad_median.to_degrees()),
    ];

    // The protocol may contain more recalls; the table shows only these three.
    let shown = [(0.05, 5.0), (0.1, 5.0), (0.5, 5.0)];
    for recall in &row.retrieval.pose_recalls {
        if shown.contains(&(recall.translation_m, recall.rotation_deg)) {
            cells.push(format!("{:.3}", recall.rate.rate));
        }
    }

    cells
}

fn interval(rate: &Rate) -> String {
    format!("{:.3} [{:.3}, {:.3}]", rate.rate, rate.low, rate.high)
}

/// What was evaluated. It is flattened into `protocol` of the JSON record.
#[derive(Debug, Clone, Serialize)]
pub struct EvaluationContext {
    /// The room.
    pub room: RoomJson,
    /// The name of the features.
    pub features: String,
    /// The adapter, and how it was trained.
    pub adapter: AdapterJson,
    /// Whether the adapter was trained in this room.
    pub in_room: bool,
    /// Whether test frames were in the adapter's training data.
    pub leaks: bool,
}

/// A room of the store.
#[derive(Debug, Clone, Serialize)]
pub struct RoomJson {
    /// Its name.
    pub name: String,
    /// Its revision.
    pub revision: u64,
}

/// An adapter of the store.
#[derive(Debug, Clone, Serialize)]
pub struct AdapterJson {
    /// Its name.
    pub name: String,
    /// Its revision.
    pub revision: u64,
    /// The preset of its training.
    pub preset: String,
    /// The train/test split of its training.
    pub trained_split: &'static str,
    /// Stride of the test pairs of its training, frames.
    pub trained_stride: u32,
    /// The seed of its training.
    pub seed: u64,
}

/// R² of the adapter's motions on the test pairs, with the baselines.
#[derive(Debug, Clone, Copy)]
pub struct MotionBaselines {
    /// R² of the adapter's motions.
    pub motion: MotionScores,
    /// The baselines, with the extent of the training data.
    pub baselines: Baselines,
}

/// The adapter's and the constant's R² of motions, as one line of text.
pub fn baselines_text(found: &MotionBaselines) -> String {
    let Baselines {
        constant_r2,
        variance_ratio,
        nearest_pose,
        optimiser_steps,
    } = found.baselines;

    let nearest = nearest_pose.map_or_else(String::new, |nearest| {
        format!(
            ", nearest training pose {:.2} m and {:.0}°",
            nearest.translation_m,
            nearest.rotation_rad.to_degrees()
        )
    });
    let verdict = if found.baselines.can_tell() {
        ""
    } else {
        "; the constant is so far below 0 that these pairs cannot rate the adapter"
    };

    format!(
        "R² of motions {:.3}; of the mean training motion {constant_r2:.3} (variance ratio of test to training \
         motions {variance_ratio:.2}{nearest}; {optimiser_steps} optimizer steps){verdict}",
        found.motion.overall
    )
}

/// The JSON record of `seese3 evaluate`.
#[derive(Debug, Serialize)]
pub struct EvaluationJson {
    motion: MotionJson,
    baselines: BaselinesJson,
    navigators: Vec<NavigatorJson>,
    protocol: ProtocolJson,
}

#[derive(Debug, Serialize)]
struct ProtocolJson {
    split: &'static str,
    stride: u32,
    n: usize,
    candidates: usize,
    source_excluded: bool,
    thresholds: Vec<f64>,
    seed: u64,
    steps: u32,
    mode: &'static str,
    index: &'static str,
    #[serde(flatten)]
    context: EvaluationContext,
}

#[derive(Debug, Serialize)]
struct NavigatorJson {
    name: String,
    n: usize,
    /// Scores of the predicted latent; null for a navigator that does not predict one.
    mse: Option<f64>,
    r2: Option<f64>,
    r2_uniform: Option<f64>,
    #[serde(flatten)]
    retrieval: RetrievalJson,
}

#[derive(Debug, Serialize)]
struct RetrievalJson {
    top1: f64,
    top1_interval: RateJson,
    /// Hit rates, keyed by ε as text.
    hit: BTreeMap<String, RateJson>,
    twist_error: TwistErrorJson,
    median_translation_m: f64,
    median_rotation_deg: f64,
    recall: Vec<RecallJson>,
}

#[derive(Debug, Serialize)]
struct TwistErrorJson {
    mean: f64,
    median: f64,
}

#[derive(Debug, Serialize)]
struct RecallJson {
    translation_m: f64,
    rotation_deg: f64,
    #[serde(flatten)]
    rate: RateJson,
}

/// Builds the JSON record of an evaluation.
pub fn evaluation_json(
    report: &Report,
    motion: &MotionBaselines,
    context: EvaluationContext,
) -> EvaluationJson {
    let protocol = &report.protocol;

    EvaluationJson {
        motion: (&motion.motion).into(),
        baselines: (&motion.baselines).into(),
        navigators: report.rows.iter().map(navigator_json).collect(),
        protocol: ProtocolJson {
            split: protocol.split.name(),
            stride: protocol.stride,
            n: report.n,
            candidates: report.candidate_count,
            source_excluded: protocol.exclude_source.is_some(),
            thresholds: protocol.thresholds.clone(),
            seed: protocol.seed,
            steps: protocol.steps,
            mode: protocol.mode.name(),
            index: "exact",
            context,
        },
    }
}

fn navigator_json(row: &Row) -> NavigatorJson {
    NavigatorJson {
        name: row.name.clone(),
        n: row.n,
        mse: row.latent.map(|latent| latent.mse),
        r2: row.latent.map(|latent| latent.r2),
        r2_uniform: row.latent.map(|latent| latent.r2_uniform),
        retrieval: retrieval_json(&row.retrieval),
    }
}

fn retrieval_json(scores: &RetrievalScores) -> RetrievalJson {
    let recall = |recall: &PoseRecall| RecallJson {
        translation_m: recall.translation_m,
        rotation_deg: recall.rotation_deg,
        rate: (&recall.rate).into(),
    };

    RetrievalJson {
        top1: scores.top1.rate,
        top1_interval: (&scores.top1).into(),
        hit: scores
            .hits
            .iter()
            .map(|(epsilon, rate)| (epsilon.to_string(), rate.into()))
            .collect(),
        twist_error: TwistErrorJson {
            mean: scores.twist_error_mean,
            median: scores.twist_error_median,
        },
        median_translation_m: scores.translation_m_median,
        median_rotation_deg: scores.rotation_rad_median.to_degrees(),
        recall: scores.pose_recalls.iter().map(recall).collect(),
    }
}

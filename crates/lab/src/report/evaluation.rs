//! Scores of navigators on the pairs of one room, for `seese3 evaluate`.

use std::collections::BTreeMap;

use serde::ser::SerializeStruct;
use serde::{Serialize, Serializer};
use serde_json::json;

use super::table::Table;
use crate::json::{BaselinesJson, MotionJson, shaped};
use seese3_core::eval::{Baselines, Report, RetrievalScores, Row};
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{MeanInterval, Rate};

/// Two tables with one line per navigator. The first has latent scores and Hit@ε with 95 %
/// intervals over blocks of the recording; the second has the difference to Identity, median pose
/// errors and joint recalls.
pub fn evaluation_table(report: &Report) -> String {
    let [scores, poses] = evaluation_tables(report);
    format!("{scores}\n\n{poses}")
}

/// The tables of an evaluation as Markdown.
pub fn evaluation_markdown(report: &Report) -> String {
    let tables = evaluation_tables(report);
    tables.map(|table| table.markdown()).join("\n")
}

/// The table of scores of navigators, and that of the errors of retrieved poses.
fn evaluation_tables(report: &Report) -> [Table; 2] {
    let thresholds = report.protocol.thresholds.iter();
    let hits: String = thresholds
        .map(|epsilon| format!(" | Hit@{epsilon} [95 %]"))
        .collect();
    let mut scores = Table::new(&format!(
        "navigator | n | latent MSE | latent R² | Top-1{hits}"
    ));

    for row in &report.rows {
        let latent =
            |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        let cells = [
            row.n.to_string(),
            latent(row.latent.map(|latent| latent.mse)),
            latent(row.latent.map(|latent| latent.r2)),
            format!("{:.3}", row.retrieval.top1.rate),
        ];
        let hits = row.retrieval.hits.iter().map(|(_, rate)| interval(rate));
        scores.row(row.label(), cells.into_iter().chain(hits));
    }

    let least = report.protocol.thresholds.first().copied();
    let over = least.map_or(String::new(), |epsilon| {
        format!("Hit@{epsilon} over Identity [95 %] | ")
    });
    let mut poses = Table::new(&format!(
        "navigator | {over}median m | median ° | 5 cm 5° | 10 cm 5° | 50 cm 5°"
    ));
    for row in &report.rows {
        let over = least.map(|_| match row.hits_over_identity.first() {
            Some((_, MeanInterval { mean, low, high })) => {
                format!("{mean:+.3} [{low:+.3}, {high:+.3}]")
            }
            None => "–".to_owned(),
        });
        let RetrievalScores {
            translation_m_median,
            rotation_rad_median,
            pose_recalls,
            ..
        } = &row.retrieval;
        let medians = [
            format!("{translation_m_median:.3}"),
            format!("{:.2}", rotation_rad_median.to_degrees()),
        ];

        // The protocol may contain more recalls; the table shows only these three.
        let shown = [(0.05, 5.0), (0.1, 5.0), (0.5, 5.0)];
        let recalls = pose_recalls
            .iter()
            .filter(|recall| shown.contains(&(recall.translation_m, recall.rotation_deg)))
            .map(|recall| format!("{:.3}", recall.rate.rate));
        let cells = over.into_iter().chain(medians).chain(recalls);
        poses.row(row.label(), cells);
    }

    [scores, poses]
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
#[derive(Debug, Clone, Copy, Serialize)]
pub struct MotionBaselines {
    /// R² of the adapter's motions.
    #[serde(serialize_with = "shaped::<MotionJson, _, _>")]
    pub motion: MotionScores,
    /// The baselines, with the extent of the training data.
    #[serde(serialize_with = "shaped::<BaselinesJson, _, _>")]
    pub baselines: Baselines,
}

/// The adapter's and the constant's R² of motions, as text.
pub fn baselines_text(found: &MotionBaselines) -> String {
    let Baselines {
        constant_r2,
        variance_ratio,
        nearest_pose,
        optimizer_steps,
    } = found.baselines;

    let nearest = nearest_pose.map_or_else(String::new, |nearest| {
        format!(
            ", nearest training pose {:.2} m and {:.0}°",
            nearest.translation_m,
            nearest.rotation_rad.to_degrees()
        )
    });
    let verdict = if constant_r2.is_nan() {
        "\nthese pairs are too few for an R², which divides by the variance of their motions"
    } else if found.baselines.can_tell() {
        ""
    } else {
        "\nthe constant is so far below 0 that these pairs cannot rate the adapter"
    };

    format!(
        "R² of the motions that W and φ predict {:.3}; of the mean training motion {constant_r2:.3}\n\
         (variance ratio of test to training motions {variance_ratio:.2}{nearest}; \
         {optimizer_steps} optimizer steps){verdict}",
        found.motion.overall
    )
}

/// The JSON record of `seese3 evaluate`.
#[derive(Debug, Serialize)]
pub struct EvaluationJson<'a> {
    #[serde(flatten)]
    motion: MotionBaselines,
    navigators: Vec<NavigatorJson<'a>>,
    protocol: ProtocolJson<'a>,
}

#[derive(Debug, Serialize)]
struct ProtocolJson<'a> {
    split: &'static str,
    stride: u32,
    n: usize,
    candidates: usize,
    source_excluded: bool,
    thresholds: &'a [f64],
    seed: u64,
    steps: u32,
    mode: &'static str,
    shortlist: usize,
    index: &'static str,
    #[serde(flatten)]
    context: EvaluationContext,
}

/// Builds the JSON record of an evaluation.
pub fn evaluation_json<'a>(
    report: &'a Report,
    motion: &MotionBaselines,
    context: EvaluationContext,
) -> EvaluationJson<'a> {
    let protocol = &report.protocol;

    EvaluationJson {
        motion: *motion,
        navigators: report.rows.iter().map(NavigatorJson).collect(),
        protocol: ProtocolJson {
            split: protocol.split.name(),
            stride: protocol.stride,
            n: report.n,
            candidates: report.candidate_count,
            source_excluded: protocol.exclude_source.is_some(),
            thresholds: &protocol.thresholds,
            seed: protocol.seed,
            steps: protocol.steps,
            mode: protocol.mode.name(),
            shortlist: protocol.shortlist,
            index: "exact",
            context,
        },
    }
}

/// A navigator's scores.
#[derive(Debug)]
struct NavigatorJson<'a>(&'a Row);

impl Serialize for NavigatorJson<'_> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let Row {
            name,
            n,
            latent,
            retrieval,
            hits_over_identity,
            leaks,
        } = self.0;

        // Hit rates are keyed by ε as text.
        let hits = retrieval.hits.iter();
        let hits: BTreeMap<String, Rate> = hits
            .map(|(epsilon, rate)| (epsilon.to_string(), *rate))
            .collect();
        let over_identity: BTreeMap<String, MeanInterval> = hits_over_identity
            .iter()
            .map(|(epsilon, difference)| (epsilon.to_string(), *difference))
            .collect();
        let twist_error = json!({
            "mean": retrieval.twist_error_mean,
            "median": retrieval.twist_error_median,
        });
        let rotation_deg = retrieval.rotation_rad_median.to_degrees();

        // Scores of the predicted latent are null for a navigator that does not predict one.
        let mut record = to.serialize_struct("Navigator", 14)?;
        record.serialize_field("name", name)?;
        record.serialize_field("leaks", leaks)?;
        record.serialize_field("n", n)?;
        record.serialize_field("latent_mse", &latent.map(|latent| latent.mse))?;
        record.serialize_field("latent_r2", &latent.map(|latent| latent.r2))?;
        record.serialize_field("latent_r2_uniform", &latent.map(|latent| latent.r2_uniform))?;
        record.serialize_field("top1", &retrieval.top1.rate)?;
        record.serialize_field("top1_interval", &retrieval.top1)?;
        record.serialize_field("hit", &hits)?;
        record.serialize_field("hit_over_identity", &over_identity)?;
        record.serialize_field("twist_error", &twist_error)?;
        record.serialize_field("median_translation_m", &retrieval.translation_m_median)?;
        record.serialize_field("median_rotation_deg", &rotation_deg)?;
        record.serialize_field("recall", &retrieval.pose_recalls)?;
        record.end()
    }
}

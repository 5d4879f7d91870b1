//! Probe metrics M1 to M4 of features in rooms, for `seese3 probe`.

use serde::Serialize;

use super::json::{BaselinesJson, MotionJson, PartsJson};
use super::table::aligned;
use crate::experiments::probe::{
    AtStride, DimensionProtocol, DimensionScore, MutualKnnScore, ProbeScores,
};
use crate::probes::{Counted, Duplicates, Limit, Mle, MutualKnn};
use seese3_core::eval::Baselines;
use seese3_core::motion_scores::MotionScores;
use seese3_core::splits::Split;
use seese3_core::statistics::{deviation, mean_of_known};

/// The JSON record of `seese3 probe`.
#[derive(Debug, Serialize)]
pub struct ProbeJson {
    #[serde(flatten)]
    rooms: RoomsJson,
    features: String,
    split: &'static str,
    preset: &'static str,
    /// Why a room or a metric has no scores, in words.
    skipped: Vec<String>,
}

/// The scores of one room are top-level keys of the file; those of several rooms are a list.
#[derive(Debug, Serialize)]
#[serde(untagged)]
enum RoomsJson {
    One(Box<RoomJson>),
    Several { rooms: Vec<RoomJson> },
}

/// The scores of one room; metrics that were not requested are absent.
#[derive(Debug, Serialize)]
struct RoomJson {
    room: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    m1: Option<M1Json>,
    #[serde(skip_serializing_if = "Option::is_none")]
    m2: Option<M2Json>,
    #[serde(skip_serializing_if = "Option::is_none")]
    m3: Option<StridesJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    m4: Option<StridesJson>,
}

#[derive(Debug, Serialize)]
struct M1Json {
    value: f64,
    frames: usize,
    stride: usize,
    k: usize,
    exclusion: usize,
    exclusion_counts: &'static str,
    exclusion_is: &'static str,
}

#[derive(Debug, Serialize)]
struct M2Json {
    twonn: f64,
    mle: f64,
    twonn_censored: f64,
    twonn_likelihood: f64,
    mle_biased: MleJson,
    mle_unbiased: MleJson,
    gap: usize,
    duplicates: &'static str,
    used_rows: usize,
    dropped_rows: usize,
}

/// A maximum-likelihood dimension, by averaging method of the local estimates.
#[derive(Debug, Serialize)]
struct MleJson {
    harmonic: f64,
    mean: f64,
    median: f64,
}

/// The scores of the first stride are repeated at the top, so that a client with one stride can
/// ignore `strides`.
#[derive(Debug, Serialize)]
struct StridesJson {
    #[serde(flatten)]
    first: StrideJson,
    strides: Vec<StrideJson>,
}

#[derive(Debug, Clone, Serialize)]
struct StrideJson {
    stride: u32,
    r2: f64,
    /// Standard deviations over seeds; absent for a single run.
    #[serde(flatten)]
    spread: Option<SeedSpreadJson>,
    n: usize,
    /// One entry per seed, over the test pairs of all splits together.
    runs: Vec<MotionJson>,
    baselines: Option<BaselinesJson>,
    /// One entry per split: a single split, or five folds.
    splits: Vec<SplitJson>,
}

/// The scores and baselines under one split.
#[derive(Debug, Clone, Serialize)]
struct SplitJson {
    split: &'static str,
    /// Mean over seeds.
    r2: f64,
    baselines: Option<BaselinesJson>,
}

#[derive(Debug, Clone, Serialize)]
struct SeedSpreadJson {
    sd: f64,
    by_part: PartsJson,
}

/// The settings of a probe, and what was skipped.
#[derive(Debug, Clone)]
pub struct ProbeContext {
    /// The name of the features.
    pub features: String,
    /// The train/test split.
    pub split: &'static str,
    /// The preset of M4.
    pub preset: &'static str,
    /// Why a room or a metric has no scores, in words.
    pub skipped: Vec<String>,
}

/// Builds the JSON record of a probe.
pub fn probe_json(scores: &[ProbeScores], context: ProbeContext) -> ProbeJson {
    let rooms = match scores {
        [only] => RoomsJson::One(Box::new(room_json(only))),
        several => RoomsJson::Several {
            rooms: several.iter().map(room_json).collect(),
        },
    };

    ProbeJson {
        rooms,
        features: context.features,
        split: context.split,
        preset: context.preset,
        skipped: context.skipped,
    }
}

fn room_json(scores: &ProbeScores) -> RoomJson {
    RoomJson {
        room: scores.room.clone(),
        m1: scores.m1.as_ref().map(m1_json),
        m2: scores.m2.as_ref().map(m2_json),
        m3: strides_json(&scores.m3),
        m4: strides_json(&scores.m4),
    }
}

fn m1_json(score: &MutualKnnScore) -> M1Json {
    let MutualKnn {
        frames,
        stride,
        k,
        exclusion,
        counted,
        limit,
    } = score.options;

    M1Json {
        value: score.share,
        frames,
        stride,
        k,
        exclusion,
        exclusion_counts: match counted {
            Counted::Sampled => "sampled frames",
            Counted::Native => "room frames",
        },
        exclusion_is: match limit {
            Limit::Inclusive => "inclusive",
            Limit::Exclusive => "exclusive",
        },
    }
}

fn m2_json(score: &DimensionScore) -> M2Json {
    let dimension = &score.dimension;
    let DimensionProtocol { gap, duplicates } = score.protocol;

    let mle = |mle: &Mle| MleJson {
        harmonic: mle.harmonic,
        mean: mle.mean,
        median: mle.median,
    };

    M2Json {
        twonn: dimension.two_nn.linear,
        mle: dimension.mle_biased.harmonic,
        twonn_censored: dimension.two_nn.censored,
        twonn_likelihood: dimension.two_nn.likelihood,
        mle_biased: mle(&dimension.mle_biased),
        mle_unbiased: mle(&dimension.mle_unbiased),
        gap,
        duplicates: match duplicates {
            Duplicates::DropRows => "dropped",
            Duplicates::KeepFirst => "first kept",
        },
        used_rows: dimension.used,
        dropped_rows: dimension.dropped,
    }
}

fn strides_json(strides: &[AtStride]) -> Option<StridesJson> {
    let strides: Vec<StrideJson> = strides.iter().map(stride_json).collect();
    let first = strides.first()?.clone();

    Some(StridesJson { first, strides })
}

fn stride_json(at: &AtStride) -> StrideJson {
    let overall: Vec<f64> = at.runs.iter().map(|run| run.overall).collect();
    let spread = (at.runs.len() > 1).then(|| SeedSpreadJson {
        sd: deviation(&overall),
        by_part: PartsJson::of(&at.runs),
    });

    StrideJson {
        stride: at.stride,
        r2: mean_of_known(&overall),
        spread,
        n: at.runs.first().map_or(0, |run| run.n),
        runs: at.runs.iter().map(MotionJson::from).collect(),
        baselines: at
            .baselines
            .as_ref()
            .map(|baselines| (&baselines.together).into()),
        splits: split_jsons(at),
    }
}

fn split_jsons(at: &AtStride) -> Vec<SplitJson> {
    let of = |(place, &(split, r2)): (usize, &(Split, f64))| SplitJson {
        split: split.name(),
        r2,
        baselines: at
            .baselines
            .as_ref()
            .map(|baselines| (&baselines.by_split[place]).into()),
    };
    at.by_split.iter().enumerate().map(of).collect()
}

/// One line per room and metric, for M3 and M4 per stride.
pub fn probe_table(scores: &[ProbeScores]) -> String {
    let head = [
        "room", "metric", "value", "sd", "transl.", "rotation", "direct.", "magnit.", "n",
        "constant", "nearest",
    ];
    let mut lines = vec![head.map(str::to_owned).to_vec()];

    for score in scores {
        let mut line = |metric: String, values: &[String]| {
            lines.push(
                [score.room.clone(), metric]
                    .into_iter()
                    .chain(values.iter().cloned())
                    .collect(),
            );
        };

        if let Some(MutualKnnScore { share, options }) = &score.m1 {
            // M1 has only a value and a frame count: empty cells keep the count in column `n`.
            let absent = || "".to_owned();
            let cells = [
                format!("{share:.3}"),
                absent(),
                absent(),
                absent(),
                absent(),
                absent(),
            ];

            line(
                "M1".to_owned(),
                &[cells.as_slice(), &[options.frames.to_string()]].concat(),
            );
        }

        if let Some(DimensionScore { dimension, .. }) = &score.m2 {
            line(
                "M2 TwoNN".to_owned(),
                &[format!("{:.3}", dimension.two_nn.linear)],
            );

            line(
                "M2 MLE".to_owned(),
                &[format!("{:.3}", dimension.mle_biased.harmonic)],
            );
        }

        for (name, strides) in [("M3", &score.m3), ("M4", &score.m4)] {
            for at in strides.iter() {
                line(format!("{name} s{}", at.stride), &stride_cells(at));

                // Show each fold: the joint score hides differences between folds.
                if at.by_split.len() > 1 {
                    for (place, (split, r2)) in at.by_split.iter().enumerate() {
                        let mut cells = vec![format!("{r2:.3}")];
                        cells.resize(7, String::new());
                        let baselines = at.baselines.as_ref();
                        cells.extend(baseline_cells(baselines.map(|all| &all.by_split[place])));
                        line(format!("{name} s{} {split}", at.stride), &cells);
                    }
                }
            }
        }
    }

    aligned(&lines)
}

fn stride_cells(at: &AtStride) -> Vec<String> {
    let column = |figure: fn(&MotionScores) -> f64| at.runs.iter().map(figure).collect::<Vec<_>>();
    let overall = column(|run| run.overall);
    let spread = if at.runs.len() > 1 {
        format!("{:.3}", deviation(&overall))
    } else {
        String::new()
    };

    let parts = [
        column(|run| run.translation),
        column(|run| run.rotation),
        column(|run| run.direction),
        column(|run| run.magnitude),
    ];

    let mut cells = vec![format!("{:.3}", mean_of_known(&overall)), spread];
    cells.extend(
        parts
            .iter()
            .map(|part| format!("{:.3}", mean_of_known(part))),
    );

    cells.push(at.runs.first().map_or(0, |run| run.n).to_string());
    let baselines = at.baselines.as_ref();
    cells.extend(baseline_cells(baselines.map(|all| &all.together)));
    cells
}

/// The R² of the mean training motion and the distance to the nearest training pose; empty for
/// several rooms together.
fn baseline_cells(baselines: Option<&Baselines>) -> [String; 2] {
    let Some(baselines) = baselines else {
        return [String::new(), String::new()];
    };

    let nearest = baselines.nearest_pose.map_or_else(String::new, |pose| {
        format!(
            "{:.2} m {:.0}°",
            pose.translation_m,
            pose.rotation_rad.to_degrees()
        )
    });
    [format!("{:.3}", baselines.constant_r2), nearest]
}

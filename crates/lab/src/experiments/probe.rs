//! Scores M1 to M4 of one feature set in one room, or in several rooms together.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use serde::ser::SerializeStruct;
use serde::{Serialize, Serializer};

use seese3_core::eval::Baselines;
use seese3_core::motion_scores::MotionScores;
use seese3_core::room::Room;
use seese3_core::splits::Split;
use seese3_core::statistics::{deviation, mean_of_known};
use seese3_core::training::{RoomData, TrainingPlan};

use super::folds::{FoldedBaselines, FoldedMotions};
use super::{Error, Within};
use crate::formulations::read_by_adapter;
use crate::json::{self, PartsJson};
use crate::probes::{IntrinsicDimension, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe};

/// Which scores are computed; `None` or an empty list skips a score.
#[derive(Debug, Clone)]
pub struct ProbeProtocol {
    /// How M1 compares neighbors.
    pub m1: Option<MutualKnn>,
    /// How M2 treats neighbors in time and repeated rows.
    pub m2: Option<DimensionProtocol>,
    /// Plans of M3, of which only the stride is used.
    pub m3: Vec<TrainingPlan>,
    /// Training plans of M4, one per stride. Their seeds and splits are overridden.
    pub m4: Vec<TrainingPlan>,
    /// Train/test splits of M3 and M4: one split, or the folds of a recording. Each is trained and
    /// tested separately.
    pub splits: Vec<Split>,
    /// Number of M4 adapters per stride and split, with seeds from 0.
    pub seeds: u64,
}

/// Settings of the intrinsic dimension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DimensionProtocol {
    /// Frames before and after each frame that are excluded as neighbors.
    pub gap: usize,
}

/// Scores at one stride.
#[derive(Debug, Clone, Serialize)]
pub struct AtStride {
    /// Frames from source to target.
    pub stride: u32,
    /// The overall R², mean over seeds.
    pub r2: f64,
    /// Deviations over seeds; `None` for a single run.
    #[serde(flatten)]
    pub spread: Option<SeedSpread>,
    /// Number of test pairs.
    pub n: usize,
    /// Scores over the test pairs of all splits together: one for ridge regression, or one per
    /// seed of the adapter.
    #[serde(serialize_with = "json::each::<json::MotionJson, _, _>")]
    pub runs: Vec<MotionScores>,
    /// Baselines over the pairs of all splits together; `None` for several rooms together.
    #[serde(serialize_with = "json::baselines")]
    pub baselines: Option<Baselines>,
    /// One entry per split.
    pub splits: Vec<UnderSplit>,
}

/// Deviations over seeds.
#[derive(Debug, Clone, Serialize)]
pub struct SeedSpread {
    /// Sample standard deviation of the overall R².
    pub sd: f64,
    /// Mean and deviation of each part of the motion.
    pub by_part: PartsJson,
}

/// The score and the baselines under one split.
#[derive(Debug, Clone, Serialize)]
pub struct UnderSplit {
    /// The split.
    #[serde(serialize_with = "json::shown")]
    pub split: Split,
    /// The overall R², mean over seeds.
    pub r2: f64,
    /// Baselines to compare R² with; `None` for several rooms together.
    #[serde(serialize_with = "json::baselines")]
    pub baselines: Option<Baselines>,
}

impl AtStride {
    /// The scores of runs, one per seed. `room` is set if all runs are of one room.
    fn of(
        room: Option<&Room>,
        splits: &[Split],
        stride: u32,
        optimizer_steps: u64,
        runs: &[FoldedMotions],
    ) -> Result<Self, Error> {
        // The constant is the same for every seed.
        let constant = runs.first().map_or(f64::NAN, FoldedMotions::constant_r2);
        let baselines = room
            .map(|room| FoldedBaselines::of(room, splits, stride, optimizer_steps, constant))
            .transpose()?;

        let by_seed: Vec<Vec<f64>> = runs.iter().map(FoldedMotions::r2_by_split).collect();
        let under = |(at, &split): (usize, &Split)| {
            let of_seeds: Vec<f64> = by_seed.iter().map(|seed| seed[at]).collect();
            UnderSplit {
                split,
                r2: mean_of_known(&of_seeds),
                baselines: baselines.as_ref().map(|all| all.by_split[at]),
            }
        };

        let runs: Vec<MotionScores> = runs.iter().map(FoldedMotions::scores).collect();
        let overall: Vec<f64> = runs.iter().map(|run| run.overall).collect();
        Ok(Self {
            stride,
            r2: mean_of_known(&overall),
            spread: (runs.len() > 1).then(|| SeedSpread {
                sd: deviation(&overall),
                by_part: PartsJson::from(&runs),
            }),
            n: runs.first().map_or(0, |run| run.n),
            runs,
            splits: splits.iter().enumerate().map(under).collect(),
            baselines: baselines.as_ref().map(|all| all.together),
        })
    }
}

/// M1 and its settings.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct MutualKnnScore {
    /// Mean fraction of feature neighbors that are also pose neighbors, 0 to 1.
    #[serde(rename = "value")]
    pub share: f64,
    /// How the neighbors were compared.
    #[serde(flatten)]
    pub options: MutualKnn,
}

/// M2 and its settings.
#[derive(Debug, Clone)]
pub struct DimensionScore {
    /// The intrinsic dimension by several estimators.
    pub dimension: IntrinsicDimension,
    /// The settings.
    pub protocol: DimensionProtocol,
}

/// Scores of one room, or of several rooms together; skipped scores are `None` or empty.
#[derive(Debug, Clone, Serialize)]
pub struct ProbeScores {
    /// The room, or the rooms in words.
    pub room: String,
    /// Mutual k-NN.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub m1: Option<MutualKnnScore>,
    /// The intrinsic dimension.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub m2: Option<DimensionScore>,
    /// Ridge regression by stride.
    #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "by_stride")]
    pub m3: Vec<AtStride>,
    /// The adapter by stride.
    #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "by_stride")]
    pub m4: Vec<AtStride>,
}

impl Serialize for DimensionScore {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        let dimension = &self.dimension;
        let mut record = to.serialize_struct("DimensionScore", 9)?;
        record.serialize_field("twonn", &dimension.two_nn.linear)?;
        record.serialize_field("mle", &dimension.mle_biased.harmonic)?;
        record.serialize_field("twonn_censored", &dimension.two_nn.censored)?;
        record.serialize_field("twonn_likelihood", &dimension.two_nn.likelihood)?;
        record.serialize_field("mle_biased", &dimension.mle_biased)?;
        record.serialize_field("mle_unbiased", &dimension.mle_unbiased)?;
        record.serialize_field("gap", &self.protocol.gap)?;
        record.serialize_field("used_rows", &dimension.used)?;
        record.serialize_field("dropped_rows", &dimension.dropped)?;
        record.end()
    }
}

/// Serializes scores by stride. Those of the first stride are repeated at the top, so that a
/// client with one stride can ignore `strides`.
fn by_stride<S: Serializer>(strides: &[AtStride], to: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Strides<'a> {
        #[serde(flatten)]
        first: &'a AtStride,
        strides: &'a [AtStride],
    }

    let first = &strides[0];
    Strides { first, strides }.serialize(to)
}

/// Probes one room.
///
/// # Errors
/// [`Error::In`] with the name of the failed probe.
pub fn probe(data: &RoomData<'_>, protocol: &ProbeProtocol) -> Result<ProbeScores, Error> {
    let rows = data.features.rows();

    let mut m1 = None;
    if let Some(options) = protocol.m1 {
        let share = mutual_knn(rows, data.room.poses(), &options).within(|| "M1".to_owned())?;
        m1 = Some(MutualKnnScore { share, options });
    }

    let mut m2 = None;
    if let Some(protocol) = protocol.m2 {
        let dimension = intrinsic_dimension(rows, protocol.gap).within(|| "M2".to_owned())?;
        m2 = Some(DimensionScore {
            dimension,
            protocol,
        });
    }

    let splits = &protocol.splits;
    let ridge = |stride: u32| {
        let read = |split: Split| Ok(vec![ridge_probe(rows, data.room, split, stride)?]);
        let run = FoldedMotions::of(splits, read)?;
        AtStride::of(Some(data.room), splits, stride, 0, &[run])
    };
    let m3 = protocol
        .m3
        .iter()
        .map(|plan| ridge(plan.stride))
        .collect::<Result<_, Error>>()
        .within(|| "M3".to_owned())?;

    Ok(ProbeScores {
        room: data.room.id().to_string(),
        m1,
        m2,
        m3,
        m4: probe_adapters(std::slice::from_ref(data), protocol).within(|| "M4".to_owned())?,
    })
}

/// Computes M4 of several rooms together: test scores of one adapter per split and seed, at every
/// stride.
///
/// # Errors
/// [`Error::Training`] when a room is too short.
pub fn probe_adapters(
    rooms: &[RoomData<'_>],
    protocol: &ProbeProtocol,
) -> Result<Vec<AtStride>, Error> {
    let splits = &protocol.splits;
    let room = match rooms {
        [only] => Some(only.room),
        _ => None,
    };

    let at_stride = |plan: &TrainingPlan| {
        let steps = AtomicU64::new(0);
        let run = |seed: u64| {
            FoldedMotions::of(splits, |split| {
                let plan = TrainingPlan {
                    split,
                    ..plan.with_seed(seed)
                };
                let (read, taken) = read_by_adapter(rooms, &plan, &mut |_| ())?;
                steps.fetch_max(taken, Ordering::Relaxed);
                Ok(read)
            })
        };
        let runs: Vec<FoldedMotions> = (0..protocol.seeds)
            .into_par_iter()
            .map(run)
            .collect::<Result<_, Error>>()?;

        AtStride::of(room, splits, plan.stride, steps.into_inner(), &runs)
    };

    protocol.m4.iter().map(at_stride).collect()
}

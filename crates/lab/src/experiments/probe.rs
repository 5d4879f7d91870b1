//! M1 to M4 of one feature set in one room, or in several rooms together.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use seese3_core::motion_scores::MotionScores;
use seese3_core::room::Room;
use seese3_core::splits::Split;
use seese3_core::statistics::mean_of_known;
use seese3_core::training::{RoomData, TrainingPlan};

use super::folds::{FoldedBaselines, FoldedMotions};
use super::{Error, Within};
use crate::formulations::read_by_adapter;
use crate::probes::{
    Duplicates, IntrinsicDimension, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe,
};

/// What is measured; what is `None` or empty is left out.
#[derive(Debug, Clone)]
pub struct ProbeProtocol {
    /// How M1 compares neighbours.
    pub m1: Option<MutualKnn>,
    /// How M2 treats neighbours in time and repeated rows.
    pub m2: Option<DimensionProtocol>,
    /// Stride of M3, one plan per stride; their splits are replaced.
    pub m3: Vec<TrainingPlan>,
    /// How M4 is trained, one plan per stride; their seeds and splits are replaced.
    pub m4: Vec<TrainingPlan>,
    /// How training and test pairs are kept apart in M3 and M4: one split, or the folds of a
    /// recording, each of which is trained and tested by itself.
    pub splits: Vec<Split>,
    /// Adapters of M4 per stride, from seed 0 on.
    pub seeds: u64,
}

/// How the intrinsic dimension is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DimensionProtocol {
    /// Frames to each side that are left out as neighbours.
    pub gap: usize,
    /// What happens to rows that equal another row.
    pub duplicates: Duplicates,
}

/// Scores at one stride.
#[derive(Debug, Clone)]
pub struct AtStride {
    /// Frames from source to target.
    pub stride: u32,
    /// One score of a ridge regression, or one per adapter's seed: over the test pairs of all
    /// splits together.
    pub runs: Vec<MotionScores>,
    /// The overall R² under each split, mean over seeds.
    pub by_split: Vec<(Split, f64)>,
    /// What R² has to be read beside; none for several rooms together.
    pub baselines: Option<FoldedBaselines>,
}

impl AtStride {
    /// The scores of runs with one seed each; `room` if they are of one room alone.
    fn of(
        room: Option<&Room>,
        splits: &[Split],
        stride: u32,
        optimiser_steps: u64,
        runs: &[FoldedMotions],
    ) -> Result<Self, Error> {
        let by_seed: Vec<Vec<f64>> = runs.iter().map(FoldedMotions::r2_by_split).collect();
        let mean_under = |(at, &split): (usize, &Split)| {
            let of_seeds: Vec<f64> = by_seed.iter().map(|seed| seed[at]).collect();
            (split, mean_of_known(&of_seeds))
        };

        // The constant is the same for every seed.
        let constant = runs.first().map_or(f64::NAN, FoldedMotions::constant_r2);
        let baselines =
            room.map(|room| FoldedBaselines::of(room, splits, stride, optimiser_steps, constant));

        Ok(Self {
            stride,
            runs: runs.iter().map(FoldedMotions::scores).collect(),
            by_split: splits.iter().enumerate().map(mean_under).collect(),
            baselines: baselines.transpose()?,
        })
    }
}

/// M1, and how it was taken.
#[derive(Debug, Clone, Copy)]
pub struct MutualKnnScore {
    /// The mean share of neighbours by feature that are neighbours by pose, 0 to 1.
    pub share: f64,
    /// How the neighbours were compared.
    pub options: MutualKnn,
}

/// M2, and how it was taken.
#[derive(Debug, Clone)]
pub struct DimensionScore {
    /// The intrinsic dimension by several estimators.
    pub dimension: IntrinsicDimension,
    /// How it was taken.
    pub protocol: DimensionProtocol,
}

/// What was measured in a room, or in several rooms together; what was not asked for is absent.
#[derive(Debug, Clone)]
pub struct ProbeScores {
    /// The room, or the rooms in words.
    pub room: String,
    /// Mutual k-NN.
    pub m1: Option<MutualKnnScore>,
    /// The intrinsic dimension.
    pub m2: Option<DimensionScore>,
    /// Ridge regression by stride.
    pub m3: Vec<AtStride>,
    /// The adapter by stride.
    pub m4: Vec<AtStride>,
}

/// Probes one room.
///
/// # Errors
/// [`Error::In`], which names the probe that failed.
pub fn probe(data: &RoomData<'_>, protocol: &ProbeProtocol) -> Result<ProbeScores, Error> {
    let rows = data.features.rows();

    let mut m1 = None;
    if let Some(options) = protocol.m1 {
        let share = mutual_knn(rows, data.room.poses(), &options).within(|| "M1".to_owned())?;
        m1 = Some(MutualKnnScore { share, options });
    }

    let mut m2 = None;
    if let Some(protocol) = protocol.m2 {
        let dimension = intrinsic_dimension(rows, protocol.gap, protocol.duplicates)
            .within(|| "M2".to_owned())?;
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

/// M4 of several rooms together: test scores of one adapter per split and seed, at every stride.
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

//! M1 to M4 of one feature set in one room, or in several rooms together.

use rayon::prelude::*;

use seese3_core::motion_scores::MotionScores;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};

use super::{Error, Within};
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
    /// Split and stride of M3, one plan per stride.
    pub m3: Vec<TrainingPlan>,
    /// How M4 is trained, one plan per stride; their seeds are replaced.
    pub m4: Vec<TrainingPlan>,
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
    /// One score of a ridge regression, or one per adapter's seed.
    pub runs: Vec<MotionScores>,
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

    let mut m3 = Vec::with_capacity(protocol.m3.len());
    for plan in &protocol.m3 {
        let run =
            ridge_probe(rows, data.room, plan.split, plan.stride).within(|| "M3".to_owned())?;
        m3.push(AtStride {
            stride: plan.stride,
            runs: vec![run],
        });
    }

    Ok(ProbeScores {
        room: data.room.id().to_string(),
        m1,
        m2,
        m3,
        m4: probe_adapters(std::slice::from_ref(data), protocol).within(|| "M4".to_owned())?,
    })
}

/// M4 of several rooms together: test scores of one adapter per seed, at every stride.
///
/// # Errors
/// [`Error::Training`] when a room is too short.
pub fn probe_adapters(
    rooms: &[RoomData<'_>],
    protocol: &ProbeProtocol,
) -> Result<Vec<AtStride>, Error> {
    let at_stride = |plan: &TrainingPlan| {
        let run = |seed: u64| -> Result<MotionScores, Error> {
            let (_, record) = train_adapter(rooms, &plan.with_seed(seed), &mut |_| ())?;
            Ok(record.test)
        };

        Ok(AtStride {
            stride: plan.stride,
            runs: (0..protocol.seeds)
                .into_par_iter()
                .map(run)
                .collect::<Result<_, Error>>()?,
        })
    };

    protocol.m4.iter().map(at_stride).collect()
}

//! Trains one plan with several seeds.

use std::sync::Arc;
use std::time::Instant;

use ndarray::{Axis, concatenate};
use rayon::prelude::*;

use seese3_core::adapter::{Adapter, EpochProgress, Gating, Reading, TrainingRecord};
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, evaluate};
use seese3_core::navigation::{
    HIT_THRESHOLDS, IndexKind, Navigator, NavigatorKind, RetrievalMetric, StepKind,
};
use seese3_core::statistics::Rate;
use seese3_core::training::{RoomData, TrainingPlan, train_adapter};

use super::Error;

/// The result of one seed.
#[derive(Debug, Clone)]
pub struct TrainingRun {
    /// The training record of this seed.
    pub record: TrainingRecord,
    /// Hit@0.1 of inverse Poincaré with the affine reading, on the seed's test pairs.
    pub hit_rate: Rate,
    /// Wall time of training alone, seconds.
    pub seconds: f64,
    /// How a gate mixes the charts, over all frames of the rooms; `None` without a gate.
    pub gating: Option<Gating>,
}

/// The adapter of the first seed, and the scores of every seed.
#[derive(Debug, Clone)]
pub struct SeededTraining {
    /// The first seed's adapter.
    pub adapter: Adapter,
    /// One run per seed, in seed order; at least one.
    pub runs: Vec<TrainingRun>,
}

/// Trains one adapter per seed on all cores, starting at the plan's seed. `progress` is called
/// after every epoch of every seed.
///
/// # Errors
/// [`Error`] when a seed is too large or training fails.
pub fn train_seeds(
    rooms: &[RoomData<'_>],
    plan: &TrainingPlan,
    seeds: u64,
    progress: &(dyn Fn(EpochProgress) + Sync),
) -> Result<SeededTraining, Error> {
    let one = |offset: u64| {
        let seed = plan.config.seed + offset;
        if seed > u64::from(u32::MAX) {
            return Err(Error::Seed);
        }

        let plan = plan.with_seed(seed);
        let begun = Instant::now();
        let (adapter, record) = train_adapter(rooms, &plan, &mut |epoch| progress(epoch))?;
        let seconds = begun.elapsed().as_secs_f64();

        let hit_rate = hit_rate(rooms, &adapter, &plan)?;
        let run = TrainingRun {
            record,
            hit_rate,
            seconds,
            gating: gating(rooms, &adapter)?,
        };
        Ok((adapter, run))
    };

    let trained: Vec<(Adapter, TrainingRun)> = (0..seeds)
        .into_par_iter()
        .map(one)
        .collect::<Result<_, Error>>()?;
    let (adapters, runs): (Vec<Adapter>, Vec<TrainingRun>) = trained.into_iter().unzip();
    let adapter = adapters
        .into_iter()
        .next()
        .ok_or_else(|| Error::Input("at least one seed is required".to_owned()))?;

    Ok(SeededTraining { adapter, runs })
}

/// How the adapter's gate mixes its charts over the frames of all rooms; `None` without a gate.
fn gating(rooms: &[RoomData<'_>], adapter: &Adapter) -> Result<Option<Gating>, Error> {
    let rows: Vec<_> = rooms.iter().map(|data| data.features.rows()).collect();
    let Ok(rows) = concatenate(Axis(0), &rows) else {
        return Ok(None);
    };
    Ok(adapter.gating(rows.view())?)
}

/// Hit@0.1 of inverse Poincaré with the affine reading, over the test pairs of all rooms together.
fn hit_rate(rooms: &[RoomData<'_>], adapter: &Adapter, plan: &TrainingPlan) -> Result<Rate, Error> {
    let adapter = Arc::new(adapter.clone());
    let inverse = StepKind::InversePoincare(Reading::Affine);
    let protocol = Protocol {
        split: plan.split,
        navigators: vec![NavigatorKind::Step(inverse, RetrievalMetric::Full)],
        ..Protocol::paper(plan.stride)
    };

    // Blocks of all rooms together, so that each room is weighted by its number of test pairs.
    let mut blocks = Vec::new();
    for data in rooms {
        let navigator = Navigator::new(
            Arc::new(data.room.clone()),
            data.features,
            adapter.clone(),
            IndexKind::Exact,
        )?;
        let report = evaluate(
            &navigator,
            &protocol,
            &Cancellation::default(),
            &mut |_, _| (),
        )?;

        blocks.extend(report.rows[0].retrieval.hits_by_block(HIT_THRESHOLDS[0]));
    }

    Ok(Rate::of_blocks(&blocks))
}

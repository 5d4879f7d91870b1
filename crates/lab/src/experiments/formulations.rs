//! Compares the adapter with the paper's alternatives A to D and the constant, over several seeds.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use strum::VariantArray;

use seese3_core::motion_scores::{MotionScores, ReadMotions};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};

use super::Error;
use super::folds::FoldedMotions;
use crate::formulations::{Formulation, train_formulation};
use crate::json::{self, PartsJson};

/// Scores of every formulation, and of the constant baseline on the same pairs.
#[derive(Debug, Clone, Serialize)]
pub struct Comparison {
    /// One entry per formulation, the adapter first.
    pub formulations: Vec<FormulationScores>,
    /// R² of the constant baseline, which always predicts the mean training motion; mean over
    /// rooms.
    pub constant_r2: f64,
}

/// Scores of one formulation, one per seed. Each is computed over the test pairs of all splits of
/// a room together, then averaged over rooms.
#[derive(Debug, Clone, Serialize)]
pub struct FormulationScores {
    /// The formulation's name.
    pub name: &'static str,
    /// Mean and deviation of each part of the motion over the seeds.
    pub by_part: PartsJson,
    /// One score per seed, in seed order.
    #[serde(serialize_with = "json::each::<json::MotionJson, _, _>")]
    pub runs: Vec<MotionScores>,
    /// Overall R² by seed and room.
    pub r2_by_seed_and_room: Vec<Vec<f64>>,
}

/// The scores of one formulation with one seed.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FormulationRun {
    /// One score per room, over the test pairs of all splits together.
    pub rooms: Vec<MotionScores>,
    /// R² of the constant baseline; mean over rooms.
    pub constant_r2: f64,
}

impl FormulationScores {
    /// The scores of a formulation, from one run per seed.
    pub fn new(which: Formulation, runs: &[FormulationRun]) -> Self {
        let means: Vec<MotionScores> = runs
            .iter()
            .map(|run| MotionScores::mean(&run.rooms))
            .collect();
        let overall = |run: &FormulationRun| run.rooms.iter().map(|room| room.overall).collect();
        Self {
            name: which.into(),
            by_part: PartsJson::from(&means),
            runs: means,
            r2_by_seed_and_room: runs.iter().map(overall).collect(),
        }
    }
}

/// Whether a formulation trains one network per room or one for all rooms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoomPooling {
    /// One network per room.
    RoomByRoom,
    /// One network for all rooms together.
    Together,
}

/// How formulations are trained and tested.
pub struct FormulationPlan<'a> {
    /// The training. Its split and seed are ignored.
    pub training: &'a TrainingPlan,
    /// Every split trains a network.
    pub splits: &'a [Split],
    /// One network per room, or one for all.
    pub room_pooling: RoomPooling,
}

/// Trains every formulation with seeds from 0 to `seeds` − 1, on all cores. `run` trains one
/// formulation with one seed, usually by [`run_formulation`].
///
/// # Errors
/// The first error of `run`.
pub fn compare(
    seeds: u64,
    run: &(dyn Fn(Formulation, u64) -> Result<FormulationRun, Error> + Sync),
) -> Result<Comparison, Error> {
    let tasks: Vec<(Formulation, u64)> = Formulation::VARIANTS
        .iter()
        .flat_map(|&which| (0..seeds).map(move |seed| (which, seed)))
        .collect();
    let runs: Vec<FormulationRun> = tasks
        .into_par_iter()
        .map(|(which, seed)| run(which, seed))
        .collect::<Result<_, Error>>()?;

    // The tasks are in the order of the formulations.
    let by_formulation = runs.chunks(seeds as usize);
    let scores = Formulation::VARIANTS.iter().zip(by_formulation);
    Ok(Comparison {
        formulations: scores
            .map(|(&which, runs)| FormulationScores::new(which, runs))
            .collect(),
        // The constant is the same for every formulation and seed.
        constant_r2: runs.first().map_or(f64::NAN, |run| run.constant_r2),
    })
}

/// Trains one formulation with one seed and scores it in each room.
///
/// # Errors
/// [`Error::Training`] when a room is too short or the plan has settings that only the adapter
/// supports.
pub fn run_formulation(
    which: Formulation,
    seed: u64,
    rooms: &[RoomData<'_>],
    plan: &FormulationPlan<'_>,
) -> Result<FormulationRun, Error> {
    let read = FoldedMotions::of(plan.splits, |split| {
        let training = TrainingPlan {
            split,
            ..plan.training.with_seed(seed)
        };
        one_run(which, rooms, &training, plan.room_pooling)
    })?;
    Ok(FormulationRun {
        rooms: read.room_scores(),
        constant_r2: read.constant_r2(),
    })
}

/// Predicted motions of each room's test pairs, by one formulation with one seed.
fn one_run(
    which: Formulation,
    rooms: &[RoomData<'_>],
    plan: &TrainingPlan,
    room_pooling: RoomPooling,
) -> Result<Vec<ReadMotions>, Error> {
    match room_pooling {
        RoomPooling::Together => Ok(train_formulation(which, rooms, plan, &mut |_| ())?),
        RoomPooling::RoomByRoom => {
            let mut motions = Vec::with_capacity(rooms.len());
            for data in rooms {
                let room = std::slice::from_ref(data);
                motions.extend(train_formulation(which, room, plan, &mut |_| ())?);
            }
            Ok(motions)
        }
    }
}

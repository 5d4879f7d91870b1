//! Compares the adapter with the paper's alternatives A to D and the constant, over several seeds.

use rayon::prelude::*;
use serde::Serialize;
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
}

impl FormulationScores {
    /// The scores of a formulation, one per seed.
    pub fn new(name: &'static str, runs: Vec<MotionScores>) -> Self {
        Self {
            name,
            by_part: PartsJson::from(&runs),
            runs,
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

/// Trains every formulation under every split in `splits`, with seeds from 0 to `seeds` − 1, on
/// all cores. The split of `plan` is ignored. `done` is called after each seed of a formulation.
///
/// # Errors
/// [`Error::Training`] when a room is too short or the plan has settings that only the adapter
/// supports.
pub fn compare(
    rooms: &[RoomData<'_>],
    plan: &TrainingPlan,
    splits: &[Split],
    seeds: u64,
    room_pooling: RoomPooling,
    done: &(dyn Fn() + Sync),
) -> Result<Comparison, Error> {
    let tasks: Vec<(Formulation, u64)> = Formulation::VARIANTS
        .iter()
        .flat_map(|&which| (0..seeds).map(move |seed| (which, seed)))
        .collect();

    let runs: Vec<(Formulation, MotionScores, f64)> = tasks
        .into_par_iter()
        .map(|(which, seed)| {
            let read = FoldedMotions::of(splits, |split| {
                let plan = TrainingPlan {
                    split,
                    ..plan.with_seed(seed)
                };
                one_run(which, rooms, &plan, room_pooling)
            })?;
            done();

            Ok((which, read.scores(), read.constant_r2()))
        })
        .collect::<Result<_, Error>>()?;

    // Group the runs of all tasks by formulation.
    let scores_of = |which: Formulation| {
        let own = runs.iter().filter(|(other, ..)| *other == which);
        FormulationScores::new(which.into(), own.map(|(_, scores, _)| *scores).collect())
    };

    Ok(Comparison {
        formulations: Formulation::VARIANTS
            .iter()
            .copied()
            .map(scores_of)
            .collect(),
        // The constant is the same for every formulation and seed.
        constant_r2: runs.first().map_or(f64::NAN, |&(_, _, constant)| constant),
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

//! The adapter beside the paper's alternatives A to D, over several seeds.

use rayon::prelude::*;

use seese3_core::motion_scores::MotionScores;
use seese3_core::training::{RoomData, TrainingPlan};

use super::Error;
use crate::formulations::{Formulation, train_formulation};

/// Scores of one formulation, one per seed, each the mean over rooms.
#[derive(Debug, Clone)]
pub struct FormulationScores {
    /// The formulation's name.
    pub name: &'static str,
    /// One score per seed, in their order.
    pub runs: Vec<MotionScores>,
}

/// How many networks a formulation trains for several rooms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoomPooling {
    /// One network per room.
    RoomByRoom,
    /// One network for all rooms together.
    Together,
}

/// Trains every formulation with seeds 0 to `seeds`, on all cores; `done` hears of each run.
///
/// # Errors
/// [`Error::Training`] when a room is too short or the plan has settings that only the adapter
/// knows.
pub fn compare(
    rooms: &[RoomData<'_>],
    plan: &TrainingPlan,
    seeds: u64,
    room_pooling: RoomPooling,
    done: &(dyn Fn() + Sync),
) -> Result<Vec<FormulationScores>, Error> {
    let tasks: Vec<(Formulation, u64)> = Formulation::ALL
        .into_iter()
        .flat_map(|which| (0..seeds).map(move |seed| (which, seed)))
        .collect();

    let runs: Vec<(Formulation, MotionScores)> = tasks
        .into_par_iter()
        .map(|(which, seed)| {
            let scores = one_run(which, rooms, &plan.with_seed(seed), room_pooling)?;
            done();
            Ok((which, scores))
        })
        .collect::<Result<_, Error>>()?;

    // The runs were computed in parallel; the table wants them by formulation.
    let scores_of = |which: Formulation| FormulationScores {
        name: which.name(),
        runs: runs
            .iter()
            .filter(|(other, _)| *other == which)
            .map(|(_, scores)| *scores)
            .collect(),
    };

    Ok(Formulation::ALL.map(scores_of).to_vec())
}

/// The mean over rooms of one formulation with one seed.
fn one_run(
    which: Formulation,
    rooms: &[RoomData<'_>],
    plan: &TrainingPlan,
    room_pooling: RoomPooling,
) -> Result<MotionScores, Error> {
    let scores = match room_pooling {
        RoomPooling::Together => train_formulation(which, rooms, plan, &mut |_| ())?,
        RoomPooling::RoomByRoom => {
            let mut scores = Vec::with_capacity(rooms.len());
            for data in rooms {
                let room = std::slice::from_ref(data);
                scores.extend(train_formulation(which, room, plan, &mut |_| ())?);
            }
            scores
        }
    };

    Ok(MotionScores::mean(&scores))
}

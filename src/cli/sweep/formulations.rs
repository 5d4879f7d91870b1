//! `seese3 sweep formulations`: the adapter beside the paper's alternatives.

use std::path::PathBuf;

use clap::Args;
use rayon::prelude::*;

use super::super::progress::bar;
use super::super::protocol::ProtocolOptions;
use super::super::rooms::{lesson, load_rooms, room_words};
use super::super::{check_writable, say, write_json};
use crate::adapter::TrainConfig;
use crate::formulations::{Formulation, learn};
use crate::report::{FormulationScores, formulations_json, formulations_table};
use crate::scores::MotionScores;
use crate::store::Store;
use crate::training::{Lesson, Recipe};

#[derive(Debug, Args)]
pub struct Formulations {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Which of their features; may be left out when the first room has one
    #[arg(long)]
    features: Option<String>,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// One network for all rooms together, instead of one a room
    #[arg(long)]
    pooled: bool,
    /// Runs of each formulation, from seed 0 on; the paper took 15
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// Write all of it here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Formulations {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(file) = &self.json {
            check_writable(file)?;
        }

        self.protocol.needs_test_pairs()?;
        let store = Store::open(&self.store)?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;
        let recipe = self.protocol.recipe(0)?;
        recipe.check()?;

        let lessons: Vec<Lesson<'_>> = rooms.iter().map(lesson).collect();

        let tasks: Vec<(Formulation, u64)> = Formulation::ALL
            .into_iter()
            .flat_map(|which| (0..self.seeds).map(move |seed| (which, seed)))
            .collect();
        let progress = bar(tasks.len() as u64, "formulations");

        let runs: Vec<(Formulation, MotionScores)> = tasks
            .into_par_iter()
            .map(|(which, seed)| {
                let recipe = Recipe {
                    config: TrainConfig {
                        seed,
                        ..recipe.config.clone()
                    },
                    ..recipe.clone()
                };

                let scores = self.run_of(which, &lessons, &recipe)?;
                progress.inc(1);

                Ok((which, scores))
            })
            .collect::<anyhow::Result<_>>()?;

        progress.finish_and_clear();

        let scores: Vec<FormulationScores> = Formulation::ALL
            .map(|which| FormulationScores {
                name: which.name(),
                runs: runs
                    .iter()
                    .filter(|(of, _)| *of == which)
                    .map(|(_, scores)| *scores)
                    .collect(),
            })
            .to_vec();

        say(format_args!(
            "{}, features '{}', preset {} with {} epochs, stride {}, split {}; means over rooms ± sd over {} seeds{}; {} \
             test pairs",
            room_words(&rooms),
            rooms[0].1.source().name,
            recipe.preset.name(),
            recipe.config.epochs,
            recipe.stride,
            recipe.split,
            self.seeds,
            if self.pooled { ", rooms together" } else { "" },
            scores[0].runs.first().map_or(0, |run| run.n),
        ));

        say(formulations_table(&scores).trim_end());
        if let Some(file) = &self.json {
            write_json(file, &formulations_json(&scores))?;
            say(format_args!("wrote {}", file.display()));
        }

        Ok(())
    }

    /// Means over rooms of one seed.
    fn run_of(
        &self,
        which: Formulation,
        lessons: &[Lesson<'_>],
        recipe: &Recipe,
    ) -> anyhow::Result<MotionScores> {
        if self.pooled {
            return Ok(MotionScores::mean(&learn(
                which,
                lessons,
                recipe,
                &mut |_| (),
            )?));
        }

        let mut scores = Vec::with_capacity(lessons.len());
        for lesson in lessons {
            scores.extend(learn(
                which,
                std::slice::from_ref(lesson),
                recipe,
                &mut |_| (),
            )?);
        }

        Ok(MotionScores::mean(&scores))
    }
}

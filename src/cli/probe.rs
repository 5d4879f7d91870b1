//! `seese3 probe`: how much of SE(3) features hold, M1 to M4.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use rayon::prelude::*;
use serde_json::json;

use super::progress::bar;
use super::protocol::ProtocolOptions;
use super::rooms::{lesson, load_rooms, room_words};
use super::{check_writable, say, write_json};
use crate::adapter::TrainConfig;
use crate::features::Features;
use crate::metrics::{
    Bound, Counted, Duplicates, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe,
};
use crate::report::{AtStride, ProbeScores, probe_table};
use crate::scores::MotionScores;
use crate::store::{Store, StoredRoom};
use crate::training::{Lesson, Recipe, learn};

#[derive(Debug, Args)]
pub struct Probe {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room; names, or patterns with *; may be given several times
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Which of its features; may be left out when the room has one
    #[arg(long)]
    features: Option<String>,
    /// What to measure, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Metric::M1, Metric::M2, Metric::M3, Metric::M4])]
    metrics: Vec<Metric>,
    /// Strides of M3 and M4, separated by commas, instead of --stride; the first is the headline
    #[arg(long = "sweep-strides", value_delimiter = ',')]
    sweep: Vec<u32>,
    /// Seeds of M4, from 0 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// Beside one adapter a room, one for all rooms together
    #[arg(long)]
    pooled: bool,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// Frames that M1 compares
    #[arg(long, default_value_t = 256)]
    m1_frames: usize,
    /// Stride of M1
    #[arg(long, default_value_t = 1)]
    m1_stride: usize,
    /// Neighbours of M1
    #[arg(long, default_value_t = 10)]
    m1_k: usize,
    /// How near frames are no neighbours, in M1
    #[arg(long, default_value_t = 10)]
    m1_exclusion: usize,
    /// What --m1-exclusion counts
    #[arg(long, value_enum, default_value_t = CountedName::Sampled)]
    m1_counts: CountedName,
    /// A frame that is just --m1-exclusion away may be a neighbour
    #[arg(long)]
    m1_exclusive: bool,
    /// Frames to each side that are no neighbours, in M2; 0 is the paper's, which measures the path
    /// rather than the room
    #[arg(long, default_value_t = 0)]
    m2_gap: usize,
    /// Of rows that are the same keep the first, in M2, instead of dropping all that have a twin
    #[arg(long)]
    m2_keep_first: bool,
    /// Write all of it here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Metric {
    /// Mutual k-NN
    M1,
    /// Intrinsic dimension
    M2,
    /// Ridge
    M3,
    /// Adapter
    M4,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum CountedName {
    /// The frames that are compared
    Sampled,
    /// The frames of the room
    Native,
}

type Loaded = (StoredRoom, Features);

impl Probe {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(file) = &self.json {
            check_writable(file)?;
        }

        let store = Store::open(&self.store)?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;
        if self.metrics.contains(&Metric::M3) || self.metrics.contains(&Metric::M4) {
            self.protocol.needs_test_pairs()?;
        }

        let base = self.protocol.recipe(0)?;
        let recipes = self.recipes(&base)?;
        let pooled = self.pooled && self.metrics.contains(&Metric::M4);
        let progress = bar((rooms.len() + usize::from(pooled)) as u64, "probing");
        let (mut scores, skipped) = self.probed(&rooms, &recipes, &progress)?;

        if pooled {
            let lessons: Vec<Lesson<'_>> = rooms.iter().map(lesson).collect();
            let m4 = self.adapters(&lessons, &recipes)?;
            let room = format!("{} together", room_words(&rooms));

            scores.push(ProbeScores {
                room,
                m1: None,
                m2: None,
                m3: Vec::new(),
                m4,
            });
        }

        progress.finish_and_clear();

        say(format_args!(
            "{}, features '{}'; M3, M4: split {}; M4: {}, {} seeds",
            room_words(&rooms),
            rooms[0].1.source().name,
            base.split,
            base.preset.name(),
            self.seeds
        ));

        say(probe_table(&scores).trim_end());
        skipped
            .iter()
            .for_each(|why| say(format_args!("skipped: {why}")));

        for (score, (dimension, gap, _)) in scores
            .iter()
            .filter_map(|score| Some((score, score.m2.as_ref()?)))
        {
            say(format_args!(
                "M2 of {}: {} rows used, {} dropped as duplicates, gap {gap}",
                score.room, dimension.used, dimension.dropped
            ));
        }

        let still = scores
            .iter()
            .flat_map(|score| score.m3.iter().chain(&score.m4))
            .flat_map(|at| &at.runs);

        if still
            .map(MotionScores::still_components)
            .any(|count| count > 0)
        {
            say(
                "some components of the motion never vary; they have no R² and are left out of the means",
            );
        }

        if let Some(file) = &self.json {
            let mut record = match scores.as_slice() {
                [one] => one.json(),
                several => {
                    json!({ "rooms": several.iter().map(ProbeScores::json).collect::<Vec<_>>() })
                }
            };
            record["skipped"] = json!(skipped);

            record["features"] = json!(rooms[0].1.source().name);
            record["split"] = json!(base.split.name());
            record["preset"] = json!(base.preset.name());
            write_json(file, &record)?;

            say(format_args!("wrote {}", file.display()));
        }

        Ok(())
    }

    /// Every room that can be probed, and why the others cannot.
    fn probed(
        &self,
        rooms: &[Loaded],
        recipes: &[Recipe],
        progress: &indicatif::ProgressBar,
    ) -> anyhow::Result<(Vec<ProbeScores>, Vec<String>)> {
        let one = |room: &Loaded| {
            let what = || {
                format!(
                    "room '{}', features '{}'",
                    room.0.room.id(),
                    room.1.source().name
                )
            };

            let scores = self.scores(room, recipes).with_context(what);
            progress.inc(1);

            scores
        };

        let probed: Vec<anyhow::Result<ProbeScores>> = rooms.par_iter().map(one).collect();
        let mut scores = Vec::with_capacity(probed.len());
        let mut skipped = Vec::new();
        for result in probed {
            match result {
                Ok(found) => scores.push(found),
                Err(error) if rooms.len() > 1 => skipped.push(format!("{error:#}")),
                Err(error) => return Err(error),
            }
        }

        if let (true, Some(first)) = (scores.is_empty(), skipped.first()) {
            bail!("no room could be probed; the first says: {first}");
        }

        Ok((scores, skipped))
    }

    /// One recipe a stride.
    fn recipes(&self, base: &Recipe) -> anyhow::Result<Vec<Recipe>> {
        match self.sweep.as_slice() {
            [] => Ok(vec![base.clone()]),
            strides => strides
                .iter()
                .map(|&stride| self.protocol.at_stride(stride).recipe(0))
                .collect(),
        }
    }

    fn scores(&self, room: &Loaded, recipes: &[Recipe]) -> anyhow::Result<ProbeScores> {
        let stored = &room.0.room;
        let rows = room.1.rows();
        let wants = |metric: Metric| self.metrics.contains(&metric);

        let knn = MutualKnn {
            frames: self.m1_frames,
            stride: self.m1_stride,
            k: self.m1_k,
            exclusion: self.m1_exclusion,
            counted: match self.m1_counts {
                CountedName::Sampled => Counted::Sampled,
                CountedName::Native => Counted::Native,
            },
            bound: if self.m1_exclusive {
                Bound::Exclusive
            } else {
                Bound::Inclusive
            },
        };

        let duplicates = if self.m2_keep_first {
            Duplicates::KeepFirst
        } else {
            Duplicates::DropRows
        };

        let m1 = wants(Metric::M1)
            .then(|| mutual_knn(rows, stored.poses(), &knn))
            .transpose()
            .context("M1")?;

        let m2 = wants(Metric::M2)
            .then(|| intrinsic_dimension(rows, self.m2_gap, duplicates))
            .transpose();

        let mut m3 = Vec::new();
        for recipe in recipes.iter().filter(|_| wants(Metric::M3)) {
            let run = ridge_probe(rows, stored, recipe.split, recipe.stride).context("M3")?;
            m3.push(AtStride {
                stride: recipe.stride,
                runs: vec![run],
            });
        }

        let m4 = if wants(Metric::M4) {
            self.adapters(&[lesson(room)], recipes).context("M4")?
        } else {
            Vec::new()
        };

        Ok(ProbeScores {
            room: stored.id().to_string(),
            m1: m1.map(|value| (value, knn)),
            m2: m2
                .context("M2")?
                .map(|dimension| (dimension, self.m2_gap, duplicates)),
            m3,
            m4,
        })
    }

    /// Test scores of one adapter a seed, at every stride: means over rooms.
    fn adapters(
        &self,
        lessons: &[Lesson<'_>],
        recipes: &[Recipe],
    ) -> anyhow::Result<Vec<AtStride>> {
        let at = |recipe: &Recipe| {
            let run = |seed: u64| {
                let recipe = Recipe {
                    config: TrainConfig {
                        seed,
                        ..recipe.config.clone()
                    },
                    ..recipe.clone()
                };

                Ok(learn(lessons, &recipe, &mut |_| ())?.1.test)
            };

            let runs = (0..self.seeds)
                .into_par_iter()
                .map(run)
                .collect::<anyhow::Result<_>>()?;

            Ok(AtStride {
                stride: recipe.stride,
                runs,
            })
        };

        recipes.iter().map(at).collect()
    }
}

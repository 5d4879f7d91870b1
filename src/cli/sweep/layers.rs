//! `seese3 sweep layers`: M1 to M4 over the layers of a features set.

use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::Args;
use rayon::prelude::*;

use super::super::progress::bar;
use super::super::protocol::{PresetName, SplitName};
use super::super::{check_writable, say, write_json};
use crate::adapter::Preset;
use crate::features::Features;
use crate::metrics::{
    Duplicates, IntrinsicDimension, MutualKnn, intrinsic_dimension, mutual_knn, ridge_probe,
};
use crate::pairs::Split;
use crate::report::{LayerScores, encoders_table, layers_json, layers_table};
use crate::room::Room;
use crate::scores::{MotionScores, deviation, mean};
use crate::store::{Store, StoredRoom};
use crate::training::{Lesson, Recipe, learn};

#[derive(Debug, Args)]
pub struct Layers {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// The room; may be given several times, then means over rooms are shown
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Features by name, or what their names begin with; all of the room's if none is given
    #[arg(long, value_delimiter = ',')]
    features: Vec<String>,
    /// Frames from source to target, of M3 and M4
    #[arg(long, default_value_t = 40)]
    stride: u32,
    /// How frames are kept apart, in M3 and M4
    #[arg(long, value_enum, default_value_t = SplitName::Time)]
    split: SplitName,
    /// The protocol of M4
    #[arg(long, value_enum, default_value_t = PresetName::PaperBase)]
    preset: PresetName,
    /// Passes of M4 over the pairs, instead of the preset's
    #[arg(long)]
    epochs: Option<usize>,
    /// Adapters of M4, from seed 0 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// Frames that M1 compares
    #[arg(long, default_value_t = 256)]
    m1_frames: usize,
    /// Stride of M1
    #[arg(long, default_value_t = 1)]
    m1_stride: usize,
    /// Neighbours of M1
    #[arg(long, default_value_t = 10)]
    m1_k: usize,
    /// Frames to each side that are no neighbours, in M1
    #[arg(long, default_value_t = 10)]
    m1_exclusion: usize,
    /// Frames to each side that are no neighbours, in M2; 0 is the paper's, which measures the path
    /// rather than the room
    #[arg(long, default_value_t = 10)]
    m2_gap: usize,
    /// Also a line an encoder, by its best layer: for checkpoints of one encoder
    #[arg(long)]
    by_encoder: bool,
    /// Write all of it here as JSON
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Layers {
    pub async fn run(self) -> anyhow::Result<()> {
        if let Some(file) = &self.json {
            check_writable(file)?;
        }

        ensure!(
            self.split != SplitName::Whole,
            "--split whole sets no test pairs apart; take another split"
        );

        let store = Store::open(&self.store)?;
        let mut rooms = Vec::new();
        for room in &self.rooms {
            rooms.push(store.load_room(room, None).await?);
        }

        if let Some(twice) = self
            .rooms
            .iter()
            .enumerate()
            .find(|(i, room)| self.rooms[..*i].contains(room))
        {
            bail!("room '{}' was given twice", twice.1);
        }

        let names = self.names(&rooms)?;
        let tasks: Vec<(usize, &StoredRoom, &Features)> = (0..names.len())
            .flat_map(|layer| rooms.iter().map(move |room| (layer, room)))
            .filter_map(|(layer, room)| Some((layer, room, room.features(&names[layer])?)))
            .collect();
        let progress = bar(tasks.len() as u64, "layers");

        let scored: Vec<(usize, LayerScores)> = tasks
            .into_par_iter()
            .map(|(layer, stored, features)| {
                let what = || {
                    format!(
                        "room '{}', features '{}'",
                        stored.room.id(),
                        features.source().name
                    )
                };

                let scores = self.scores(stored, features).with_context(what)?;
                progress.inc(1);

                Ok((layer, scores))
            })
            .collect::<anyhow::Result<_>>()?;

        progress.finish_and_clear();
        let scores: Vec<LayerScores> = scored.into_iter().map(|(_, scores)| scores).collect();
        let split: Split = self.split.into();
        let preset: Preset = self.preset.into();

        say(format_args!(
            "{} rooms; M1: {} frames at stride {}, k {}, exclusion {}; M2: gap {}; M3, M4: stride {}, split {split}; \
             M4: {}, {} seeds",
            rooms.len(),
            self.m1_frames,
            self.m1_stride,
            self.m1_k,
            self.m1_exclusion,
            self.m2_gap,
            self.stride,
            preset.name(),
            self.seeds
        ));

        say(layers_table(&scores).trim_end());
        if self.by_encoder {
            say(encoders_table(&scores).trim_end());
        }

        say("* the best: M1 highest, M2 nearest to 6 (SE(3)), M3 and M4 highest; means over rooms");
        if let Some(file) = &self.json {
            write_json(file, &layers_json(&scores))?;
            say(format_args!("wrote {}", file.display()));
        }

        Ok(())
    }

    /// The features that every room has, of those that were asked for.
    fn names(&self, rooms: &[StoredRoom]) -> anyhow::Result<Vec<String>> {
        let calls_for = |given: &str, name: &str| {
            name == given
                || name
                    .strip_prefix(given)
                    .is_some_and(|rest| rest.starts_with('-'))
        };
        let wanted = |name: &str| {
            self.features.is_empty() || self.features.iter().any(|given| calls_for(given, name))
        };

        let all: Vec<&str> = rooms[0]
            .features
            .iter()
            .map(|set| set.source().name.as_str())
            .collect();
        let names: Vec<String> = all
            .iter()
            .filter(|name| wanted(name))
            .map(|&name| name.to_owned())
            .collect();

        let missing = self
            .features
            .iter()
            .find(|given| !all.iter().any(|name| calls_for(given, name)));

        if let Some(missing) = missing
            .map(String::as_str)
            .or(names.is_empty().then_some("any"))
        {
            bail!(
                "room '{}' has no such features: '{missing}'; it has {}",
                rooms[0].room.id(),
                all.join(", ")
            );
        }

        for name in &names {
            for stored in rooms {
                let first = rooms[0].features(name).map(Features::source);
                if stored
                    .features(name)
                    .zip(first)
                    .is_some_and(|(set, first)| !set.source().is_like(first))
                {
                    let a = rooms[0].room.id();
                    let b = stored.room.id();
                    bail!(
                        "features '{name}' of rooms '{a}' and '{b}' were not made alike; name others with --features"
                    );
                }

                if stored.features(name).is_none() {
                    bail!(
                        "room '{}' has no features '{name}', which room '{}' has",
                        stored.room.id(),
                        rooms[0].room.id()
                    );
                }
            }
        }

        Ok(names)
    }

    fn scores(&self, stored: &StoredRoom, features: &Features) -> anyhow::Result<LayerScores> {
        let room = &stored.room;
        let rows = features.rows();

        let knn = MutualKnn {
            frames: self.m1_frames,
            stride: self.m1_stride,
            k: self.m1_k,
            exclusion: self.m1_exclusion,
            ..MutualKnn::default()
        };

        let m1 = mutual_knn(rows, room.poses(), &knn)?;
        let m2: IntrinsicDimension = intrinsic_dimension(rows, self.m2_gap, Duplicates::DropRows)?;
        let m3: MotionScores = ridge_probe(rows, room, self.split.into(), self.stride)?;

        let adapters: Vec<MotionScores> = (0..self.seeds)
            .into_par_iter()
            .map(|seed| self.adapter(stored, features, seed))
            .collect::<anyhow::Result<_>>()?;
        let runs: Vec<f64> = adapters.iter().map(|scores| scores.overall).collect();

        let adapters = MotionScores::mean(&adapters);
        Ok(LayerScores {
            features: features.source().name.clone(),
            room: room_name(room),
            dim: features.source().dim,
            m1,
            m2_two_nn: m2.two_nn.linear,
            m2_mle: m2.mle_biased.harmonic,
            m2_dropped: m2.dropped,
            m3_r2: m3.overall,
            encoder: features.source().encoder.clone(),
            m4_r2: mean(&runs),
            m4_translation: adapters.translation,
            m4_rotation: adapters.rotation,
            m4_deviation: deviation(&runs),
            m4_runs: runs,
        })
    }

    fn adapter(
        &self,
        stored: &StoredRoom,
        features: &Features,
        seed: u64,
    ) -> anyhow::Result<MotionScores> {
        let mut recipe = Recipe::of(self.preset.into(), self.split.into(), self.stride, seed);
        recipe.config.epochs = self.epochs.unwrap_or(recipe.config.epochs);

        let lesson = Lesson {
            room: &stored.room,
            revision: stored.revision,
            features,
        };

        Ok(learn(&[lesson], &recipe, &mut |_| ())?.1.test)
    }
}

fn room_name(room: &Room) -> String {
    room.id().to_string()
}

//! `seese3 sweep layers`: M1 to M4 of every layer of an encoder's features.

use std::collections::BTreeMap;

use anyhow::{Context, bail, ensure};
use clap::Args;
use rayon::prelude::*;

use super::super::named::one_of;
use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::super::protocol::{SplitChoice, split_choice};
use crate::table_files::TableFiles;
use seese3_core::adapter::Preset;
use seese3_core::features::Features;
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};
use seese3_lab::experiments::layers::{LayerProtocol, LayerScores, score_layer};
use seese3_lab::probes::MutualKnn;
use seese3_lab::report::{encoders_table, layers_table};
use seese3_store::{Store, StoredRoom};

#[derive(Debug, Args)]
pub struct Layers {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The room; give it several times for means over rooms
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Feature sets by name, or by the part of their names before a hyphen; all of the room's if
    /// omitted
    #[arg(long, value_delimiter = ',')]
    features: Vec<String>,
    /// Frames from the source to the target of a pair, in M3 and M4
    #[arg(long, default_value_t = 40)]
    stride: u32,
    /// How frames are split into training and test, in M3 and M4
    #[arg(long, value_parser = split_choice(), default_value = "time")]
    split: SplitChoice,
    /// Training preset of M4
    #[arg(long, value_parser = one_of::<Preset>(), default_value = "paper-base")]
    preset: Preset,
    /// Epochs of M4, instead of the preset's
    #[arg(long)]
    epochs: Option<usize>,
    /// Number of adapters that M4 trains, with seeds from 0 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// Number of frames that M1 compares
    #[arg(long, default_value_t = 256)]
    m1_frames: usize,
    /// Stride between the frames that M1 compares
    #[arg(long, default_value_t = 1)]
    m1_stride: usize,
    /// Neighbors of a frame in M1, k
    #[arg(long, default_value_t = 10)]
    m1_k: usize,
    /// Frames to each side that do not count as neighbors, in M1
    #[arg(long, default_value_t = 10)]
    m1_exclusion: usize,
    /// Frames to each side that do not count as neighbors, in M2. 0 measures the dimension of the
    /// camera path rather than that of the room
    #[arg(long, default_value_t = 10)]
    m2_gap: usize,
    /// Also print one line per encoder, with its best layer by the scores shown, to compare
    /// checkpoints of one encoder
    #[arg(long)]
    by_encoder: bool,
    /// The paper's comparison of checkpoints (App. A.8): --by-encoder with M1 at stride 5, M4 by
    /// paper-range with 15 seeds
    #[arg(long, conflicts_with_all = ["preset", "seeds", "m1_stride", "by_encoder"])]
    ablation: bool,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl Layers {
    #[expect(
        clippy::too_many_lines,
        reason = "one command, from its arguments to what it prints"
    )]
    pub async fn run(mut self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        if self.ablation {
            self.by_encoder = true;
            self.m1_stride = 5;
            self.preset = Preset::PaperRange;
            self.seeds = 15;
        }

        ensure!(
            self.split != SplitChoice::One(Split::Whole),
            "--split whole has no test pairs; choose another split"
        );

        let store = Store::open(&self.store)?;
        let mut rooms = Vec::new();
        for room in &self.rooms {
            rooms.push(store.load_room(room, None).await?);
        }

        // The same room twice would count twice in the means.
        if let Some(twice) = self
            .rooms
            .iter()
            .enumerate()
            .find(|(i, room)| self.rooms[..*i].contains(room))
        {
            bail!("room '{}' was given twice", twice.1);
        }

        let names = self.names(&rooms)?;

        // One task per layer and room; the table takes the means over rooms.
        let tasks: Vec<(usize, &StoredRoom, &Features)> = (0..names.len())
            .flat_map(|layer| rooms.iter().map(move |room| (layer, room)))
            .filter_map(|(layer, room)| Some((layer, room, room.features(&names[layer])?)))
            .collect();
        let protocol = self.layer_protocol();
        let progress = bar(tasks.len() as u64, "layers");

        let scored: Vec<(usize, LayerScores)> = tasks
            .into_par_iter()
            .map(|(layer, stored, features)| {
                // An error names its room and features, since tasks run in parallel.
                let what = || {
                    format!(
                        "room '{}', features '{}'",
                        stored.room.id(),
                        features.source().name
                    )
                };

                let data = RoomData {
                    room: &stored.room,
                    revision: stored.revision,
                    features,
                };
                let scores = score_layer(&data, &protocol).with_context(what)?;
                progress.inc(1);

                Ok((layer, scores))
            })
            .collect::<anyhow::Result<_>>()?;

        progress.finish_and_clear();
        let scores: Vec<LayerScores> = scored.into_iter().map(|(_, scores)| scores).collect();
        let split = self.split.name();
        let preset = self.preset;

        // Print the protocol with the table.
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

        self.files
            .say(&layers_table(&scores), "layers: means over rooms")?;
        if self.by_encoder {
            say(encoders_table(&scores));
        }

        say(
            "* the best: M1 highest, M2 nearest to 6 (SE(3)), M3 and M4 highest and above the constant; by more than \
             the deviation over rooms and seeds",
        );
        self.json.write(&BTreeMap::from([("layers", scores)]))?;

        Ok(())
    }

    /// Names of the selected feature sets. Every room must have them, with the same source.
    fn names(&self, rooms: &[StoredRoom]) -> anyhow::Result<Vec<String>> {
        // `dinov2` selects `dinov2-7` and `dinov2-9`, but not `dinov2b-7`.
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

        // A name that matches nothing is a typo, and must not be ignored.
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

        // A mean over rooms needs the same encoder, layer and pooling in each of them.
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
                        "features '{name}' of rooms '{a}' and '{b}' have different sources; choose others with --features"
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

    fn layer_protocol(&self) -> LayerProtocol {
        let splits = self.split.splits();
        let mut plan = TrainingPlan::of(self.preset, splits[0], self.stride, 0);
        if let Some(epochs) = self.epochs {
            plan.config.epochs = epochs;
            plan.least_steps = 0;
        }

        LayerProtocol {
            mutual_knn: MutualKnn {
                frames: self.m1_frames,
                stride: self.m1_stride,
                k: self.m1_k,
                exclusion: self.m1_exclusion,
                ..MutualKnn::default()
            },
            gap: self.m2_gap,
            plan,
            splits,
            seeds: self.seeds,
        }
    }
}

//! `seese3 cross-room`: train on some rooms, navigate zero-shot in others.

use anyhow::{Context, bail, ensure};
use clap::Args;
use serde::Serialize;

use super::evaluate::navigators_named;
use super::named::one_of;
use super::output::say;
use super::progress::bar;
use super::protocol::{ProtocolOptions, ReaderOptions};
use super::rooms::{data, load_rooms, room_words};
use super::store_option::StoreAndJson;
use crate::errors_file::ErrorsFile;
use crate::table_files::TableFiles;
use seese3_core::adapter::CellLayout;
use seese3_core::eval::{Protocol, check_thresholds};
use seese3_core::features::Features;
use seese3_core::navigation::{NavigatorKind, RetrievalMetric, StepKind};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};
use seese3_lab::experiments::cross_room::{
    CrossRoomPlan, CrossRoomProgress, CrossRoomRun, nested_choice, train_and_test,
};
use seese3_lab::report::{
    CrossRoomJson, cross_room_errors_file, cross_room_json, cross_room_table, rooms_table,
    scaling_table,
};
use seese3_store::StoredRoom;

#[derive(Debug, Args)]
pub struct CrossRoom {
    #[command(flatten)]
    common: StoreAndJson,
    #[command(flatten)]
    files: TableFiles,
    /// Training rooms: names, or patterns with *; may be given several times
    #[arg(long, required = true)]
    train: Vec<String>,
    /// Held-out rooms to evaluate in: names, or patterns with *; may be given several times
    #[arg(long, required = true)]
    test: Vec<String>,
    /// Name of the feature set, the same for every room; may be omitted when the first training
    /// room has only one. Several names, separated by commas, are joined column by column
    #[arg(long)]
    features: Option<String>,
    /// Room counts of the scaling curve, separated by commas; each count includes the
    /// --calibration-rooms rooms. All rooms of --train if omitted
    #[arg(long, value_delimiter = ',')]
    sizes: Vec<usize>,
    /// Number of rooms in each count that are used for calibration instead of training: the
    /// adapter's errors are measured there for +calibrated navigators
    #[arg(long, default_value_t = 0)]
    calibration_rooms: usize,
    /// Number of adapters trained per room count, with seeds --seed, --seed + 1, …; 1 to 1000
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// First seed, at most 1000000: decides initial weights, drawn pairs and their order, and which
    /// rooms each count takes
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    seed: u64,
    #[command(flatten)]
    protocol: ProtocolOptions,
    #[command(flatten)]
    reader: ReaderOptions,
    /// Split of the held-out rooms: selects the test pairs and the candidate frames for retrieval
    #[arg(long, value_parser = one_of::<Split>(), default_value = "whole")]
    test_split: Split,
    /// Navigators by name, separated by commas; if omitted: identity, inverse Poincaré (affine and
    /// homogeneous; with --calibration-rooms also +calibrated) and the ridge refits that the test
    /// split allows; with --reader also relational
    #[arg(long, value_delimiter = ',')]
    navigators: Vec<String>,
    /// Baseline navigator that the others' Hit@ε is compared with
    #[arg(long, default_value = "inverse-poincare-affine")]
    baseline: String,
    /// ε of Hit@ε: the largest ‖ΔP_target − ΔP_retrieved‖ that counts as a hit, meters and radians
    /// mixed
    #[arg(long, default_value_t = 0.1)]
    threshold: f64,
    /// Never retrieve the source frame
    #[arg(long)]
    exclude_source: bool,
    #[command(flatten)]
    errors: ErrorsFile,
    /// Also print a table with one line per held-out room
    #[arg(long)]
    rooms: bool,
}

/// Inverse Poincaré in the homogeneous reading.
const INVERSE: &str = "inverse-poincare-homogeneous";

type Loaded = (StoredRoom, Features);

/// Content of the --json file: the results and the protocol that they were measured with.
#[derive(Debug, Serialize)]
struct CrossRoomRecord {
    #[serde(flatten)]
    results: CrossRoomJson,
    features: String,
    stride: u32,
    preset: &'static str,
    epochs: usize,
    learning_rate: f64,
    split: &'static str,
    source_excluded: bool,
    test_split: &'static str,
    threshold: f64,
}

impl CrossRoom {
    #[expect(
        clippy::too_many_lines,
        reason = "one command, from its arguments to what it prints"
    )]
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        self.files.begin()?;
        self.errors.begin()?;
        let train = load_rooms(&store, &self.train, self.features.as_deref()).await?;
        let source = train[0].1.source().name.clone();

        // All rooms are loaded with one feature set, that of the first training room: an adapter
        // only fits the features it was trained on.
        let test = load_rooms(&store, &self.test, Some(&source)).await?;
        // Found now, not after the training of the adapter.
        if self.reader.relational(self.seed).is_some() {
            CellLayout::of(train[0].1.source())?;
        }
        let shared = |(room, _): &&Loaded| {
            test.iter()
                .any(|(other, _)| other.room.id() == room.room.id())
        };

        // A room on both sides would turn zero-shot transfer into memorization.
        if let Some((room, _)) = train.iter().find(shared) {
            bail!(
                "room '{}' is in both --train and --test; leave it out of one",
                room.room.id()
            );
        }

        // Validate everything before the first adapter is trained.
        let sizes = self.sizes(train.len())?;
        let protocol = self.test_protocol()?;
        check_thresholds(&protocol.thresholds)?;
        let plan = self.protocol.plan(self.seed)?;
        let progress = bar(
            (sizes.len() as u64)
                * self.seeds
                * (plan.config.epochs + self.reader.epochs() + test.len()) as u64,
            "epochs and rooms",
        );

        let held_out: Vec<RoomData<'_>> = test.iter().map(data).collect();
        let mut runs = Vec::new();
        for &size in &sizes {
            for seed in self.seed..self.seed + self.seeds {
                // With one seed, a smaller count is a subset of a larger one, so that the curve
                // shows the effect of adding rooms.
                let chosen: Vec<RoomData<'_>> = nested_choice(size, train.len(), seed)
                    .into_iter()
                    .map(|room| data(&train[room]))
                    .collect();

                let result = train_and_test(
                    &chosen,
                    &held_out,
                    &CrossRoomPlan {
                        training: &plan.with_seed(seed),
                        relational: self.reader.relational(seed),
                        calibration_rooms: self.calibration_rooms,
                        protocol: &protocol,
                    },
                    &CrossRoomProgress {
                        epoch: &|| progress.inc(1),
                        room: &|| progress.inc(1),
                    },
                )?;
                runs.push(result.run);
            }
        }

        progress.finish_and_clear();

        // Held-out rooms may be skipped, for example if they are too short for the stride. A run
        // that skipped all of them has no results.
        if let Some(first) = runs
            .iter()
            .find(|run| run.outcomes.is_empty())
            .and_then(|run| run.skipped.first())
        {
            let (room, why) = (&first.room, &first.why);
            bail!("no held-out room could be evaluated; room '{room}': {why}");
        }

        self.say(&train, &test, &plan, &runs)?;
        self.errors.write(|| cross_room_errors_file(&runs))?;

        // The record includes the protocol, which is needed to interpret the scores.
        if self.common.json.is_wanted() {
            let record = CrossRoomRecord {
                results: cross_room_json(&runs, &self.baseline),
                features: source,
                stride: plan.stride,
                preset: plan.preset.name(),
                epochs: plan.config.epochs,
                learning_rate: plan.config.learning_rate,
                split: plan.split.name(),
                source_excluded: self.exclude_source,
                test_split: protocol.split.name(),
                threshold: self.threshold,
            };
            self.common.json.write(&record)?;
        }

        Ok(())
    }

    fn sizes(&self, rooms: usize) -> anyhow::Result<Vec<usize>> {
        let sizes = if self.sizes.is_empty() {
            ensure!(
                self.calibration_rooms < rooms,
                "--calibration-rooms: {} of {rooms} rooms of --train leave none to train on",
                self.calibration_rooms
            );
            vec![rooms]
        } else {
            self.sizes.clone()
        };

        // A count includes the calibration rooms, and at least one room has to be left for
        // training.
        for &size in &sizes {
            if size <= self.calibration_rooms || size > rooms {
                bail!(
                    "--sizes: {size} rooms must be more than --calibration-rooms, {}, and at most {rooms}",
                    self.calibration_rooms
                );
            }
        }

        Ok(sizes)
    }

    fn test_protocol(&self) -> anyhow::Result<Protocol> {
        // Default table: the Identity baseline, inverse Poincaré, and the refits that the test
        // split allows.
        let mut names = self.navigators.clone();
        if names.is_empty() {
            names = ["identity", "inverse-poincare-affine", INVERSE]
                .map(str::to_owned)
                .to_vec();

            if self.calibration_rooms > 0 {
                names.push(format!("{INVERSE}+calibrated"));
            }

            // A refit is fitted on training pairs of the held-out room; the split `whole` has none.
            // The in-sample refit uses the test pairs instead.
            if self.test_split != Split::Whole {
                names.push("ridge-refit-z-scored".to_owned());
            }
            names.push("ridge-refit-z-scored-in-sample".to_owned());

            if self.reader.relational(self.seed).is_some() {
                names.push(NavigatorKind::Relational.name());
            }
        }
        let mut navigators = navigators_named("--navigators", &names)?;

        // Reject navigators that no held-out room can evaluate; otherwise every room would be
        // skipped after the training.
        for kind in &navigators {
            match kind {
                NavigatorKind::Step(StepKind::Corrector(_), _) => {
                    bail!("--navigators: this command trains no correctors; leave them out")
                }
                NavigatorKind::Step(_, RetrievalMetric::Calibrated)
                    if self.calibration_rooms == 0 =>
                {
                    bail!(
                        "--navigators: '{}' needs calibration rooms; give --calibration-rooms N",
                        kind.name()
                    );
                }
                NavigatorKind::Step(StepKind::Refit(refit), _)
                    if !refit.in_sample && self.test_split == Split::Whole =>
                {
                    bail!(
                        "--navigators: '{}' needs training pairs, and --test-split whole has none",
                        kind.name()
                    );
                }
                NavigatorKind::Relational if self.reader.relational(self.seed).is_none() => {
                    bail!("--navigators: 'relational' needs a reader; give --reader relational");
                }
                _ => {}
            }
        }

        let baseline = NavigatorKind::from_name(&self.baseline).with_context(|| {
            format!(
                "--baseline: '{}' is not one of {}",
                self.baseline,
                NavigatorKind::known_names()
            )
        })?;

        // The tables need both rows: wins are counted against Identity, differences against the
        // baseline.
        for needed in [NavigatorKind::Identity, baseline] {
            if !navigators.contains(&needed) {
                navigators.push(needed);
            }
        }

        // Each test motion is one open-loop step, as in the paper.
        Ok(Protocol {
            split: self.test_split,
            thresholds: vec![self.threshold],
            // Radius 0: only the source frame itself is excluded, not its neighbors in time.
            exclude_source: self.exclude_source.then_some(0),
            navigators,
            ..Protocol::paper(self.protocol.plan(self.seed)?.stride)
        })
    }

    fn say(
        &self,
        train: &[Loaded],
        test: &[Loaded],
        plan: &TrainingPlan,
        runs: &[CrossRoomRun],
    ) -> anyhow::Result<()> {
        say(format_args!(
            "trained on {}, features '{}', preset {} with {} epochs, split {}; held out: {}, stride {}, split \
             {}, source {}",
            room_words(train),
            train[0].1.source().name,
            plan.preset.name(),
            plan.config.epochs,
            plan.split,
            room_words(test),
            plan.stride,
            self.test_split,
            if self.exclude_source {
                "excluded"
            } else {
                "included"
            },
        ));

        for run in runs {
            for skipped in &run.skipped {
                let (room, why) = (&skipped.room, &skipped.why);
                say(format_args!("room '{room}' was skipped: {why}"));
            }
        }

        // With several room counts or seeds, the scaling curve comes first: one line per run.
        if runs.len() > 1 {
            say(scaling_table(runs, &self.baseline, self.threshold));
        }

        // Only the last run is printed by navigator and by room; the JSON file has every run.
        let last = runs.last().context("no run")?;
        say(format_args!(
            "the last run: {} training rooms, {} calibration rooms, seed {}:",
            last.training_rooms.len(),
            last.calibration_rooms.len(),
            last.seed
        ));

        let table = cross_room_table(last, &self.baseline, self.threshold);
        self.files.say(&table, "held-out rooms")?;
        if self.rooms {
            say(rooms_table(last));
        }

        Ok(())
    }
}

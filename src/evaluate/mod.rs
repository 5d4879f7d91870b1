//! `seese3 evaluate`: the paper's navigation table on a room's held-out pairs, and the errors of
//! estimated trajectories.

mod keypoint_views;
mod localization;
mod motion;
mod odometry;
mod planning;
mod recordings;
mod robustness;
mod room_images;
mod peer;
mod trajectory;

pub use keypoint_views::KeypointViews;
pub use recordings::Recordings;

use std::ffi::OsStr;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, bail, ensure};
use clap::{Args, Subcommand};

use super::named::one_of;
use super::output::{JsonOutput, STANDARD_OUTPUT, begin_output, say, write_file};
use super::progress::bar;
use crate::errors_file::{ErrorsFile, parquet};
use crate::table_files::{plot_file, table_file, write_plot};
use seese3_core::adapter::TrainingRecord;
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{
    Baselines, Leak, Protocol, Report, TestPairs, TrainedOn, evaluate, has_seen, is_calibrated_in,
};
use seese3_core::features::Features;
use seese3_core::motion_scores::MotionScores;
use seese3_core::navigation::NavigatorKind;
use seese3_core::navigation::{IndexKind, Mode, Navigator, SHORTLIST};
use seese3_core::room::RoomId;
use seese3_core::splits::Split;
use seese3_core::training::{motions, predictions};
use seese3_lab::report::{
    AdapterJson, EvaluationContext, MotionBaselines, RoomJson, baselines_text, curve_thresholds,
    evaluation_csv, evaluation_json, evaluation_latex, evaluation_markdown, evaluation_table,
    hit_curves, report_at, retrieval_errors_file,
};
use seese3_store::adapter_choice::{
    EvaluatedRoom, EvaluationCandidate, NoDefault, for_evaluation, serving_room,
};
use seese3_store::{Store, StoredAdapter, StoredRoom};

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Evaluate {
    #[command(subcommand)]
    what: Option<What>,
    #[command(flatten)]
    navigation: Option<Navigation>,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Track held-out frames of rooms: path errors, covariances, tracking status, relocalization
    Odometry(odometry::Odometry),
    /// Localize single views in a partly mapped room by their keypoints, or by an adapter; the
    /// baselines are the nearest frame and a blend of three
    Localization(localization::Localization),
    /// Estimate the motion between two views of a room; the baselines are zero motion and the mean
    /// motion
    Motion(motion::Motion),
    /// Plan paths from unmapped views to mapped goals; the baselines are greedy search, a pose
    /// graph and a topological graph
    Planning(planning::Planning),
    /// Track held-out frames with rotated, blurred, darkened, occluded, frozen or dropped images;
    /// the baselines are the nearest frame and standing still
    Robustness(robustness::Robustness),
    /// APE and RPE of an estimated trajectory against the true one, as evo defines them
    Trajectory(trajectory::EvaluateTrajectory),
}

fn at_least_one() -> clap::builder::RangedU64ValueParser<usize> {
    clap::builder::RangedU64ValueParser::new().range(1..)
}

/// Prints which rooms the adapter was trained or calibrated on.
fn say_leaks(rooms: &[(StoredRoom, Features)], record: &TrainingRecord) {
    for (room, _) in rooms {
        let room = room.room.id();
        if has_seen(record, room) {
            say(format_args!("LEAK: the adapter has seen room '{room}'"));
        }
    }
}

impl Evaluate {
    pub async fn run(self) -> anyhow::Result<()> {
        match (self.what, self.navigation) {
            (Some(What::Odometry(odometry)), _) => odometry.run().await,
            (Some(What::Localization(localization)), _) => localization.run().await,
            (Some(What::Motion(motion)), _) => motion.run().await,
            (Some(What::Planning(planning)), _) => planning.run().await,
            (Some(What::Robustness(robustness)), _) => robustness.run().await,
            (Some(What::Trajectory(trajectory)), _) => trajectory.run(),
            (None, Some(navigation)) => navigation.run().await,
            (None, None) => {
                bail!("name a room with --room, or what to evaluate: see `seese3 evaluate --help`")
            }
        }
    }
}

/// Options of the navigation table.
#[derive(Debug, Args)]
struct Navigation {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// Name of its feature set; by default the one that the adapter was trained on
    #[arg(long)]
    features: Option<String>,
    /// Name of the adapter; by default the one set for the room, else one that was trained in the
    /// room, else the newest, if the test pairs are held out from it. An adapter from `fit` must be
    /// named
    #[arg(long)]
    adapter: Option<String>,
    /// Frames from the source to the target of a pair; by default as the adapter was trained
    #[arg(long)]
    stride: Option<u32>,
    /// How frames are split into training and test; by default as the adapter was trained
    #[arg(long, value_parser = one_of::<Split>())]
    split: Option<Split>,
    /// Never retrieve the source frame
    #[arg(long)]
    exclude_source: bool,
    /// ε of Hit@ε, separated by commas
    #[arg(long, value_delimiter = ',', default_values_t = seese3_core::navigation::HIT_THRESHOLDS)]
    thresholds: Vec<f64>,
    /// Navigators, the rows of the table, by name, separated by commas: identity, random, oracle,
    /// relational, inverse-poincare-affine, ridge-refit, …; +row-space, +whitened or
    /// +motion may follow the name of a step, and +calibrated may follow
    /// inverse-poincare-homogeneous
    #[arg(long, value_delimiter = ',')]
    navigators: Vec<String>,
    /// Number of equal steps that each motion is divided into, 1 to 1000
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    steps: u32,
    /// How the steps are chained
    #[arg(long, value_parser = one_of::<Mode>(), default_value = "open-loop")]
    mode: Mode,
    /// Number of frames that the relational reader compares with the source: those nearest by
    /// inverse Poincaré
    #[arg(long, default_value_t = SHORTLIST, value_parser = at_least_one())]
    shortlist: usize,
    /// Seed of the random navigator
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Plot Hit@ε against ε up to 1 to this file, .svg, .pdf or .png: one curve per navigator.
    /// In-sample refits and other metrics are drawn only if --navigators names them
    #[arg(long, value_name = "FILE", value_parser = plot_file)]
    plot: Option<PathBuf>,
    /// Also write the table to this file: .csv for programs, .tex for LaTeX with booktabs, .md for
    /// Markdown
    #[arg(long, value_name = "FILE", value_parser = table_file)]
    table: Option<PathBuf>,
    /// Also write the errors of every navigator on every pair to this Parquet file
    #[arg(long, value_name = "FILE.parquet", value_parser = parquet)]
    errors: Option<PathBuf>,
    // Not flattened: clap could no longer detect whether any option of the table was given.
    /// Also write the results as JSON to this file. With "-" or no value, JSON goes to standard
    /// output, and no text is printed
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = STANDARD_OUTPUT)]
    json: Option<PathBuf>,
}

impl Navigation {
    #[expect(
        clippy::too_many_lines,
        reason = "one command, from its arguments to what it prints"
    )]
    async fn run(self) -> anyhow::Result<()> {
        let json = JsonOutput::to(self.json.clone());
        json.begin()?;
        let errors = ErrorsFile::to(self.errors.clone());
        errors.begin()?;
        for file in self.plot.iter().chain(&self.table) {
            begin_output(file)?;
        }

        let store = Store::open(&self.store)?;
        let chosen = choose(&store, &self).await?;

        // By default, the features are those that the adapter was trained on.
        let features_name = self
            .features
            .clone()
            .unwrap_or_else(|| chosen.adapter.source().name.clone());
        let (stored, features) = store
            .load_room_with(&self.room, Some(&features_name))
            .await?;

        let record = chosen.record.clone();
        let protocol = self.protocol(&record)?;
        check_reader(&protocol.navigators, &chosen)?;
        let room = Arc::new(stored.room);
        let navigator = Navigator::new(room, &features, chosen.adapter.clone(), IndexKind::Exact)
            .with_context(|| {
            format!(
                "features '{features_name}', adapter '{}' of features '{}'",
                chosen.name,
                chosen.adapter.source().name
            )
        })?;

        // Counted before the work starts, since the progress bar needs a total.
        let rows = protocol.rows(&navigator)?.len();
        let progress = bar(rows as u64, "evaluating");

        let report = evaluate(
            &navigator,
            &protocol,
            &Cancellation::default(),
            &mut |done, kind| {
                progress.set_position(done as u64);
                progress.set_message(kind.name());
            },
        )?;

        progress.finish_and_clear();

        let trained_on = store
            .trained_on(&record, navigator.room().id(), stored.revision)
            .await?;
        let in_room = trained_on != TrainedOn::Nothing;
        let leak = Leak::of(&record, trained_on, protocol.split);

        // A curve has more thresholds than the table.
        let curves = report.marked(leak, is_calibrated_in(&record, navigator.room().id()));
        let report = report_at(&curves, &self.thresholds);

        say(format_args!(
            "room '{}' revision {}, features '{features_name}', adapter '{}' revision {} ({})",
            self.room,
            stored.revision,
            chosen.name,
            chosen.revision,
            if in_room {
                "trained in this room"
            } else {
                "never saw this room"
            },
        ));

        let side = if self.exclude_source {
            "excluded"
        } else {
            "included"
        };
        say(format_args!(
            "split {}, stride {}: {} test pairs, {} candidate frames, source {side}",
            protocol.split, protocol.stride, report.n, report.candidate_count
        ));

        // Print warnings before the table, where they are not overlooked.
        say_caveats(&protocol, &record, navigator.room().id(), leak);
        say(evaluation_table(&report));

        let learned_here = trained_on == TrainedOn::TheseFrames;
        let motion = motion_baselines(&navigator, &features, &record, &protocol, learned_here)?;
        say(baselines_text(&motion));

        self.write_files(&report, &curves)?;
        errors.write(|| retrieval_errors_file(&self.room, &report.rows))?;
        if json.is_wanted() {
            // The file states what was evaluated and whether it leaks, so that it is
            // self-contained.
            let context = EvaluationContext {
                room: RoomJson {
                    name: self.room.clone(),
                    revision: stored.revision,
                },
                features: features_name,
                adapter: AdapterJson {
                    name: chosen.name,
                    revision: chosen.revision,
                    preset: record.preset,
                    trained_split: record.split.name(),
                    trained_stride: record.stride,
                    seed: record.config.seed,
                },
                in_room,
                leaks: leak.is_some(),
            };
            json.write(&evaluation_json(&report, &motion, context))?;
        }

        Ok(())
    }

    /// The thresholds of the table, and those of the curves if they are drawn.
    fn all_thresholds(&self) -> Vec<f64> {
        let mut all = self.thresholds.clone();
        if self.plot.is_some() {
            all.extend(curve_thresholds());
            all.sort_by(f64::total_cmp);
            all.dedup();
        }
        all
    }

    /// Writes the table and the curves to the requested files.
    fn write_files(&self, report: &Report, curves: &Report) -> anyhow::Result<()> {
        if let Some(file) = &self.table {
            let text = match file.extension().and_then(OsStr::to_str) {
                Some("tex") => evaluation_latex(report),
                Some("md") => evaluation_markdown(report),
                _ => evaluation_csv(report),
            };
            write_file(file, text.as_bytes())?;
            say(format_args!("wrote {}", file.display()));
        }

        if let Some(file) = &self.plot {
            let title = format!(
                "{}: {} motions over {} frames, split {}",
                self.room, report.n, report.protocol.stride, report.protocol.split
            );
            let mut drawn = hit_curves(curves, title);
            if self.navigators.is_empty() {
                // Other retrieval metrics and in-sample navigators would hide the other curves.
                let is_plain = |name: &str| !name.contains('+') && !name.contains("-in-sample");
                drawn.series.retain(|series| is_plain(&series.name));
            }
            write_plot(file, drawn.svg()?)?;
        }
        Ok(())
    }

    /// The protocol from the options; split and stride default to those of the adapter's training.
    fn protocol(&self, record: &TrainingRecord) -> anyhow::Result<Protocol> {
        Ok(Protocol {
            split: self.split.unwrap_or(record.split),
            stride: self.stride.unwrap_or(record.stride),
            exclude_source: self.exclude_source.then_some(0),
            thresholds: self.all_thresholds(),
            seed: self.seed,
            steps: self.steps,
            mode: self.mode,
            shortlist: self.shortlist,
            navigators: navigators_named("--navigators", &self.navigators)?,
        })
    }
}

/// Scores of the adapter's motion estimates on the test pairs, and of trivial baselines.
fn motion_baselines(
    navigator: &Navigator,
    features: &Features,
    record: &TrainingRecord,
    protocol: &Protocol,
    learned_here: bool,
) -> anyhow::Result<MotionBaselines> {
    let room = navigator.room();
    let adapter = navigator.adapter();
    let test = TestPairs {
        split: protocol.split,
        stride: protocol.stride,
    };

    let pairs = test.split.test_pairs(room.timeline(), test.stride)?;
    let predicted = predictions(adapter, features.rows(), &pairs)?;
    Ok(MotionBaselines {
        motion: MotionScores::of(&motions(room.poses(), &pairs), &predicted),
        baselines: Baselines::of(
            adapter.scale(),
            record.optimizer_steps(),
            room,
            &test,
            learned_here,
        )?,
    })
}

/// Prints the caveats of the table: several steps per motion, and leaks.
fn say_caveats(protocol: &Protocol, record: &TrainingRecord, room: &RoomId, leak: Option<Leak>) {
    if protocol.steps > 1 {
        say(format_args!(
            "{} equal parts of each motion, {}",
            protocol.steps,
            protocol.mode.name()
        ));
    }

    // The calibrated metric uses errors measured on the same poses that it is tested on.
    if is_calibrated_in(record, room) {
        say(
            "LEAK: the adapter's errors were measured in this room; +calibrated has seen its poses",
        );
    }

    let why = match leak {
        None => return,
        Some(Leak::OtherFrames) => "on other frames of this room".to_owned(),
        Some(Leak::Split) => format!("under the split '{}'", record.split),
    };
    say(format_args!(
        "LEAK: the adapter was trained {why}; test pairs may have been trained on"
    ));
}

/// The navigators with these names, which `option` gave; the error lists the known names.
pub fn navigators_named(option: &str, names: &[String]) -> anyhow::Result<Vec<NavigatorKind>> {
    let named = |name: &String| {
        let unknown = || {
            format!(
                "{option}: '{name}' is not one of {}",
                NavigatorKind::known_names()
            )
        };
        NavigatorKind::from_name(name).with_context(unknown)
    };

    names.iter().map(named).collect()
}

/// Refuses the relational navigator for an adapter without a reader.
pub fn check_reader(navigators: &[NavigatorKind], stored: &StoredAdapter) -> anyhow::Result<()> {
    let asks = navigators.contains(&NavigatorKind::Relational);
    ensure!(
        !asks || stored.adapter.relational().is_some(),
        "adapter '{}' has no relational reader: name one that has with --adapter (`seese3 store list` says which), or \
         train one with --reader relational",
        stored.name
    );
    Ok(())
}

/// The named adapter, else the default adapter of an evaluation of this room: the one that a server
/// takes.
async fn choose(store: &Store, wanted: &Navigation) -> anyhow::Result<StoredAdapter> {
    if let Some(name) = &wanted.adapter {
        return Ok(store.load_adapter(name, None).await?);
    }

    // A room that is not there is reported before advice to train on it.
    let summary = store.room_summary(&wanted.room, None).await?;
    let mut sources = summary.features;
    if let Some(name) = &wanted.features {
        sources.retain(|source| source.name == *name);
    }
    if sources.is_empty() {
        bail!(
            "room '{}' has no features{}; encode its images first: `seese3 encode --store {} --room {} --encoder MODEL`",
            wanted.room,
            wanted
                .features
                .as_ref()
                .map_or_else(String::new, |name| format!(" '{name}'")),
            wanted.store,
            wanted.room,
        );
    }

    let defaults = store.defaults().await?;
    let mut adapters = Vec::new();
    for (name, revision) in store.current_adapters(&defaults).await? {
        match store.load_adapter(&name, Some(revision)).await {
            Ok(stored) => adapters.push(Arc::new(stored)),
            // An unreadable adapter must not hide the others.
            Err(error) => say(format_args!("skipped adapter '{name}': {error}")),
        }
    }

    let room = RoomId::new(&wanted.room)?;
    let mut candidates = Vec::new();
    for adapter in serving_room(&adapters, &room, &sources) {
        let record = &adapter.record;
        candidates.push(EvaluationCandidate {
            trained_on: store.trained_on(record, &room, summary.revision).await?,
            adapter,
        });
    }

    let room = EvaluatedRoom {
        room: &wanted.room,
        chosen: defaults.adapter(&wanted.room),
        split: wanted.split,
        stride: wanted.stride,
    };
    match for_evaluation(&candidates, room) {
        Ok(adapter) => Ok(Arc::unwrap_or_clone(adapter)),
        Err(NoDefault::NoneServes { .. }) => bail!(
            "no adapter serves room '{}'; the store has {}; train one with `seese3 train --store {} --room {}`",
            wanted.room,
            match adapters.as_slice() {
                [] => "none".to_owned(),
                known => {
                    let names: Vec<&str> = known.iter().map(|known| known.name.as_str()).collect();
                    names.join(", ")
                }
            },
            wanted.store,
            wanted.room,
        ),
        Err(error) => Err(anyhow::Error::new(error).context("--adapter")),
    }
}

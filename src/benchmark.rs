//! `seese3 benchmark`: freezes rooms and pairs, answers them, scores what others retrieve, and
//! measures features in the frozen rooms.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::{Args, Subcommand};

use super::evaluate::{check_reader, navigators_named};
use super::named::one_of;
use super::output::{
    JsonOutput, begin_input, begin_output, say, write_compact_json, write_file, write_json,
};
use super::progress::bar;
use super::rooms::{data, room_names};
use crate::table_files::{TableFiles, markdown_file};
use seese3_core::adapter::TrainingRecord;
use seese3_core::cancel::Cancellation;
use seese3_core::eval::{Protocol, evaluate, has_seen};
use seese3_core::geometry::Pose;
use seese3_core::navigation::{IndexKind, Navigator, NavigatorKind};
use seese3_core::room::RoomId;
use seese3_core::splits::{Pair, Split};
use seese3_lab::benchmark::{
    Benchmark, BenchmarkScores, Described, Error, FeatureMetrics, MetricMeans, RoomMetrics,
    Submission, check_description, check_submission_text, score,
};
use seese3_lab::report::{benchmark_page, benchmark_table, metrics_page, metrics_table};
use seese3_store::Store;

/// Largest benchmark or submission that is read, bytes.
const MOST_BYTES: u64 = 256 << 20;

/// Freeze rooms and pairs as a benchmark, score submissions, and compare encoders in its rooms
#[derive(Debug, Args)]
pub struct BenchmarkCommand {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Write the test pairs of rooms to a file, with the SHA-256 of their poses
    Freeze(Freeze),
    /// Write what a stored adapter retrieves for a benchmark as a submission
    Answer(Answer),
    /// Check submissions against a benchmark, without its rooms
    Check(Check),
    /// Score submissions: Hit@ε over rooms beside standing still, with intervals
    Score(Score),
    /// Measure M1 to M4 of features in the rooms of a benchmark, by one fixed protocol
    Probe(ProbeFeatures),
    /// Compare the features of several files of `benchmark probe`
    Encoders(Encoders),
}

#[derive(Debug, Args)]
struct Freeze {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The rooms: names, or patterns with *
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Split that defines the test pairs and the candidate frames
    #[arg(long, value_parser = one_of::<Split>(), default_value = "whole")]
    split: Split,
    /// Frames from the source to the target of a pair
    #[arg(long, default_value_t = 25, value_parser = clap::value_parser!(u32).range(1..))]
    stride: u32,
    /// Name of the benchmark
    #[arg(long)]
    name: String,
    /// The benchmark file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Answer {
    /// The benchmark file
    #[arg(long, value_name = "FILE")]
    benchmark: PathBuf,
    /// The store with its rooms and the adapter
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The adapter
    #[arg(long)]
    adapter: String,
    /// The navigator, a name of `evaluate`
    #[arg(long, default_value = "inverse-poincare-affine")]
    navigator: String,
    /// Name of the method
    #[arg(long)]
    name: String,
    /// One sentence: the features, what was trained on which rooms, the rule of retrieval
    #[arg(long)]
    about: String,
    /// The submission file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Check {
    /// The benchmark file
    #[arg(long, value_name = "FILE")]
    benchmark: PathBuf,
    /// A submission file; may be given several times
    #[arg(long = "submission", value_name = "FILE", required = true)]
    submissions: Vec<PathBuf>,
}

#[derive(Debug, Args)]
struct Score {
    /// The benchmark file
    #[arg(long, value_name = "FILE")]
    benchmark: PathBuf,
    /// The store with its rooms
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// A submission file; may be given several times
    #[arg(long = "submission", value_name = "FILE", required = true)]
    submissions: Vec<PathBuf>,
    /// Also write a page of results to this Markdown file
    #[arg(long, value_name = "FILE.md", value_parser = markdown_file)]
    page: Option<PathBuf>,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

#[derive(Debug, Args)]
struct ProbeFeatures {
    /// The benchmark file
    #[arg(long, value_name = "FILE")]
    benchmark: PathBuf,
    /// The store with its rooms and their features
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// Name of the feature set, the same for every room
    #[arg(long)]
    features: String,
    /// Name of the features in the table; default: the feature set's name
    #[arg(long)]
    name: Option<String>,
    /// One sentence: the encoder, its weights, the layer and the pooling
    #[arg(long)]
    about: String,
    /// The file of metrics to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Encoders {
    /// The benchmark file
    #[arg(long, value_name = "FILE")]
    benchmark: PathBuf,
    /// A file of `benchmark probe`; may be given several times
    #[arg(long = "metrics", value_name = "FILE", required = true)]
    metrics: Vec<PathBuf>,
    /// Also write a page of the metrics to this Markdown file
    #[arg(long, value_name = "FILE.md", value_parser = markdown_file)]
    page: Option<PathBuf>,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    json: JsonOutput,
}

impl BenchmarkCommand {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Freeze(freeze) => freeze.run().await,
            What::Answer(answer) => answer.run().await,
            What::Check(check) => check.run(),
            What::Score(score) => score.run().await,
            What::Probe(probe) => probe.run().await,
            What::Encoders(encoders) => encoders.run(),
        }
    }
}

impl Freeze {
    async fn run(self) -> anyhow::Result<()> {
        begin_output(&self.out)?;
        ensure!(
            !self.out.exists(),
            "--out: {} exists; a benchmark that was frozen stays as it is. Give another name",
            self.out.display()
        );
        let store = Store::open(&self.store)?;
        let mut rooms = Vec::new();
        for name in room_names(&store, &self.rooms).await? {
            rooms.push(store.load_room(&name, None).await?.room);
        }

        let benchmark = Benchmark::freeze(&self.name, &rooms, self.split, self.stride)?;
        let pairs: usize = benchmark.rooms.iter().map(|room| room.pair_count()).sum();
        say(format_args!(
            "benchmark '{}': {} rooms, {pairs} pairs, SHA-256 {}",
            self.name,
            rooms.len(),
            benchmark.sha256()
        ));
        write_json(&self.out, &benchmark.file())
    }
}

impl Answer {
    async fn run(self) -> anyhow::Result<()> {
        begin_output(&self.out)?;
        let benchmark = read_benchmark(&self.benchmark)?;
        check_submission_text(&self.name, &self.about)?;
        let store = Store::open(&self.store)?;
        let navigators = navigators_named("--navigator", std::slice::from_ref(&self.navigator))?;
        let stored = store.load_adapter(&self.adapter, None).await?;
        check_reader(&navigators, &stored)?;
        check_held_out(&benchmark, &self.adapter, &stored.record, &self.navigator)?;
        let adapter = stored.adapter;
        let protocol = Protocol {
            split: benchmark.split()?,
            navigators,
            ..Protocol::paper(benchmark.stride)
        };

        let progress = bar(benchmark.rooms.len() as u64, "rooms");
        let mut frames = Vec::new();
        for frozen in &benchmark.rooms {
            let features = Some(adapter.source().name.as_str());
            let (stored, features) = store.load_room_with(&frozen.room, features).await?;
            frozen.check_poses(stored.room.poses())?;

            let navigator = Navigator::new(
                Arc::new(stored.room),
                &features,
                adapter.clone(),
                IndexKind::Exact,
            )
            .with_context(|| format!("room '{}'", frozen.room))?;
            let cancel = Cancellation::default();
            let report = evaluate(&navigator, &protocol, &cancel, &mut |_, _| ())?;
            let scored = &report.rows[0].retrieval.pairs;
            let pairs: Vec<Pair> = scored.iter().map(|scored| scored.pair).collect();
            ensure!(
                pairs == frozen.pairs(benchmark.stride),
                "room '{}': this version's split '{}' yields other pairs than the benchmark has; use the version that froze it",
                frozen.room,
                benchmark.split
            );
            frames.push(scored.iter().map(|scored| scored.retrieved.0).collect());
            progress.inc(1);
        }
        progress.finish_and_clear();

        let submission = benchmark.submission(&self.name, &self.about, frames);
        submission.check(&benchmark)?;
        write_compact_json(&self.out, &submission)?;
        say(format_args!("wrote {}", self.out.display()));
        Ok(())
    }
}

/// Refuses answers that use the targets, or frames of the benchmark in training.
fn check_held_out(
    benchmark: &Benchmark,
    adapter: &str,
    record: &TrainingRecord,
    navigator: &str,
) -> anyhow::Result<()> {
    ensure!(
        navigator != NavigatorKind::Oracle.name() && !navigator.contains("in-sample"),
        "--navigator: '{navigator}' uses the targets of the test pairs"
    );
    for frozen in &benchmark.rooms {
        let room = RoomId::new(&frozen.room)?;
        ensure!(
            !has_seen(record, &room),
            "--adapter: '{adapter}' was trained or calibrated on room '{room}' of the benchmark"
        );
    }
    Ok(())
}

impl Check {
    fn run(self) -> anyhow::Result<()> {
        let benchmark = read_benchmark(&self.benchmark)?;
        for file in &self.submissions {
            let submission = read_submission(file, &benchmark)?;
            say(format_args!(
                "{}: '{}' is valid",
                file.display(),
                submission.name
            ));
        }
        Ok(())
    }
}

impl Score {
    async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        self.page.as_deref().map_or(Ok(()), begin_output)?;

        let benchmark = read_benchmark(&self.benchmark)?;
        let mut submissions = Vec::new();
        for file in &self.submissions {
            let submission = read_submission(file, &benchmark)?;
            let is_same = |other: &Submission| other.name == submission.name;
            ensure!(
                !submissions.iter().any(is_same),
                "{}: the name '{}' is in two submissions",
                file.display(),
                submission.name
            );
            submissions.push(submission);
        }

        let store = Store::open(&self.store)?;
        let mut rooms: Vec<Vec<Pose>> = Vec::new();
        for frozen in &benchmark.rooms {
            let stored = store.load_room(&frozen.room, None).await?;
            frozen.check_poses(stored.room.poses())?;
            rooms.push(stored.room.poses().to_vec());
        }

        let poses: Vec<&[Pose]> = rooms.iter().map(Vec::as_slice).collect();
        // Standing still is always in the table.
        let mut all = vec![benchmark.standing_still()];
        all.extend(submissions);
        let mut scores: Vec<BenchmarkScores> = all
            .iter()
            .map(|submission| score(&benchmark, submission, &poses))
            .collect();
        let first_hit =
            |scores: &BenchmarkScores| scores.hits.first().map_or(0.0, |hits| hits.hit.mean);
        scores.sort_by(|a, b| first_hit(b).total_cmp(&first_hit(a)));

        self.files.say(&benchmark_table(&scores), &benchmark.name)?;
        if let Some(page) = &self.page {
            write_page(page, &benchmark_page(&benchmark, &scores))?;
        }
        self.json.write(&serde_json::json!({
            "benchmark": { "name": benchmark.name, "sha256": benchmark.sha256() },
            "submissions": scores,
        }))
    }
}

impl ProbeFeatures {
    async fn run(self) -> anyhow::Result<()> {
        begin_output(&self.out)?;
        let benchmark = read_benchmark(&self.benchmark)?;
        let name = self.name.as_ref().unwrap_or(&self.features);
        check_description(name, &self.about, None)?;
        let store = Store::open(&self.store)?;

        // Check all rooms before minutes of work.
        let mut loaded = Vec::with_capacity(benchmark.rooms.len());
        for frozen in &benchmark.rooms {
            let room = store
                .load_room_with(&frozen.room, Some(&self.features))
                .await?;
            frozen.check_poses(room.0.room.poses())?;
            loaded.push(room);
        }
        let source = loaded[0].1.source().clone();
        for (frozen, (_, features)) in benchmark.rooms.iter().zip(&loaded) {
            ensure!(
                *features.source() == source,
                "room '{}': its features '{}' were made in another way than those of room '{}'",
                frozen.room,
                self.features,
                benchmark.rooms[0].room
            );
        }

        let progress = bar(benchmark.rooms.len() as u64, "probing");
        let mut rooms = Vec::with_capacity(loaded.len());
        for (frozen, loaded) in benchmark.rooms.iter().zip(&loaded) {
            let measured = RoomMetrics::measure(&data(loaded), benchmark.stride);
            rooms.push(measured.with_context(|| format!("room '{}'", frozen.room))?);
            progress.inc(1);
        }
        progress.finish_and_clear();

        let metrics = FeatureMetrics::new(
            &benchmark,
            Described {
                name,
                about: &self.about,
                source,
            },
            rooms,
        );
        metrics.check(&benchmark)?;
        write_json(&self.out, &metrics)?;
        say(metrics_table(&[MetricMeans::of(&metrics)]));
        say(format_args!("wrote {}", self.out.display()));
        Ok(())
    }
}

impl Encoders {
    fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        self.page.as_deref().map_or(Ok(()), begin_output)?;

        let benchmark = read_benchmark(&self.benchmark)?;
        let mut means: Vec<MetricMeans> = Vec::new();
        for file in &self.metrics {
            let metrics = read(file, |bytes| FeatureMetrics::read(bytes, &benchmark))?;
            ensure!(
                means.iter().all(|other| other.name != metrics.name),
                "{}: the name '{}' is in two files",
                file.display(),
                metrics.name
            );
            means.push(MetricMeans::of(&metrics));
        }
        means.sort_by(|a, b| b.m4.mean.total_cmp(&a.m4.mean));

        self.files.say(&metrics_table(&means), &benchmark.name)?;
        if let Some(page) = &self.page {
            write_page(page, &metrics_page(&benchmark, &means))?;
        }
        self.json.write(&serde_json::json!({
            "benchmark": { "name": benchmark.name, "sha256": benchmark.sha256() },
            "features": means,
        }))
    }
}

fn write_page(file: &Path, page: &str) -> anyhow::Result<()> {
    write_file(file, page.as_bytes())?;
    say(format_args!("wrote {}", file.display()));
    Ok(())
}

fn read_benchmark(file: &Path) -> anyhow::Result<Benchmark> {
    read(file, Benchmark::read)
}

fn read_submission(file: &Path, benchmark: &Benchmark) -> anyhow::Result<Submission> {
    read(file, |bytes| Submission::read(bytes, benchmark))
}

/// Reads a file, and then its content. Errors name the file.
fn read<T>(file: &Path, content: impl FnOnce(&[u8]) -> Result<T, Error>) -> anyhow::Result<T> {
    begin_input(file)?;
    let place = file.display();
    let bytes = seese3_files::read(file, MOST_BYTES);
    let bytes = bytes.with_context(|| format!("{place} cannot be read"))?;
    content(&bytes).with_context(|| format!("{place}"))
}

//! `seese3 reproduce`: the paper's tables and figures on given rooms, as one report.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::runtime::Handle;

use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::features::Features;
use seese3_core::image::RgbImage;
use seese3_core::room::{FrameId, Room, is_plain_name};
use seese3_lab::report::Document;
use seese3_lab::reproduction::{
    EXPERIMENTS, FeatureSet, Images, Journal, LayerSet, Options, Reproduced, ReproducedAdapter,
    Reproduction, ReproductionRecord, adapter_names, check, reproduce,
};

use super::made_by;
use super::output::{JsonOutput, say, write_file, write_intermediate, write_json};
use super::progress::bar;
use super::rooms::{data, load_rooms};
use seese3_encoder::{encode_png, read_image};
use seese3_store::{Store, StoredRoom};

#[derive(Debug, Args)]
pub struct Reproduce {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// Rooms that one adapter is trained on together: names, or patterns with *
    #[arg(long, required = true)]
    train: Vec<String>,
    /// Held-out rooms, which no multi-room adapter is trained on: names, or patterns with *
    #[arg(long, required = true)]
    test: Vec<String>,
    /// Rooms that each get their own adapter, for the in-room tables: names, or patterns with *
    #[arg(long = "in-room", required = true)]
    in_room: Vec<String>,
    /// Feature sets that every room has, separated by commas; the last one is the control and
    /// should need no trained encoder
    #[arg(long, required = true, value_delimiter = ',')]
    features: Vec<String>,
    /// Frames from source to target
    #[arg(long, default_value_t = 25)]
    stride: u32,
    /// Strides of the in-room curves
    #[arg(long, value_delimiter = ',', default_values_t = [5, 10, 20, 40])]
    strides: Vec<u32>,
    /// Numbers of training rooms along the scaling curve
    #[arg(long, value_delimiter = ',', default_values_t = [5, 10, 20, 35, 50, 75, 100])]
    sizes: Vec<usize>,
    /// Number of seeds of every adapter that is trained on several rooms; the seed also chooses its
    /// rooms; 1 to 100
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=100))]
    trainings: u64,
    /// Features of several layers of one encoder, separated by commas, to be compared in the rooms
    /// of --in-room
    #[arg(long, value_delimiter = ',')]
    layers: Vec<String>,
    /// Number of training rooms used for calibration, in which the adapter's errors are measured
    #[arg(long, default_value_t = 20)]
    calibration_rooms: usize,
    /// Number of seeds, from 0 on, for tables that average over seeds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Number of seeds for the table of the alternatives A to D; the paper uses 15; 1 to 100
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=100))]
    formulation_seeds: u64,
    /// Epochs of the long training of the alternatives A to D, by which they are judged: 200, the
    /// paper's, take hours; 0 leaves it out
    #[arg(long, default_value_t = 200)]
    formulation_epochs: usize,
    /// Epochs, instead of every preset's own; for a quick trial
    #[arg(long)]
    epochs: Option<usize>,
    /// Folder of the report; created if it does not exist. Its folder `steps` keeps finished parts
    /// and trained adapters: a later run reuses those whose options, rooms and features are the
    /// same
    #[arg(long, default_value = "reproduction")]
    out: PathBuf,
    #[command(flatten)]
    json: JsonOutput,
}

type Loaded = (StoredRoom, Features);

/// The rooms of the three groups, loaded with one feature set.
struct LoadedSet {
    features: String,
    train: Vec<Loaded>,
    test: Vec<Loaded>,
    in_room: Vec<Loaded>,
}

impl LoadedSet {
    fn borrowed(&self) -> FeatureSet<'_> {
        FeatureSet {
            features: self.features.clone(),
            train: self.train.iter().map(data).collect(),
            test: self.test.iter().map(data).collect(),
            in_room: self.in_room.iter().map(data).collect(),
        }
    }
}

/// The in-room rooms with the features of one layer.
struct LoadedLayer {
    features: String,
    rooms: Vec<Loaded>,
}

impl LoadedLayer {
    fn borrowed(&self) -> LayerSet<'_> {
        LayerSet {
            features: self.features.clone(),
            rooms: self.rooms.iter().map(data).collect(),
        }
    }
}

/// Reads the image of a frame from the room's original folder.
fn recorded_image(room: &Room, frame: FrameId) -> Result<RgbImage, String> {
    let root = PathBuf::from(&room.provenance().images_root);
    read_image(&root, &room.images()[frame.row()]).map_err(|error| error.to_string())
}

impl Reproduce {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        let begun = Instant::now();
        let store = Store::open(&self.store)?;
        store.check_writable().await?;
        let sets = self.load(&store).await?;
        let layers = self.load_layers(&store).await?;
        let journal = FolderJournal::open(&self.out.join(STEPS))?;
        let reproduction = Reproduction {
            options: self.options(),
            journal: &journal,
            sets: sets.iter().map(LoadedSet::borrowed).collect(),
            layers: layers.iter().map(LoadedLayer::borrowed).collect(),
            images: Images {
                read: &recorded_image,
                png: &|image| encode_png(image).map_err(|error| error.to_string()),
            },
        };

        // Validate everything before hours of training.
        check(&reproduction)?;
        for name in adapter_names(&reproduction) {
            if !is_plain_name(&name) {
                bail!("adapter name '{name}' is not valid: give shorter --features or --in-room");
            }
        }
        let progress = bar(EXPERIMENTS, "reproduce");
        let begin = |step: &'static str| {
            progress.set_message(step);
            progress.inc(1);
        };
        // The journal waits for its store on this thread.
        let Reproduced {
            document,
            record,
            adapters,
        } = tokio::task::block_in_place(|| reproduce(&reproduction, &begin))?;
        progress.finish_and_clear();

        // A run that fails before this point publishes nothing.
        let published = publish(&store, &adapters).await?;
        let other_commits = journal.other_commits();
        if !other_commits.is_empty() {
            say(format_args!(
                "some parts were made by the program of other commits ({}); to make all of them again, remove {}",
                other_commits.join(", "),
                self.out.join(STEPS).display()
            ));
        }
        let record = FileRecord {
            record,
            adapters: published,
            other_commits,
            seconds: begun.elapsed().as_secs_f64(),
        };

        write(&self.out, &document, &record)?;
        self.json.write(&record)
    }

    fn options(&self) -> Options {
        Options {
            stride: self.stride,
            strides: self.strides.clone(),
            sizes: self.sizes.clone(),
            trainings: self.trainings,
            calibration_rooms: self.calibration_rooms,
            seeds: self.seeds,
            formulation_seeds: self.formulation_seeds,
            formulation_epochs: self.formulation_epochs,
            epochs: self.epochs,
        }
    }

    async fn load(&self, store: &Store) -> anyhow::Result<Vec<LoadedSet>> {
        let mut sets = Vec::new();
        for features in &self.features {
            sets.push(LoadedSet {
                features: features.clone(),
                train: load_rooms(store, &self.train, Some(features)).await?,
                test: load_rooms(store, &self.test, Some(features)).await?,
                in_room: load_rooms(store, &self.in_room, Some(features)).await?,
            });
        }

        Ok(sets)
    }

    async fn load_layers(&self, store: &Store) -> anyhow::Result<Vec<LoadedLayer>> {
        let mut layers = Vec::new();
        for features in &self.layers {
            layers.push(LoadedLayer {
                features: features.clone(),
                rooms: load_rooms(store, &self.in_room, Some(features)).await?,
            });
        }

        Ok(layers)
    }
}

/// The folder of finished parts, in that of the report.
const STEPS: &str = "steps";

/// A journal in a folder: a JSON file for each finished part, and a store of trained adapters.
struct FolderJournal {
    folder: PathBuf,
    store: Store,
    runtime: Handle,
    /// The commits of the program that made the parts which were read, by part.
    commits: Mutex<BTreeMap<String, String>>,
}

/// The key of a part's commit in its file.
const COMMIT: &str = "commit";

impl FolderJournal {
    /// Opens the journal in a folder, or begins one.
    fn open(folder: &Path) -> anyhow::Result<Self> {
        let adapters = folder.join("adapters");
        let is_begun = std::fs::read_dir(adapters.join("adapters")).is_ok();
        let has_parts = std::fs::read_dir(folder).is_ok_and(|mut entries| {
            let is_part = |entry: std::io::Result<std::fs::DirEntry>| {
                entry.is_ok_and(|entry| entry.path().extension().is_some_and(|name| name == "json"))
            };
            entries.any(is_part)
        });
        if is_begun || has_parts {
            say(format_args!(
                "reusing finished parts of {}",
                folder.display()
            ));
        }
        std::fs::create_dir_all(&adapters)
            .with_context(|| format!("{} cannot be created", folder.display()))?;

        let location = adapters.to_str().context("--out is not UTF-8")?;
        Ok(Self {
            folder: folder.to_owned(),
            store: Store::open(location)?,
            runtime: Handle::current(),
            commits: Mutex::default(),
        })
    }

    /// The commits of the program that made the reused parts, other than this program's.
    fn other_commits(&self) -> Vec<String> {
        let commits = self.commits.lock().unwrap_or_else(PoisonError::into_inner);
        let others = commits.values().cloned().collect::<BTreeSet<String>>();
        let others = others.into_iter();
        others
            .filter(|commit| Some(commit.as_str()) != made_by::COMMIT)
            .collect()
    }

    fn file(&self, part: &str) -> PathBuf {
        self.folder.join(format!("{part}.json"))
    }
}

impl Journal for FolderJournal {
    fn part(&self, name: &str) -> Result<Option<Value>, String> {
        let file = self.file(name);
        let bytes = match std::fs::read(&file) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(format!("{}: {error}", file.display())),
        };
        let part = serde_json::from_slice::<Value>(&bytes);
        let part = part.map_err(|error| format!("{}: {error}; remove it", file.display()))?;
        if let Some(commit) = part.get(COMMIT).and_then(Value::as_str) {
            let mut commits = self.commits.lock().unwrap_or_else(PoisonError::into_inner);
            commits.insert(name.to_owned(), commit.to_owned());
        }
        Ok(Some(part))
    }

    fn keep_part(&self, name: &str, part: &Value) -> Result<(), String> {
        // A part that was read has other inputs, and is replaced.
        let mut commits = self.commits.lock().unwrap_or_else(PoisonError::into_inner);
        commits.remove(name);
        drop(commits);

        let mut part = part.clone();
        if let Some(part) = part.as_object_mut() {
            part.insert(COMMIT.to_owned(), json!(made_by::COMMIT));
        }
        write_intermediate(&self.file(name), &part).map_err(|error| format!("{error:#}"))
    }

    fn adapter(&self, name: &str) -> Result<Option<(Adapter, TrainingRecord)>, String> {
        match self.runtime.block_on(self.store.load_adapter(name, None)) {
            Ok(stored) => Ok(Some((stored.adapter.as_ref().clone(), stored.record))),
            Err(seese3_store::Error::Unknown { .. }) => Ok(None),
            Err(error) => Err(error.to_string()),
        }
    }

    fn keep_adapter(&self, name: &str, adapter: &ReproducedAdapter) -> Result<(), String> {
        let ReproducedAdapter {
            adapter,
            record,
            golden_features,
            ..
        } = adapter;
        let published = self
            .store
            .publish_adapter(name, adapter, record, golden_features.view());
        let published = self.runtime.block_on(published);
        published.map(drop).map_err(|error| error.to_string())
    }
}

/// The file `record.json`.
#[derive(Debug, Serialize)]
struct FileRecord {
    #[serde(flatten)]
    record: ReproductionRecord,
    adapters: Vec<PublishedAdapter>,
    /// The commits of the program that made the parts of earlier runs.
    other_commits: Vec<String>,
    /// Wall time of the whole run.
    seconds: f64,
}

/// An adapter in the store, and how it was trained.
#[derive(Debug, Serialize)]
struct PublishedAdapter {
    name: String,
    revision: u64,
    preset: String,
    seed: u64,
    epochs: usize,
    charts: usize,
    split: &'static str,
    stride: u32,
    pairs: usize,
    rooms: usize,
    calibration_rooms: usize,
}

/// Publishes every adapter.
async fn publish(
    store: &Store,
    adapters: &[ReproducedAdapter],
) -> anyhow::Result<Vec<PublishedAdapter>> {
    let mut published = Vec::with_capacity(adapters.len());
    for reproduced in adapters {
        let record = &reproduced.record;
        let revision = store
            .publish_experiment(
                &reproduced.name,
                &reproduced.adapter,
                record,
                reproduced.golden_features.view(),
            )
            .await?
            .revision;

        published.push(PublishedAdapter {
            name: reproduced.name.clone(),
            revision,
            preset: record.preset.clone(),
            seed: record.config.seed,
            epochs: record.config.epochs,
            charts: record.config.charts,
            split: record.split.name(),
            stride: record.stride,
            pairs: record.pair_count,
            rooms: record.rooms.len(),
            calibration_rooms: record.calibrated_on.len(),
        });
    }

    Ok(published)
}

fn write(out: &Path, document: &Document, record: &FileRecord) -> anyhow::Result<()> {
    for picture in document.pictures() {
        write_file(&out.join(&picture.name), &picture.bytes)?;
        #[cfg(feature = "plots")]
        if let Some(name) = picture.name.strip_suffix(".svg") {
            let pdf = seese3_lab::report::plot_pdf(&picture.bytes)?;
            write_file(&out.join(format!("{name}.pdf")), &pdf)?;
        }
    }

    let tables = out.join("tables");
    std::fs::create_dir_all(&tables)
        .with_context(|| format!("{} cannot be created", tables.display()))?;
    for (name, table) in document.tables() {
        write_file(&tables.join(format!("{name}.csv")), table.csv().as_bytes())?;
        let latex = table.escaped_for_latex().latex();
        write_file(&tables.join(format!("{name}.tex")), latex.as_bytes())?;
    }

    write_file(&out.join("report.md"), document.markdown("").as_bytes())?;
    write_file(&out.join("report.html"), document.html().as_bytes())?;
    write_json(&out.join("record.json"), record)?;

    say(format_args!(
        "wrote {0}/report.html, {0}/report.md, {0}/record.json and the tables in {0}/tables",
        out.display()
    ));

    Ok(())
}

//! `seese3 reproduce`: the paper's tables and figures on given rooms, as one report.

mod claims;
mod cross;
mod in_room;
mod notes;
mod pictures;
mod success;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail};
use clap::Args;
use serde_json::{Map, Value, json};

use self::notes::{Notes, published_name};
use super::progress::bar;
use super::rooms::load_rooms;
use super::{say, write_file, write_json};
use crate::features::Features;
use crate::report::{Document, Section, theory_json, theory_table_rows};
use crate::room::is_plain_name;
use crate::store::{Store, StoredRoom};
use crate::theory::{Effort, checks};

#[derive(Debug, Clone, Args)]
pub struct Reproduce {
    /// The store
    #[arg(long, env = "SEESE3_STORE")]
    store: String,
    /// Rooms to learn from together: names, or patterns with *
    #[arg(long, required = true)]
    train: Vec<String>,
    /// Rooms that are held out: names, or patterns with *
    #[arg(long, required = true)]
    test: Vec<String>,
    /// Rooms that are learned by themselves, for the tables within a room: names, or patterns with
    /// *
    #[arg(long = "in-room", required = true)]
    in_room: Vec<String>,
    /// Features that all rooms have, separated by commas; weight-free ones last, as a control
    #[arg(long, required = true, value_delimiter = ',')]
    features: Vec<String>,
    /// Frames from source to target
    #[arg(long, default_value_t = 25)]
    stride: u32,
    /// Strides of the curves within a room
    #[arg(long, value_delimiter = ',', default_values_t = [5, 10, 20, 40])]
    strides: Vec<u32>,
    /// How many rooms are learned from, along the scaling curve
    #[arg(long, value_delimiter = ',', default_values_t = [5, 10, 20, 35, 50, 75, 100])]
    sizes: Vec<usize>,
    /// Rooms kept aside to measure an adapter's errors in
    #[arg(long, default_value_t = 20)]
    aside: usize,
    /// Runs of what is averaged over seeds, from 0 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Passes over the pairs, instead of every preset's own: to try the command out
    #[arg(long)]
    epochs: Option<usize>,
    /// Where the report goes: a folder, made if it is not there
    #[arg(long, default_value = "reproduction")]
    out: PathBuf,
}

type Loaded = (StoredRoom, Features);

/// What the sections share.
struct Setting {
    options: Reproduce,
    /// By features, in the order given: rooms learned together, held out, and learned by
    /// themselves.
    sets: Vec<Set>,
}

/// Rooms with one of their features.
struct Set {
    features: String,
    train: Vec<Loaded>,
    test: Vec<Loaded>,
    in_room: Vec<Loaded>,
}

/// A section and its machine-readable record.
type Found = (Section, Value);

impl Reproduce {
    pub async fn run(self) -> anyhow::Result<()> {
        let begun = Instant::now();
        let store = Store::open(&self.store)?;
        let setting = self.loaded(&store).await?;
        let out = &setting.options.out;
        std::fs::create_dir_all(out)
            .with_context(|| format!("{} cannot be made", out.display()))?;

        let progress = bar(9, "reproduce");
        let mut record = Map::new();
        let mut sections = vec![data(&setting)];
        let mut notes = Notes::default();

        let mut keep = |name: &str, (section, value): Found, record: &mut Map<String, Value>| {
            record.insert(name.to_owned(), value);
            sections.push(section);
            progress.inc(1);
        };
        keep(
            "probes",
            in_room::probes(&setting, &mut notes.claims)?,
            &mut record,
        );

        keep(
            "strides",
            in_room::strides(&setting, &mut notes.claims)?,
            &mut record,
        );

        keep("rooms_alone", success::section(&setting)?, &mut record);

        keep(
            "formulations",
            in_room::formulations(&setting, &mut notes.claims)?,
            &mut record,
        );

        keep(
            "navigation",
            in_room::navigation(&setting, &mut notes)?,
            &mut record,
        );

        for found in cross::sections(&setting, &mut notes)? {
            keep(&found.0, found.1, &mut record);
        }

        keep(
            "pictures",
            pictures::section(&setting, &notes)?,
            &mut record,
        );

        keep("theory", theory()?, &mut record);
        progress.finish_and_clear();
        sections.insert(1, claims::section(&notes.claims));
        record.insert("claims".to_owned(), claims::json(&notes.claims));

        record.insert("adapters".to_owned(), notes.publish(&store).await?);
        sections.push(published(&notes));
        record.insert("protocol".to_owned(), setting.protocol());
        record.insert("seconds".to_owned(), json!(begun.elapsed().as_secs_f64()));

        let document = Document {
            title: "SeeSE3 reproduced".to_owned(),
            sections,
        };

        write(&setting.options.out, &document, &Value::Object(record))
    }

    async fn loaded(self, store: &Store) -> anyhow::Result<Setting> {
        let mut sets = Vec::new();
        for features in &self.features {
            let [train, test, in_room] = [&self.train, &self.test, &self.in_room];
            let train = load_rooms(store, train, Some(features)).await?;
            let test = load_rooms(store, test, Some(features)).await?;
            let in_room = load_rooms(store, in_room, Some(features)).await?;

            let twice = train.iter().find(|(room, _)| {
                test.iter()
                    .any(|(other, _)| other.room.id() == room.room.id())
            });

            if let Some((room, _)) = twice {
                bail!(
                    "room '{}' is both learned from and held out",
                    room.room.id()
                );
            }

            sets.push(Set {
                features: features.clone(),
                train,
                test,
                in_room,
            });
        }

        // Found out now, not when everything was learned.
        for set in &sets {
            let rooms = set
                .in_room
                .iter()
                .map(|(stored, _)| stored.room.id().as_str());

            for what in rooms.chain([cross::LONGEST_NAME]) {
                let name = published_name(what, &set.features);
                if !is_plain_name(&name) {
                    bail!(
                        "an adapter would be called '{name}', which is no name for one: too long by --features or --in-room"
                    );
                }
            }
        }

        let rooms = sets.first().map_or(0, |set| set.train.len());
        if let Some(size) = self.sizes.iter().find(|&&size| size == 0 || size > rooms) {
            bail!("--sizes: {size} is not 1 to {rooms}, the rooms to learn from");
        }

        if self.aside >= rooms {
            bail!(
                "--aside must leave rooms to learn from: {} of {rooms}",
                self.aside
            );
        }

        Ok(Setting {
            options: self,
            sets,
        })
    }
}

impl Setting {
    fn protocol(&self) -> Value {
        let Reproduce {
            stride,
            strides,
            sizes,
            aside,
            seeds,
            epochs,
            features,
            ..
        } = &self.options;

        let names = |rooms: &[Loaded]| {
            rooms
                .iter()
                .map(|(stored, _)| json!([stored.room.id().as_str(), stored.revision]))
                .collect::<Vec<_>>()
        };

        let set = &self.sets[0];
        json!({
            "features": features,
            "stride": stride,
            "strides": strides,
            "sizes": sizes,
            "aside": aside,
            "seeds": seeds,
            "epochs_instead_of_the_presets": epochs,
            "train": names(&set.train),
            "test": names(&set.test),
            "in_room": names(&set.in_room),
        })
    }
}

/// What was looked at.
fn data(setting: &Setting) -> Section {
    let mut section = Section::new("Rooms and features");
    let set = &setting.sets[0];

    let mut rows = vec![
        ["rooms", "count", "frames", "recorded as"]
            .map(str::to_owned)
            .to_vec(),
    ];

    for (what, rooms) in [
        ("learned together", &set.train),
        ("held out", &set.test),
        ("learned alone", &set.in_room),
    ] {
        let frames: usize = rooms
            .iter()
            .map(|(stored, _)| stored.room.frame_count())
            .sum();

        let mut formats: Vec<&str> = rooms
            .iter()
            .map(|(stored, _)| stored.room.provenance().format.as_str())
            .collect();
        formats.sort_unstable();

        formats.dedup();

        rows.push(vec![
            what.to_owned(),
            rooms.len().to_string(),
            frames.to_string(),
            formats.join(", "),
        ]);
    }

    section.table(rows);

    let mut rows = vec![
        ["features", "encoder", "layer", "pooling", "columns"]
            .map(str::to_owned)
            .to_vec(),
    ];

    for set in &setting.sets {
        let source = set.train[0].1.source();
        let layer = source.layer.clone();
        let pooling = source.pooling.clone();

        rows.push(vec![
            set.features.clone(),
            source.encoder.clone(),
            layer,
            pooling,
            source.dim.to_string(),
        ]);
    }

    section.table(rows);

    section.text(
        "None of the paper's encoders was at hand. Its numbers stand beside ours as context: encoders, rooms and sizes \
         differ, and nothing here speaks of the models that were not run.",
    );

    if let Some(epochs) = setting.options.epochs {
        section.text(format!(
            "All training was cut to {epochs} epochs: this is a trial of the command, not a result."
        ));
    }

    section
}

/// Where the adapters are.
fn published(notes: &Notes) -> Section {
    let mut section = Section::new("Adapters");
    section.text(format!(
        "The {} adapters of the tables of navigation are in the store, named \"reproduced.\" and what they learned from: \
         evaluate, navigate and serve take them. The record has their revisions, seeds and protocols; the other tables' \
         adapters are what `seese3 train` gives for the same room, preset and seed.",
        notes.adapters.len()
    ));

    section
}

fn theory() -> anyhow::Result<Found> {
    let found = checks(Effort::default(), &mut |_| ())?;
    let mut section = Section::new("Theorems, measured against their bounds");
    section.table(theory_table_rows(&found));
    Ok((section, theory_json(&found)))
}

fn write(out: &Path, document: &Document, record: &Value) -> anyhow::Result<()> {
    for picture in document.pictures() {
        write_file(&out.join(&picture.name), &picture.bytes)?;
    }

    write_file(&out.join("report.md"), document.markdown("").as_bytes())?;
    write_file(&out.join("report.html"), document.html().as_bytes())?;
    write_json(&out.join("record.json"), record)?;

    say(format_args!(
        "wrote {0}/report.html, {0}/report.md and {0}/record.json",
        out.display()
    ));

    Ok(())
}

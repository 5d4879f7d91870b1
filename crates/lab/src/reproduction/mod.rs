//! Reproduces the paper's tables and figures on given rooms, as one report.
//!
//! Start reading at [`reproduce`]. Every experiment produces one section of the report and one
//! entry of the record. [`Adapters`] collects the adapters of all sections.

mod adapters;
mod better;
mod claims;
mod cross;
mod formulations;
mod journal;
mod layers;
mod navigation;
mod paper;
mod pictures;
mod plans;
mod probes;
mod settings;
mod strides;
mod success;
mod walks;

pub use adapters::{Adapters, ReproducedAdapter, published_name};
pub use claims::{Claim, Verdict};
pub use journal::{Journal, NoJournal};
pub use layers::LayerSet;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use seese3_core::adapter::Preset;
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::Split;
use seese3_core::training::{RoomData, TrainingPlan};

use crate::experiments::Error;
use crate::report::{Document, Section, Table, TheoryJson, theory_json, theory_table};
use crate::theory::{Effort, checks};

/// Settings of a reproduction, besides its rooms and features.
#[derive(Debug, Clone, Serialize)]
pub struct Options {
    /// Frames from source to target.
    pub stride: u32,
    /// Strides of the curves within a room.
    pub strides: Vec<u32>,
    /// Numbers of training rooms along the scaling curve.
    pub sizes: Vec<usize>,
    /// Number of seeds, from 0, of every adapter that is trained on several rooms; the seed also
    /// chooses its rooms.
    pub trainings: u64,
    /// Number of training rooms that plans with calibration use for calibration instead.
    pub calibration_rooms: usize,
    /// Number of seeds, from 0, in tables that average over seeds.
    pub seeds: u64,
    /// Number of seeds in the table of the alternatives A to D; the paper uses 15.
    pub formulation_seeds: u64,
    /// Epochs of the long training of the alternatives A to D, 200 in the paper; 0 leaves it out.
    pub formulation_epochs: usize,
    /// Number of epochs that overrides every preset, for a trial run.
    #[serde(rename = "epochs_instead_of_the_presets")]
    pub epochs: Option<usize>,
}

/// The rooms of the three groups, with one feature set.
pub struct FeatureSet<'a> {
    /// The name of the features.
    pub features: String,
    /// Training rooms of the adapters that are trained on several rooms.
    pub train: Vec<RoomData<'a>>,
    /// Held-out rooms of these adapters.
    pub test: Vec<RoomData<'a>>,
    /// Rooms with one adapter per room.
    pub in_room: Vec<RoomData<'a>>,
}

/// The input of a reproduction: options, and rooms with features.
pub struct Reproduction<'a> {
    /// The settings.
    pub options: Options,
    /// One entry per feature set, the control last; each has the same rooms.
    pub sets: Vec<FeatureSet<'a>>,
    /// Layers of an encoder to compare, in the in-room rooms.
    pub layers: Vec<LayerSet<'a>>,
    /// Reads images for the pictures of walks; this crate reads no files.
    pub images: Images<'a>,
    /// Keeps what is finished, so that another run with the same inputs reuses it.
    pub journal: &'a dyn Journal,
}

/// Functions of the caller that read and write images. Errors are reasons, in words.
#[derive(Clone, Copy)]
pub struct Images<'a> {
    /// Reads the image of a frame.
    pub read: &'a (dyn Fn(&Room, FrameId) -> Result<RgbImage, String> + Sync),
    /// Encodes an image as a PNG file.
    pub png: &'a (dyn Fn(&RgbImage) -> Result<Vec<u8>, String> + Sync),
}

/// The report, its machine-readable record, and the trained adapters.
pub struct Reproduced {
    /// The report.
    pub document: Document,
    /// All results of the report, for JSON.
    pub record: ReproductionRecord,
    /// The adapters of the navigation tables.
    pub adapters: Vec<ReproducedAdapter>,
}

/// The results of every experiment. The fields are keys of `record.json`; the command adds the
/// published adapters and the run time.
#[derive(Debug, Serialize)]
pub struct ReproductionRecord {
    probes: Value,
    strides: Value,
    layers: Value,
    rooms_alone: Value,
    settings: Value,
    formulations: Value,
    navigation: Vec<navigation::NavigationRecord>,
    cross_room: Vec<cross::ZeroShotRecord>,
    better: Vec<better::BetterRecord>,
    walks: Vec<walks::WalkEndRecord>,
    pictures: Vec<pictures::WalkRecord>,
    theory: Value,
    claims: Vec<Claim>,
    protocol: ProtocolRecord,
}

/// The options, and the rooms with their revisions.
#[derive(Debug, Serialize)]
struct ProtocolRecord {
    features: Vec<String>,
    #[serde(flatten)]
    options: Options,
    train: Vec<(String, u64)>,
    test: Vec<(String, u64)>,
    in_room: Vec<(String, u64)>,
}

/// Number of experiments run by [`reproduce`].
pub const EXPERIMENTS: u64 = 12;

/// The result of an experiment: a section of the report, its claims, and its JSON record.
#[derive(Serialize, Deserialize)]
struct Found<R> {
    section: Section,
    record: R,
    claims: Vec<Claim>,
}

impl<R> Found<R> {
    /// A result without claims.
    fn new(section: Section, record: R) -> Self {
        Self {
            section,
            record,
            claims: Vec::new(),
        }
    }
}

/// The sections and claims of a report, in order.
#[derive(Default)]
struct Collected {
    sections: Vec<Section>,
    claims: Vec<Claim>,
}

impl Collected {
    /// Adds the section and the claims of a result, and returns its record.
    fn add<R>(&mut self, found: Found<R>) -> R {
        self.sections.push(found.section);
        self.claims.extend(found.claims);
        found.record
    }
}

/// Checks options and rooms before hours of training.
///
/// # Errors
/// [`Error::Input`] with the option or the room to change.
pub fn check(given: &Reproduction<'_>) -> Result<(), Error> {
    for set in &given.sets {
        // A room in both groups would make the zero-shot scores training scores.
        let is_held_out = |data: &&RoomData<'_>| {
            set.test
                .iter()
                .any(|other| other.room.id() == data.room.id())
        };
        if let Some(data) = set.train.iter().find(is_held_out) {
            return Err(Error::Input(format!(
                "room '{}' is in both --train and --test",
                data.room.id()
            )));
        }
        // It would count twice where both groups are tested together.
        if let Some(data) = set.in_room.iter().find(is_held_out) {
            return Err(Error::Input(format!(
                "room '{}' is in both --in-room and --test",
                data.room.id()
            )));
        }
    }

    for set in &given.sets {
        let rooms = [&set.train, &set.test, &set.in_room];
        let first = set.train.first();
        let is_other = |data: &&RoomData<'_>| {
            first.is_some_and(|first| !data.features.source().is_like(first.features.source()))
        };
        if let Some(data) = rooms.into_iter().flatten().find(is_other) {
            return Err(Error::Input(format!(
                "room '{}': its features '{}' were made in another way than those of the first --train room",
                data.room.id(),
                set.features
            )));
        }
    }

    // Every set has the same rooms, so checking the first one is enough.
    if let Some(set) = given.sets.first() {
        let Options {
            stride, strides, ..
        } = &given.options;
        let all_strides = [&strides[..], &[*stride]].concat();
        check_pairs(&set.in_room, "--in-room", &Split::FOLDS, &all_strides)?;
        check_pairs(&set.in_room, "--in-room", &[Split::Blocks], &[*stride])?;
        check_pairs(&set.test, "--test", &Split::FOLDS, &[*stride])?;
        check_pairs(&set.train, "--train", &[Split::Whole], &[*stride])?;
    }
    let rooms = given.sets.first().map_or(0, |set| set.train.len());
    let is_out_of_range = |size: &&usize| **size == 0 || **size > rooms;
    if let Some(size) = given.options.sizes.iter().find(is_out_of_range) {
        return Err(Error::Input(format!(
            "--sizes: {size} must be 1 to {rooms}, the number of training rooms"
        )));
    }

    let calibration_rooms = given.options.calibration_rooms;
    if calibration_rooms == 0 || calibration_rooms >= rooms {
        return Err(Error::Input(format!(
            "--calibration-rooms: {calibration_rooms} must be at least 1 and less than {rooms}, the number of training rooms"
        )));
    }
    let Options {
        trainings,
        seeds,
        formulation_seeds,
        ..
    } = given.options;
    if [trainings, seeds, formulation_seeds].contains(&0) {
        return Err(Error::Input(
            "--trainings, --seeds and --formulation-seeds must be at least 1".to_owned(),
        ));
    }

    Ok(())
}

/// Checks that every recording has training and test pairs under every split, at each stride.
fn check_pairs(
    rooms: &[RoomData<'_>],
    option: &str,
    splits: &[Split],
    strides: &[u32],
) -> Result<(), Error> {
    for data in rooms {
        let timeline = data.room.timeline();
        for &stride in strides {
            for split in splits {
                let pairs = split
                    .train_pairs(timeline, stride)
                    .and_then(|_| split.test_pairs(timeline, stride));
                pairs.map_err(|error| {
                    Error::Input(format!("{option}: room '{}': {error}", data.room.id()))
                })?;
            }
        }
    }

    Ok(())
}

/// The names of the in-room adapters, and the longest name of the other adapters. They allow
/// checking names before hours of training.
pub fn adapter_names(given: &Reproduction<'_>) -> Vec<String> {
    let mut names = Vec::new();
    for set in &given.sets {
        let rooms = set.in_room.iter().map(|data| data.room.id().as_str());
        let all = rooms.chain([plans::LONGEST_NAME]);
        names.extend(all.map(|what| published_name(what, &set.features)));
    }

    names
}

/// Runs the paper's experiments. `begin` is called with the name of each before it.
///
/// Trained adapters, and steps that use no other step's adapter, are taken from the journal of
/// `given` if their inputs are unchanged.
///
/// # Errors
/// The [`Error`] of [`check`] or of the first failed experiment; [`Error::Journal`] if the journal
/// cannot be read or written.
pub fn reproduce(
    given: &Reproduction<'_>,
    begin: &dyn Fn(&'static str),
) -> Result<Reproduced, Error> {
    check(given)?;

    let steps = Steps { given, begin };
    let within = within_rooms(&steps)?;
    let mut adapters = Adapters::default();
    begin("navigation");
    let navigation = navigation::section(given, &mut adapters)?;

    // Adapters trained on several rooms, evaluated in held-out rooms.
    begin("cross-room");
    let across = plans::evaluate(given, &mut adapters)?;
    let cross_room = cross::section(given, &across)?;
    begin("better");
    let better = better::section(&across);

    // The walks use the steady adapters trained for the previous sections.
    begin("walks");
    let walks = walks::section(given, &adapters)?;
    begin("pictures");
    let pictures = pictures::section(given, &adapters)?;
    let theory = steps.run("theory", Value::Null, &[], theory)?;

    let mut report = Collected::default();
    report.sections.push(rooms_and_features(given));
    let mut record = ReproductionRecord {
        probes: report.add(within.probes),
        strides: report.add(within.strides),
        layers: report.add(within.layers),
        rooms_alone: report.add(within.rooms_alone),
        settings: report.add(within.settings),
        formulations: report.add(within.formulations),
        navigation: report.add(navigation),
        cross_room: report.add(cross_room),
        better: report.add(better),
        walks: report.add(walks),
        pictures: report.add(pictures),
        theory: report.add(theory),
        claims: Vec::new(),
        protocol: protocol(given),
    };
    report.sections.push(published(&adapters));

    // All tests exist now. The verdicts follow the list of rooms.
    claims::judge(&mut report.claims);
    report.sections.insert(1, claims::section(&report.claims));
    record.claims = report.claims;

    Ok(Reproduced {
        document: Document {
            title: "SeeSE3 reproduced".to_owned(),
            sections: report.sections,
        },
        record,
        adapters: adapters.0,
    })
}

/// Runs the steps that the journal keeps.
struct Steps<'a> {
    given: &'a Reproduction<'a>,
    begin: &'a dyn Fn(&'static str),
}

impl Steps<'_> {
    /// The result of a step: the kept one if its options and rooms are unchanged, else that of
    /// `section`.
    fn run<R: Serialize>(
        &self,
        name: &'static str,
        options: Value,
        rooms: &[&[RoomData<'_>]],
        section: fn(&Reproduction<'_>) -> Result<Found<R>, Error>,
    ) -> Result<Found<Value>, Error> {
        (self.begin)(name);
        let inputs = self.given.inputs(options, rooms);
        self.given.step(name, inputs, section)
    }
}

/// Results of the steps within a room, which use no other step's adapter.
struct WithinRooms {
    probes: Found<Value>,
    strides: Found<Value>,
    layers: Found<Value>,
    rooms_alone: Found<Value>,
    settings: Found<Value>,
    formulations: Found<Value>,
}

fn within_rooms(steps: &Steps<'_>) -> Result<WithinRooms, Error> {
    let given = steps.given;
    let Options {
        stride,
        strides,
        seeds,
        formulation_seeds,
        formulation_epochs,
        ..
    } = &given.options;
    let alone: Vec<&[RoomData<'_>]> = given.sets.iter().map(|set| &*set.in_room).collect();
    let held_out: Vec<&[RoomData<'_>]> = given.sets.iter().map(|set| &*set.test).collect();
    let all = [&alone[..], &held_out[..]].concat();
    let of_layers: Vec<&[RoomData<'_>]> = given.layers.iter().map(|layer| &*layer.rooms).collect();

    let at_stride = json!({ "stride": stride, "seeds": seeds });
    let at_strides = json!({ "strides": strides, "seeds": seeds });
    let of_formulations =
        json!({ "stride": stride, "seeds": formulation_seeds, "epochs": formulation_epochs });

    Ok(WithinRooms {
        probes: steps.run("probes", json!({ "stride": stride }), &all, probes::section)?,
        strides: steps.run("strides", at_strides.clone(), &alone, strides::section)?,
        layers: steps.run("layers", at_stride.clone(), &of_layers, layers::section)?,
        rooms_alone: steps.run("rooms-alone", at_strides, &all, success::section)?,
        settings: steps.run("settings", at_stride, &alone, settings::section)?,
        formulations: steps.run(
            "formulations",
            of_formulations,
            &alone,
            formulations::section,
        )?,
    })
}

impl Reproduction<'_> {
    /// The training plan of a preset at a stride. The number of epochs is the command's `--epochs`,
    /// else `epochs`, else the preset's own. Only the last has a minimum number of steps.
    fn plan(
        &self,
        preset: Preset,
        split: Split,
        stride: u32,
        seed: u64,
        epochs: Option<usize>,
    ) -> TrainingPlan {
        let mut plan = TrainingPlan::of(preset, split, stride, seed);
        if let Some(epochs) = self.options.epochs.or(epochs) {
            plan.config.epochs = epochs;
            plan.least_steps = 0;
        }

        plan
    }

    /// The training length of in-room adapters, in words.
    fn training_words(&self) -> String {
        match self.options.epochs {
            Some(epochs) => format!("Preset base, cut to {epochs} epochs."),
            None => "Preset base: at least 400 optimizer steps.".to_owned(),
        }
    }
}

fn protocol(given: &Reproduction<'_>) -> ProtocolRecord {
    let names = |rooms: &[RoomData<'_>]| {
        rooms
            .iter()
            .map(|data| (data.room.id().to_string(), data.revision))
            .collect()
    };

    // The sets differ only in their features, so the first one names all rooms.
    let set = &given.sets[0];
    ProtocolRecord {
        features: given.sets.iter().map(|set| set.features.clone()).collect(),
        options: given.options.clone(),
        train: names(&set.train),
        test: names(&set.test),
        in_room: names(&set.in_room),
    }
}

/// The section that lists the rooms and the feature sets.
fn rooms_and_features(given: &Reproduction<'_>) -> Section {
    let mut section = Section::new("Rooms and features");
    section.table(room_table(&given.sets[0]));
    section.table(feature_table(&given.sets));

    section.text("The paper's numbers are context only: its encoders, rooms and sizes differ.");

    // Mark a trial run, so that it is not mistaken for a result.
    if let Some(epochs) = given.options.epochs {
        section.text(format!(
            "All training was cut to {epochs} epochs: this is a trial of the command, not a result."
        ));
    }

    section
}

/// The three groups of rooms, the same for every feature set.
fn room_table(set: &FeatureSet<'_>) -> Table {
    let mut table = Table::new("rooms | count | frames | recorded as");
    for (what, rooms) in [
        ("training", &set.train),
        ("held-out", &set.test),
        ("in-room", &set.in_room),
    ] {
        let frames: usize = rooms.iter().map(|data| data.room.frame_count()).sum();
        let formats: BTreeSet<&str> = rooms
            .iter()
            .map(|data| data.room.provenance().format.as_str())
            .collect();
        let formats: Vec<&str> = formats.into_iter().collect();

        let cells = [
            rooms.len().to_string(),
            frames.to_string(),
            formats.join(", "),
        ];
        table.row(what, cells);
    }

    table
}

fn feature_table(sets: &[FeatureSet<'_>]) -> Table {
    let mut table = Table::new("features | encoder | layer | pooling | columns");
    for set in sets {
        // All rooms of a set have the same feature source; training on several rooms requires it.
        let FeatureSource {
            encoder,
            layer,
            pooling,
            dim,
            ..
        } = set.train[0].features.source();
        let words = [encoder, layer, pooling].map(String::clone);
        table.row(&set.features, words.into_iter().chain([dim.to_string()]));
    }

    table
}

/// The section about the names of the published adapters.
fn published(adapters: &Adapters) -> Section {
    let mut section = Section::new("Adapters");
    section.text(format!(
        "The store has the {} adapters of the navigation tables as `reproduced.ROOM.FEATURES` and \
         `reproduced.PLAN.FEATURES`. The record has their revisions, seeds and protocols. `seese3 train` makes the adapters of \
         the other tables, with the same room, preset and seed.",
        adapters.0.len()
    ));

    section
}

fn theory(_: &Reproduction<'_>) -> Result<Found<TheoryJson>, Error> {
    let found = checks(Effort::default(), &mut |_| ())?;
    let mut section = Section::new("Theorems, measured against their bounds");
    section.table(theory_table(&found));
    Ok(Found::new(section, theory_json(&found)))
}

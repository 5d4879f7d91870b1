//! `seese3 train`: trains an adapter and publishes it.

use anyhow::{Context, bail};
use clap::Args;

use seese3_core::adapter::{
    Adapter, CellLayout, CorrectorKind, RelationalConfig, RelationalReader, TrainingRecord,
};
use seese3_core::features::{Features, JOINED};
use seese3_core::motion_scores::MotionScores;
use seese3_core::splits::Split;
use seese3_core::training::{
    RoomData, TrainingPlan, motions, relational_predictions, train_reader,
};
use seese3_lab::experiments::seeds::{SeededTraining, TrainingRun, train_seeds};
use seese3_lab::report::{gating_text, training_json, training_remark, training_table};
use seese3_robot::calibration::{calibrate, check_unseen};

use super::output::{JsonOutput, say, say_published};
use super::progress::bar;
use super::protocol::{ProtocolOptions, ReaderOptions};
use super::rooms::{data, load_rooms, room_words};
use seese3_store::{Store, StoredRoom};

/// The largest number of seeds in one command.
const MAX_SEEDS: u64 = 1_000;

#[derive(Debug, Args)]
pub struct Train {
    /// The store: a folder, or a URL of a bucket (feature `cloud`)
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// Training rooms: names, or patterns with *; may be given several times; one adapter is
    /// trained on all of them
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Name of the feature set, the same for every room; may be omitted when the first room has
    /// only one. Several names, separated by commas, are joined column by column
    #[arg(long)]
    features: Option<String>,
    #[command(flatten)]
    protocol: ProtocolOptions,
    #[command(flatten)]
    reader: ReaderOptions,
    /// Corrector navigators to train after the adapter, separated by commas: linear, mlp-2, mlp-3,
    /// attention, or all; none if omitted
    #[arg(long, value_delimiter = ',')]
    correctors: Vec<String>,
    /// Calibration rooms, in which the adapter's errors are measured: names, or patterns with *;
    /// none may be a training room. One is enough for navigators whose name ends in +calibrated;
    /// tracking and relocalization need two or more
    #[arg(long)]
    calibrate_on: Vec<String>,
    /// Seed of initial weights, drawn pairs and their order, 0 to 2³² − 1; weights and order are
    /// those of PyTorch's generator
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    /// Number of adapters to train, 1 to 1000, with the seeds --seed, --seed + 1, …: mean and
    /// deviation of the scores are reported, the first adapter is published
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// Name of the adapter in the store; derived from the rooms, features and protocol if omitted
    #[arg(long)]
    name: Option<String>,
    #[command(flatten)]
    json: JsonOutput,
}

impl Train {
    pub async fn run(self) -> anyhow::Result<()> {
        if self.seeds == 0 || self.seeds > MAX_SEEDS {
            bail!("--seeds must be 1 to {MAX_SEEDS}, got {}", self.seeds);
        }
        self.json.begin()?;

        let store = Store::open(&self.store)?;
        store.check_writable().await?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;

        let plan = TrainingPlan {
            correctors: correctors(&self.correctors)?,
            ..self.protocol.plan(self.seed)?
        };

        let source = rooms[0].1.source().name.clone();

        // Errors are measured on the feature set that the adapter is trained on.
        let calibration = match self.calibrate_on.is_empty() {
            true => Vec::new(),
            false => load_rooms(&store, &self.calibrate_on, Some(&source)).await?,
        };

        // Found now, not after the training of the adapter.
        let reader = self.reader.relational(self.seed);
        if reader.is_some() {
            CellLayout::of(rooms[0].1.source())?;
        }

        // Errors in a training room are not representative of other rooms. Reject such a
        // calibration room now, not after the training.
        for room in &calibration {
            check_unseen(
                &data(room),
                rooms.iter().map(|(stored, _)| stored.room.id()),
            )?;
        }

        // Only the first seed's adapter is calibrated and published; the other seeds show how far
        // the scores vary.
        let SeededTraining {
            mut adapter,
            mut runs,
        } = train_with_progress(&rooms, &plan, self.seeds)?;
        if let Some(config) = reader {
            let reader = reader_with_progress(&rooms, plan.split, &config)?;
            adapter = adapter.with_relational(reader)?;
            runs[0].record.relational = Some(config);
        }
        if !calibration.is_empty() {
            let record = runs[0].record.clone();
            (adapter, runs[0].record) = calibrated(adapter, record, &calibration)?;
        }

        let features = &rooms[0].1;
        let name = self.name.unwrap_or_else(|| default_name(&rooms, &plan));
        let record = &runs[0].record;
        let published = store
            .publish_adapter(&name, &adapter, record, features.rows())
            .await?;

        say_training(&rooms, &plan, record);
        say_scores(&runs);
        say_reader(&adapter, &rooms, &plan)?;
        say_published(&store, &format!("adapter '{name}'"), &published);
        self.json
            .write(&training_json(&runs, &name, published.revision))?;

        Ok(())
    }
}

/// Prints what was trained on, and on what it is judged.
fn say_training(rooms: &[(StoredRoom, Features)], plan: &TrainingPlan, record: &TrainingRecord) {
    let features = &rooms[0].1;
    let split = plan.split;
    let stride = plan.stride;
    let preset = plan.preset.name();

    say(format_args!(
        "{}, features '{}' ({} columns), preset {preset}, stride {stride}, split {split}",
        room_words(rooms),
        features.source().name,
        features.source().dim,
    ));

    // Under `whole` nothing is held out: the scores are in-sample and labeled as such.
    let judged = match split {
        Split::Whole => {
            "no test pairs; train R², and in-sample Hit@0.1 of inverse Poincaré (affine)".to_owned()
        }
        _ => format!(
            "{} test pairs; test R² by room, averaged, and Hit@0.1 of inverse Poincaré (affine)",
            record.test.n
        ),
    };

    say(format_args!(
        "{} training pairs, {} epochs\n{judged}:",
        record.pair_count, record.config.epochs
    ));
}

/// Prints the table of seeds, with its caveats.
fn say_scores(runs: &[TrainingRun]) {
    say(training_table(runs));
    if let Some(remark) = training_remark(runs) {
        say(remark);
    }

    if let Some(text) = gating_text(runs) {
        say(text);
    }

    // A motion component that is constant over the test pairs has no R².
    let test = &runs[0].record.test;
    let still = test.still_components();
    if test.n > 0 && still > 0 {
        say(format_args!(
            "{still} of the 6 components of the motion never vary and are left out of the means"
        ));
    }
}

/// Trains a relational reader with a progress bar, which shows the loss reported last.
pub fn reader_with_progress(
    rooms: &[(StoredRoom, Features)],
    split: Split,
    config: &RelationalConfig,
) -> anyhow::Result<RelationalReader> {
    let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
    let epochs = (config.epochs as u64).saturating_mul(config.members as u64);
    let progress = bar(epochs, "training the reader");
    let reader = train_reader(&room_data, split, config, &mut |epoch| {
        progress.set_message(format!("loss {:.3}", epoch.loss));
        progress.inc(1);
    })?;

    progress.finish_and_clear();
    Ok(reader)
}

/// Prints the scores of the relational reader on the test pairs, if there are both.
fn say_reader(
    adapter: &Adapter,
    rooms: &[(StoredRoom, Features)],
    plan: &TrainingPlan,
) -> anyhow::Result<()> {
    let Some(reader) = adapter.relational() else {
        return Ok(());
    };
    if plan.split == Split::Whole {
        say("relational reader: no test pairs; judge it in rooms that it was not trained on");
        return Ok(());
    }

    let mut scores = Vec::with_capacity(rooms.len());
    for (stored, features) in rooms {
        let pairs = plan.split.test_pairs(stored.room.timeline(), plan.stride)?;
        let truth = motions(stored.room.poses(), &pairs);
        let read = relational_predictions(reader, features.rows(), &pairs)?;
        scores.push(MotionScores::of(&truth, &read));
    }

    let mean = MotionScores::mean(&scores);
    say(format_args!(
        "relational reader: test R² {:.3}, translation {:.3}, rotation {:.3}",
        mean.overall, mean.translation, mean.rotation
    ));
    Ok(())
}

/// The adapter with its errors measured in the calibration rooms, and its finished record.
fn calibrated(
    adapter: Adapter,
    record: TrainingRecord,
    rooms: &[(StoredRoom, Features)],
) -> anyhow::Result<(Adapter, TrainingRecord)> {
    let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
    let calibrated = calibrate(adapter, record, &room_data)?;
    if !calibrated.can_track {
        say("one calibration room is too few for tracking: the adapter can only navigate");
    }

    say(format_args!("errors measured in {}", room_words(rooms)));
    Ok((calibrated.adapter, calibrated.record))
}

fn correctors(names: &[String]) -> anyhow::Result<Vec<CorrectorKind>> {
    if names == ["all"] {
        return Ok(CorrectorKind::ALL.to_vec());
    }

    let kind = |name: &String| {
        let known = CorrectorKind::ALL.map(CorrectorKind::name).join(", ");
        name.parse()
            .ok()
            .with_context(|| format!("--correctors: '{name}' is not one of all, {known}"))
    };

    names.iter().map(kind).collect()
}

/// Trains one adapter per seed with one progress bar, which shows the loss reported last.
pub fn train_with_progress(
    rooms: &[(StoredRoom, Features)],
    plan: &TrainingPlan,
    seeds: u64,
) -> anyhow::Result<SeededTraining> {
    let epochs = (plan.config.epochs as u64).saturating_mul(seeds);
    let progress = bar(epochs, "training");

    let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
    let trained = train_seeds(&room_data, plan, seeds, &|epoch| {
        // A plan with a minimum number of steps may have more epochs than its preset.
        progress.set_length((epoch.epochs as u64).saturating_mul(seeds));
        progress.set_message(format!("loss {:.4}", epoch.loss));
        progress.inc(1);
    })?;

    progress.finish_and_clear();
    Ok(trained)
}

/// The default name of an adapter: rooms, features, preset, stride and split, and the architecture
/// or loss where it differs from the preset's.
pub fn default_name(rooms: &[(StoredRoom, Features)], plan: &TrainingPlan) -> String {
    let TrainingPlan {
        preset,
        split,
        stride,
        config,
        ..
    } = plan;

    let first = rooms[0].0.room.id();
    let features = &rooms[0].1.source().name;

    let others = if rooms.len() > 1 {
        format!("-and-{}-more", rooms.len() - 1)
    } else {
        String::new()
    };
    let mut name = format!(
        "{first}{others}.{features}.{}.s{stride}.{split}",
        preset.name()
    );

    // Joined features have a separator that names cannot contain.
    name = name.replace(JOINED, "-");

    // Other settings, such as epochs and rates, do not enter the name; adapters that differ only
    // in them become revisions of one name.
    let plain = preset.config(0);
    if config.charts > 1 {
        name.push_str(&format!(".{}{}", config.mixing.name(), config.charts));
    }
    if config.loss != plain.loss {
        name.push_str(&format!(".{}", config.loss.name()));
    }
    if config.latent != plain.latent {
        name.push_str(&format!(".g{}", config.latent));
    }

    name
}

//! On-disk format of manifest bodies (DTOs), separate from the domain types.

use serde::{Deserialize, Serialize};

use super::manifest::ObjectRef;
use super::stored_adapter::RoomFit;
use seese3_core::adapter::{Adapter, Loss, Mixing, PairPlan, TrainConfig, TrainingRecord};
use seese3_core::features::{FeatureSource, UNSPECIFIED};
use seese3_core::geometry::{Pinhole, PinholeError, PixelCamera};
use seese3_core::motion_scores::MotionScores;
use seese3_core::room::{Provenance, RoomId};
use seese3_core::splits::{Split, StrideRange};

/// The body of a room's manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RoomBody {
    pub schema: u64,
    pub room: String,
    pub revision: u64,
    /// Time of publication, RFC 3339.
    pub created: String,
    pub frame_count: usize,
    /// The tensor `world_from_camera` (n, 4, 4) f64, meters; optionally `timestamps_ns`, `numbers`,
    /// `sequences` and `held_out` (0 or 1), each (n,) i64.
    pub frames: ObjectRef,
    /// JSON list of the recording's frame names.
    pub frame_names: Option<ObjectRef>,
    /// JSON list of image paths, one per frame, relative to the images root in `provenance`.
    #[serde(default)]
    pub images: Option<ObjectRef>,
    pub features: Vec<FeaturesEntry>,
    pub provenance: ProvenanceEntry,
}

impl RoomBody {
    /// All objects of the revision.
    pub fn objects(&self) -> impl Iterator<Item = &ObjectRef> {
        let names = self.frame_names.iter().chain(&self.images);
        let features = self.features.iter().map(|entry| &entry.object);
        std::iter::once(&self.frames).chain(names).chain(features)
    }
}

/// A feature set of a room. Its object has the tensor `features` (n, d) f32.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FeaturesEntry {
    pub source: SourceEntry,
    pub object: ObjectRef,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SourceEntry {
    name: String,
    encoder: String,
    layer: String,
    #[serde(default = "unspecified")]
    base: String,
    #[serde(default = "unspecified")]
    norm: String,
    pooling: String,
    preprocess: String,
    dim: usize,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProvenanceEntry {
    format: String,
    licence: String,
    #[serde(default)]
    images_root: String,
    worst_rotation_deviation: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera: Option<PinholeEntry>,
}

/// A pinhole camera, validated on reading.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "PinholeFields", into = "PinholeFields")]
pub struct PinholeEntry(Pinhole);

/// A pinhole camera in the manifest. Unit: image widths. The principal point is relative to the top
/// left corner; `height` is the image height.
#[derive(Serialize, Deserialize)]
struct PinholeFields {
    focal: f64,
    height: f64,
    centre: [f64; 2],
}

impl TryFrom<PinholeFields> for PinholeEntry {
    type Error = PinholeError;

    fn try_from(fields: PinholeFields) -> Result<Self, PinholeError> {
        Pinhole::new(PixelCamera {
            width: 1.0,
            height: fields.height,
            focal: fields.focal,
            centre: Some(fields.centre.into()),
        })
        .map(Self)
    }
}

impl From<PinholeEntry> for PinholeFields {
    fn from(PinholeEntry(camera): PinholeEntry) -> Self {
        Self {
            focal: camera.focal(),
            height: camera.height(),
            centre: camera.centre().into(),
        }
    }
}

/// The body of an adapter's manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdapterBody {
    pub schema: u64,
    pub adapter: String,
    pub revision: u64,
    /// Time of publication, RFC 3339.
    pub created: String,
    pub source: SourceEntry,
    /// The tensors: weights f32 under PyTorch's names; `target.mean` and `target.deviation` (6,)
    /// f64, ordered (v, ω); and the golden vectors `golden.features`, `golden.latents` and
    /// `golden.twists`, checked at every load.
    pub weights: ObjectRef,
    /// The frame of the twists: always `body`, the body frame of the source camera.
    pub twist_frame: String,
    /// Delta degrees of freedom of `target.deviation`.
    pub deviation_ddof: u32,
    pub training: TrainingEntry,
    /// The room that the adapter was fitted to; absent for an adapter for any room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fitted_to: Option<FittedEntry>,
    /// Whether it belongs to an experiment and is not meant for serving.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub experiment: bool,
}

impl AdapterBody {
    /// All objects of the revision.
    pub fn objects(&self) -> impl Iterator<Item = &ObjectRef> {
        std::iter::once(&self.weights)
    }
}

/// The room of a fitted adapter. The weights object then also has the tensor `fit.rules`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FittedEntry {
    pub room: String,
    pub room_revision: u64,
    /// Name and revision of the base adapter, which predicts motions alongside the fitted one.
    pub base: Option<(String, u64)>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingEntry {
    preset: String,
    split: String,
    stride: u32,
    rooms: Vec<(String, u64)>,
    epochs: usize,
    batch: usize,
    learning_rate: f64,
    weight_decay: f64,
    clip_norm: f64,
    hidden: usize,
    latent: usize,
    /// The number of charts, the paper's K.
    #[serde(default = "one_chart")]
    pub charts: usize,
    /// Mixing of the charts: a learned `gate`, or `even` for an ensemble.
    #[serde(default = "by_gate")]
    mixing: String,
    #[serde(default = "squared_error")]
    loss: String,
    #[serde(default)]
    standardise: bool,
    #[serde(default)]
    noise: f64,
    #[serde(default)]
    average: f64,
    #[serde(default)]
    through_zero: bool,
    /// The calibration rooms with their revisions, on which the adapter's errors were measured. If
    /// there are any, the weights object also has `error.covariance`.
    #[serde(default)]
    calibrated_on: Vec<(String, u64)>,
    /// Names of the correctors. Their tensor names begin with `corrector.NAME.`.
    #[serde(default)]
    pub correctors: Vec<String>,
    /// Smallest stride, largest stride and number of sampled pairs; absent if all pairs of one
    /// stride were used.
    #[serde(default)]
    range: Option<(u32, u32, usize)>,
    seed: u64,
    pair_count: usize,
    /// Test scores of each room, in the order of `rooms`.
    #[serde(default)]
    room_tests: Vec<ScoresEntry>,
    test: ScoresEntry,
    train: ScoresEntry,
    train_mean_r2: Option<f64>,
}

/// R² scores of predicted motions; null if undefined because the targets do not vary.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScoresEntry {
    n: usize,
    #[serde(default)]
    components: [Option<f64>; 6],
    overall: Option<f64>,
    translation: Option<f64>,
    rotation: Option<f64>,
    direction: Option<f64>,
    magnitude: Option<f64>,
    direction_pairs_dropped: usize,
}

impl From<&RoomFit> for FittedEntry {
    fn from(fit: &RoomFit) -> Self {
        Self {
            room: fit.room.to_string(),
            room_revision: fit.room_revision,
            base: fit
                .base
                .as_ref()
                .map(|base| (base.name.clone(), base.revision)),
        }
    }
}

impl From<&FeatureSource> for SourceEntry {
    fn from(source: &FeatureSource) -> Self {
        // Destructured with no `..`, so that a new field of the domain type breaks the build here.
        let FeatureSource {
            name,
            encoder,
            layer,
            base,
            norm,
            pooling,
            preprocess,
            dim,
        } = source.clone();

        Self {
            name,
            encoder,
            layer,
            base,
            norm,
            pooling,
            preprocess,
            dim,
        }
    }
}

impl From<SourceEntry> for FeatureSource {
    fn from(entry: SourceEntry) -> Self {
        let SourceEntry {
            name,
            encoder,
            layer,
            base,
            norm,
            pooling,
            preprocess,
            dim,
        } = entry;

        Self {
            name,
            encoder,
            layer,
            base,
            norm,
            pooling,
            preprocess,
            dim,
        }
    }
}

fn one_chart() -> usize {
    1
}

fn by_gate() -> String {
    Mixing::Gate.name().to_owned()
}

fn squared_error() -> String {
    Loss::MeanSquaredError.name().to_owned()
}

fn unspecified() -> String {
    UNSPECIFIED.to_owned()
}

impl SourceEntry {
    pub fn name(&self) -> &str {
        &self.name
    }
}

impl From<&Provenance> for ProvenanceEntry {
    fn from(provenance: &Provenance) -> Self {
        // Destructured with no `..`, so that a new field of the domain type breaks the build here.
        let Provenance {
            format,
            licence,
            images_root,
            worst_rotation_deviation,
            camera,
        } = provenance.clone();

        Self {
            format,
            licence,
            images_root,
            worst_rotation_deviation,
            camera: camera.map(PinholeEntry),
        }
    }
}

impl From<ProvenanceEntry> for Provenance {
    fn from(entry: ProvenanceEntry) -> Self {
        let ProvenanceEntry {
            format,
            licence,
            images_root,
            worst_rotation_deviation,
            camera,
        } = entry;

        Self {
            format,
            licence,
            images_root,
            worst_rotation_deviation,
            camera: camera.map(|entry| entry.0),
        }
    }
}

impl From<&MotionScores> for ScoresEntry {
    fn from(scores: &MotionScores) -> Self {
        // JSON has no NaN, so an undefined score is stored as null.
        let known = |value: f64| value.is_finite().then_some(value);
        Self {
            n: scores.n,
            components: scores.components.map(known),
            overall: known(scores.overall),
            translation: known(scores.translation),
            rotation: known(scores.rotation),
            direction: known(scores.direction),
            magnitude: known(scores.magnitude),
            direction_pairs_dropped: scores.direction_pairs_dropped,
        }
    }
}

impl From<ScoresEntry> for MotionScores {
    fn from(entry: ScoresEntry) -> Self {
        let value = |value: Option<f64>| value.unwrap_or(f64::NAN);
        Self {
            n: entry.n,
            components: entry.components.map(value),
            overall: value(entry.overall),
            translation: value(entry.translation),
            rotation: value(entry.rotation),
            direction: value(entry.direction),
            magnitude: value(entry.magnitude),
            direction_pairs_dropped: entry.direction_pairs_dropped,
        }
    }
}

impl TrainingEntry {
    /// The manifest entry of an adapter and its training record.
    pub fn new(record: &TrainingRecord, adapter: &Adapter) -> Self {
        // Destructured with no `..`, so that a new setting breaks the build here. The charts and
        // their mixing are taken from the network, so that they describe the stored weights.
        let TrainConfig {
            epochs,
            batch,
            learning_rate,
            weight_decay,
            clip_norm,
            hidden,
            latent,
            charts: _,
            mixing: _,
            loss,
            standardise,
            noise,
            average,
            through_zero,
            seed,
        } = record.config.clone();

        Self {
            preset: record.preset.clone(),
            split: record.split.name().to_owned(),
            stride: record.stride,
            rooms: record
                .rooms
                .iter()
                .map(|(room, revision)| (room.to_string(), *revision))
                .collect(),
            epochs,
            batch,
            learning_rate,
            weight_decay,
            clip_norm,
            hidden,
            latent,
            charts: adapter.network().chart_count(),
            mixing: adapter.network().mixing().name().to_owned(),
            loss: loss.name().to_owned(),
            standardise,
            noise,
            average,
            through_zero,
            calibrated_on: record
                .calibrated_on
                .iter()
                .map(|(room, revision)| (room.to_string(), *revision))
                .collect(),
            correctors: adapter
                .correctors()
                .map(|corrector| corrector.kind().name().to_owned())
                .collect(),
            range: match &record.pairs {
                PairPlan::Stride(_) => None,
                PairPlan::Range(StrideRange { low, high, count }) => Some((*low, *high, *count)),
            },
            seed,
            pair_count: record.pair_count,
            room_tests: record.room_tests.iter().map(Into::into).collect(),
            test: (&record.test).into(),
            train: (&record.train).into(),
            train_mean_r2: record
                .train_mean_r2
                .is_finite()
                .then_some(record.train_mean_r2),
        }
    }

    /// The mixing of the charts. The error is the unknown value.
    pub fn mixing(&self) -> Result<Mixing, String> {
        Mixing::from_name(&self.mixing).ok_or_else(|| format!("mixing '{}'", self.mixing))
    }

    /// The training record. The error is the first unknown value.
    pub fn record(self) -> Result<TrainingRecord, String> {
        let split =
            Split::from_name(&self.split).ok_or_else(|| format!("split '{}'", self.split))?;
        let mixing = self.mixing()?;
        let loss = Loss::from_name(&self.loss).ok_or_else(|| format!("loss '{}'", self.loss))?;

        let room = |(name, revision): (String, u64)| match RoomId::new(&name) {
            Ok(room) => Ok((room, revision)),
            Err(_) => Err(format!("room '{name}'")),
        };

        Ok(TrainingRecord {
            preset: self.preset,
            split,
            stride: self.stride,
            pairs: match self.range {
                None => PairPlan::Stride(self.stride),
                Some((low, high, count)) => PairPlan::Range(StrideRange { low, high, count }),
            },
            rooms: self.rooms.into_iter().map(room).collect::<Result<_, _>>()?,
            calibrated_on: self
                .calibrated_on
                .into_iter()
                .map(room)
                .collect::<Result<_, _>>()?,
            config: TrainConfig {
                epochs: self.epochs,
                batch: self.batch,
                learning_rate: self.learning_rate,
                weight_decay: self.weight_decay,
                clip_norm: self.clip_norm,
                hidden: self.hidden,
                latent: self.latent,
                charts: self.charts,
                mixing,
                loss,
                standardise: self.standardise,
                noise: self.noise,
                average: self.average,
                through_zero: self.through_zero,
                seed: self.seed,
            },
            pair_count: self.pair_count,
            test: self.test.into(),
            room_tests: self.room_tests.into_iter().map(Into::into).collect(),
            train: self.train.into(),
            train_mean_r2: self.train_mean_r2.unwrap_or(f64::NAN),
        })
    }
}

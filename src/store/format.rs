//! Shapes on disk: the bodies of manifests, and safetensors.

use std::collections::BTreeMap;

use ndarray::{Array2, ArrayD};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::{Deserialize, Serialize};

use super::Error;
use super::manifest::ObjectRef;
use crate::adapter::{TrainConfig, TrainingRecord};
use crate::features::{FeatureSource, UNSPECIFIED};
use crate::pairs::Split;
use crate::room::{Provenance, RoomId};
use crate::scores::MotionScores;

/// The body of a room's manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RoomBody {
    pub schema: u64,
    pub room: String,
    pub revision: u64,
    /// RFC 3339.
    pub created: String,
    pub frame_count: usize,
    /// `world_from_camera` (n, 4, 4) f64, metres; where known `timestamps_ns`, `numbers`,
    /// `sequences` and `held_out` (0 or 1), each (n,) i64.
    pub frames: ObjectRef,
    /// A JSON list of the recording's own frame names.
    pub frame_names: Option<ObjectRef>,
    /// A JSON list of where the frames' images are.
    #[serde(default)]
    pub images: Option<ObjectRef>,
    pub features: Vec<FeaturesEntry>,
    pub provenance: ProvenanceEntry,
}

/// One set of features of a room: `features` (n, d) f32.
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
}

/// The body of an adapter's manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdapterBody {
    pub schema: u64,
    pub adapter: String,
    pub revision: u64,
    /// RFC 3339.
    pub created: String,
    pub source: SourceEntry,
    /// Weights f32 under PyTorch's names; `target.mean`, `target.deviation` (6,) f64 ordered (v, ω);
    /// `golden.features`, `golden.latents`, `golden.twists`: run when the adapter is loaded.
    pub weights: ObjectRef,
    /// The frame of the twists: always `body` of the source camera.
    pub twist_frame: String,
    /// Delta degrees of freedom of `target.deviation`.
    pub deviation_ddof: u32,
    pub training: TrainingEntry,
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
    seed: u64,
    pair_count: usize,
    test: ScoresEntry,
    train: ScoresEntry,
    train_mean_r2: Option<f64>,
}

/// R² by component; null where the targets do not vary.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScoresEntry {
    n: usize,
    overall: Option<f64>,
    translation: Option<f64>,
    rotation: Option<f64>,
    direction: Option<f64>,
    magnitude: Option<f64>,
    direction_pairs_dropped: usize,
}

impl From<&FeatureSource> for SourceEntry {
    fn from(source: &FeatureSource) -> Self {
        let FeatureSource { name, encoder, layer, base, norm, pooling, preprocess, dim } = source.clone();
        Self { name, encoder, layer, base, norm, pooling, preprocess, dim }
    }
}

impl From<SourceEntry> for FeatureSource {
    fn from(entry: SourceEntry) -> Self {
        let SourceEntry { name, encoder, layer, base, norm, pooling, preprocess, dim } = entry;
        Self { name, encoder, layer, base, norm, pooling, preprocess, dim }
    }
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
        let Provenance { format, licence, images_root, worst_rotation_deviation } = provenance.clone();
        Self { format, licence, images_root, worst_rotation_deviation }
    }
}

impl From<ProvenanceEntry> for Provenance {
    fn from(entry: ProvenanceEntry) -> Self {
        let ProvenanceEntry { format, licence, images_root, worst_rotation_deviation } = entry;
        Self { format, licence, images_root, worst_rotation_deviation }
    }
}

impl From<&MotionScores> for ScoresEntry {
    fn from(scores: &MotionScores) -> Self {
        let known = |value: f64| value.is_finite().then_some(value);
        Self {
            n: scores.n,
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
            overall: value(entry.overall),
            translation: value(entry.translation),
            rotation: value(entry.rotation),
            direction: value(entry.direction),
            magnitude: value(entry.magnitude),
            direction_pairs_dropped: entry.direction_pairs_dropped,
        }
    }
}

impl From<&TrainingRecord> for TrainingEntry {
    fn from(record: &TrainingRecord) -> Self {
        let TrainConfig { epochs, batch, learning_rate, weight_decay, clip_norm, hidden, latent, seed } =
            record.config.clone();
        Self {
            preset: record.preset.clone(),
            split: record.split.name().to_owned(),
            stride: record.stride,
            rooms: record.rooms.iter().map(|(room, revision)| (room.to_string(), *revision)).collect(),
            epochs,
            batch,
            learning_rate,
            weight_decay,
            clip_norm,
            hidden,
            latent,
            seed,
            pair_count: record.pair_count,
            test: (&record.test).into(),
            train: (&record.train).into(),
            train_mean_r2: record.train_mean_r2.is_finite().then_some(record.train_mean_r2),
        }
    }
}

impl TrainingEntry {
    /// The record, or the word in it that means nothing.
    pub fn record(self) -> Result<TrainingRecord, String> {
        let split = Split::from_name(&self.split).ok_or_else(|| format!("split '{}'", self.split))?;
        let room = |(name, revision): (String, u64)| match RoomId::new(&name) {
            Ok(room) => Ok((room, revision)),
            Err(_) => Err(format!("room '{name}'")),
        };
        Ok(TrainingRecord {
            preset: self.preset,
            split,
            stride: self.stride,
            rooms: self.rooms.into_iter().map(room).collect::<Result<_, _>>()?,
            config: TrainConfig {
                epochs: self.epochs,
                batch: self.batch,
                learning_rate: self.learning_rate,
                weight_decay: self.weight_decay,
                clip_norm: self.clip_norm,
                hidden: self.hidden,
                latent: self.latent,
                seed: self.seed,
            },
            pair_count: self.pair_count,
            test: self.test.into(),
            train: self.train.into(),
            train_mean_r2: self.train_mean_r2.unwrap_or(f64::NAN),
        })
    }
}

/// Tensors by name, to be written.
#[derive(Default)]
pub struct TensorWriter(BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>);

impl TensorWriter {
    pub fn f32(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = f32>) {
        self.0.insert(name.to_owned(), (Dtype::F32, shape.to_vec(), values.flat_map(f32::to_le_bytes).collect()));
    }

    pub fn f64(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = f64>) {
        self.0.insert(name.to_owned(), (Dtype::F64, shape.to_vec(), values.flat_map(f64::to_le_bytes).collect()));
    }

    pub fn i64(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = i64>) {
        self.0.insert(name.to_owned(), (Dtype::I64, shape.to_vec(), values.flat_map(i64::to_le_bytes).collect()));
    }

    /// The file's bytes.
    pub fn finish(self, file: &str) -> Result<Vec<u8>, Error> {
        let damaged = |problem: String| Error::Damaged { file: file.to_owned(), problem };
        let mut views = Vec::with_capacity(self.0.len());
        for (name, (dtype, shape, bytes)) in &self.0 {
            let view = TensorView::new(*dtype, shape.clone(), bytes).map_err(|error| damaged(error.to_string()))?;
            views.push((name.clone(), view));
        }
        safetensors::serialize(views, None).map_err(|error| damaged(error.to_string()))
    }
}

/// A safetensors file that was read.
pub struct TensorReader<'a> {
    file: &'a str,
    tensors: SafeTensors<'a>,
}

impl<'a> TensorReader<'a> {
    pub fn new(file: &'a str, bytes: &'a [u8]) -> Result<Self, Error> {
        let tensors = SafeTensors::deserialize(bytes)
            .map_err(|error| Error::Damaged { file: file.to_owned(), problem: error.to_string() })?;
        Ok(Self { file, tensors })
    }

    pub fn has(&self, name: &str) -> bool {
        self.tensors.tensor(name).is_ok()
    }

    pub fn f32(&self, name: &str) -> Result<Array2<f32>, Error> {
        self.rows(name, Dtype::F32, f32::from_le_bytes)
    }

    pub fn f64(&self, name: &str) -> Result<Array2<f64>, Error> {
        self.rows(name, Dtype::F64, f64::from_le_bytes)
    }

    pub fn i64(&self, name: &str) -> Result<Array2<i64>, Error> {
        self.rows(name, Dtype::I64, i64::from_le_bytes)
    }

    /// A tensor as rows: a vector is one row, the last axes of a stack are laid end to end.
    fn rows<T, const N: usize>(&self, name: &str, dtype: Dtype, read: fn([u8; N]) -> T) -> Result<Array2<T>, Error> {
        let damaged = |problem: String| Error::Damaged { file: self.file.to_owned(), problem };
        let tensor = self.tensors.tensor(name).map_err(|_| damaged(format!("has no tensor '{name}'")))?;
        if tensor.dtype() != dtype {
            return Err(damaged(format!("tensor '{name}' is {:?}, expected {dtype:?}", tensor.dtype())));
        }
        let values = tensor.data().as_chunks::<N>().0.iter().map(|bytes| read(*bytes)).collect();
        let array = ArrayD::from_shape_vec(tensor.shape().to_vec(), values).map_err(|e| damaged(e.to_string()))?;
        let shape = match tensor.shape() {
            [] => (1, 1),
            [columns] => (1, *columns),
            [rows, rest @ ..] => (*rows, rest.iter().product()),
        };
        array.into_shape_with_order(shape).map_err(|error| damaged(error.to_string()))
    }
}

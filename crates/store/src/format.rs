//! On-disk format of manifest bodies (DTOs), separate from the domain types.

use serde::{Deserialize, Serialize};

use super::manifest::ObjectRef;
use super::room_keypoints::KeypointsEntry;
use super::stored_adapter::RoomFit;
use seese3_core::adapter::{
    Adapter, Corrector, CorrectorKind, PairPlan, RelationalConfig, TrainConfig, TrainingRecord,
};
use seese3_core::features::FeatureSource;
use seese3_core::motion_scores::MotionScores;
use seese3_core::recording_extent::RecordingExtent;
use seese3_core::room::{Provenance, RoomId};
use seese3_core::splits::{Split, StrideRange};
use seese3_robot::pose_filter::FilterParameters;

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
    pub images: Option<ObjectRef>,
    pub features: Vec<FeaturesEntry>,
    /// Keypoints with inverse depths, of a room encoded by a model with keypoint heads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keypoints: Option<KeypointsEntry>,
    /// Parameters of filters that track cameras in the room, if they were fitted to it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracking: Option<FilterParameters>,
    /// What the recording covers; absent in revisions of earlier programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extent: Option<RecordingExtent>,
    pub provenance: Provenance,
}

impl RoomBody {
    /// All objects of the revision.
    pub fn objects(&self) -> impl Iterator<Item = &ObjectRef> {
        let names = self.frame_names.iter().chain(&self.images);
        let features = self.features.iter().map(|entry| &entry.object);
        let keypoints = self.keypoints.iter().map(|entry| &entry.object);
        std::iter::once(&self.frames)
            .chain(names)
            .chain(features)
            .chain(keypoints)
    }
}

/// A feature set of a room. Its object has the tensor `features` (n, d) f32.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FeaturesEntry {
    pub source: FeatureSource,
    pub object: ObjectRef,
}

/// The body of an adapter's manifest.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct AdapterBody {
    pub schema: u64,
    pub adapter: String,
    pub revision: u64,
    /// Time of publication, RFC 3339.
    pub created: String,
    pub source: FeatureSource,
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
    /// The room that the adapter belongs to: it is fitted to it, and its name begins with the
    /// room's.
    pub fn owner(&self) -> Option<&str> {
        let room = self.fitted_to.as_ref()?.room.as_str();
        let rest = self.adapter.strip_prefix(room)?;
        rest.starts_with('.').then_some(room)
    }

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

/// A [`TrainingRecord`] with the names of the adapter's correctors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TrainingEntry {
    preset: String,
    split: Split,
    stride: u32,
    /// Smallest stride, largest stride and number of sampled pairs; null if all pairs of one stride
    /// were used.
    range: Option<(u32, u32, usize)>,
    rooms: Vec<(RoomId, u64)>,
    /// The calibration rooms with their revisions, on which the adapter's errors were measured. If
    /// there are any, the weights object also has `error.covariance`.
    calibrated_on: Vec<(RoomId, u64)>,
    #[serde(flatten)]
    pub config: TrainConfig,
    /// Their tensor names begin with `corrector.NAME.`.
    pub correctors: Vec<CorrectorKind>,
    pair_count: usize,
    test: MotionScores,
    train: MotionScores,
    /// Test scores of each room, in the order of `rooms`.
    room_tests: Vec<MotionScores>,
    /// Null if the targets do not vary.
    train_mean_r2: Option<f64>,
    /// Settings of the relational reader; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub relational: Option<RelationalConfig>,
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

impl TrainingEntry {
    /// The manifest entry of an adapter and its training record.
    pub fn new(record: &TrainingRecord, adapter: &Adapter) -> Self {
        // Destructured with no `..`, so that a new field breaks the build here.
        let TrainingRecord {
            preset,
            split,
            stride,
            pairs,
            rooms,
            calibrated_on,
            config,
            pair_count,
            test,
            room_tests,
            train,
            train_mean_r2,
            relational,
        } = record.clone();

        Self {
            preset,
            split,
            stride,
            range: match pairs {
                PairPlan::Stride(_) => None,
                PairPlan::Range(StrideRange { low, high, count }) => Some((low, high, count)),
            },
            rooms,
            calibrated_on,
            // The charts and their mixing describe the stored weights.
            config: TrainConfig {
                charts: adapter.network().chart_count(),
                mixing: adapter.network().mixing(),
                ..config
            },
            correctors: adapter.correctors().map(Corrector::kind).collect(),
            pair_count,
            test,
            train,
            room_tests,
            train_mean_r2: train_mean_r2.is_finite().then_some(train_mean_r2),
            relational,
        }
    }
}

impl From<TrainingEntry> for TrainingRecord {
    fn from(entry: TrainingEntry) -> Self {
        let TrainingEntry {
            preset,
            split,
            stride,
            range,
            rooms,
            calibrated_on,
            config,
            correctors: _,
            pair_count,
            test,
            train,
            room_tests,
            train_mean_r2,
            relational,
        } = entry;

        Self {
            preset,
            split,
            stride,
            pairs: match range {
                None => PairPlan::Stride(stride),
                Some((low, high, count)) => PairPlan::Range(StrideRange { low, high, count }),
            },
            rooms,
            calibrated_on,
            config,
            pair_count,
            test,
            train,
            room_tests,
            train_mean_r2: train_mean_r2.unwrap_or(f64::NAN),
            relational,
        }
    }
}

//! Localization of a single view in a mapped room.

use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView2};

use super::hypotheses::{MotionHypotheses, PartRule};
use super::rules::ReadingRules;
use super::{Error, check_mapped};
use crate::tracking::PoseWithCovariance;
use seese3_core::adapter::{self, Adapter, column_scale};
use seese3_core::geometry::{Pose, Twist, body_twist, exp};
use seese3_core::index::{ExactIndex, Index, Neighbor};
use seese3_core::room::FrameId;
use seese3_core::statistics::median;
use seese3_core::training::RoomData;

/// Localizes views relative to their most similar mapped frame.
pub struct Localizer {
    poses: Vec<Pose>,
    standardization: Standardization,
    index: ExactIndex,
    zero_shot: Option<Embedded>,
    fitted: Option<Embedded>,
}

/// Number of nearest mapped frames from which the pose is estimated, to measure the disagreement.
const WITNESSES: usize = 4;

/// Estimated pose of a view.
#[derive(Debug, Clone, PartialEq)]
pub struct LocatedView {
    /// Most similar mapped frame; its distance is in standard deviations of a feature column.
    pub nearest: Neighbor,
    /// `world_from_camera`, with the covariance of its error in its body frame.
    pub pose: PoseWithCovariance,
    /// Estimator of the translation from that frame.
    pub translation: PartRule,
    /// Estimator of the rotation from that frame.
    pub rotation: PartRule,
}

/// Z-scoring of features, so that distances are comparable between rooms.
struct Standardization {
    mean: Array1<f64>,
    /// Standard deviation of each column times √d: a distance is a root mean square over columns.
    scale: Array1<f64>,
}

impl Standardization {
    fn of(rows: ArrayView2<'_, f64>) -> Self {
        let (mean, deviation) = column_scale(rows);
        let scale = deviation * (rows.ncols() as f64).sqrt();
        Self { mean, scale }
    }

    fn rows(&self, rows: ArrayView2<'_, f64>) -> Array2<f64> {
        (&rows - &self.mean) / &self.scale
    }
}

/// An adapter and its latents of the room's frames.
struct Embedded {
    adapter: Arc<Adapter>,
    latents: Array2<f64>,
}

impl Embedded {
    fn new(adapter: Arc<Adapter>, data: &RoomData<'_>) -> Result<Self, adapter::Error> {
        adapter.check_source(data.features.source())?;
        let latents = adapter.embed(data.features.rows())?;
        Ok(Self { adapter, latents })
    }

    /// Motion from a frame to a view; zero if the estimate is a half turn, which has no unique
    /// logarithm and is implausible between similar views.
    fn motion(&self, from: FrameId, feature: &[f32]) -> Result<Twist, adapter::Error> {
        let latent = self.adapter.embed_one(feature)?;
        let motion = self
            .adapter
            .motion_without_mean(self.latents.row(from.row()), latent.view());

        Ok(if motion.is_unique_logarithm() {
            motion
        } else {
            Twist::default()
        })
    }
}

impl Localizer {
    /// Builds a localizer over the mapped frames of a room, in ascending order. `zero_shot` is an
    /// adapter trained on other rooms, `fitted` an adapter fitted to these frames.
    ///
    /// # Errors
    /// - [`Error::FewFrames`] if there is no mapped frame.
    /// - [`Error::MappedFrames`] if the frames do not exist or are not in ascending order.
    /// - [`Error::Adapter`] if the room's features have another source than an adapter's.
    pub fn new(
        data: &RoomData<'_>,
        mapped: &[FrameId],
        zero_shot: Option<Arc<Adapter>>,
        fitted: Option<Arc<Adapter>>,
    ) -> Result<Self, Error> {
        check_mapped(data.room, mapped, 1)?;
        let rows = data.features.rows().mapv(f64::from);
        let known: Vec<usize> = mapped.iter().map(|frame| frame.row()).collect();
        let standardization = Standardization::of(rows.select(ndarray::Axis(0), &known).view());
        let standardized = standardization.rows(rows.view());

        let embedded = |adapter: Option<Arc<Adapter>>| {
            adapter
                .map(|adapter| Embedded::new(adapter, data))
                .transpose()
        };

        Ok(Self {
            poses: data.room.poses().to_vec(),
            index: ExactIndex::new(standardized.view(), mapped),
            standardization,
            zero_shot: embedded(zero_shot)?,
            fitted: embedded(fitted)?,
        })
    }

    /// Approximate memory use without the adapters, bytes.
    pub fn memory_bytes(&self) -> usize {
        let embedded = self.zero_shot.iter().chain(&self.fitted);
        let latents: usize = embedded.map(|embedded| embedded.latents.len()).sum();

        size_of_val(self.poses.as_slice()) + latents * size_of::<f64>() + self.index.memory_bytes()
    }

    /// Estimates a view's motion from its nearest mapped frame with each adapter. `feature` is the
    /// raw feature, shape (d,).
    ///
    /// # Errors
    /// [`Error::Adapter`] if the feature has the wrong width or a value is not finite.
    pub fn read(&self, feature: &[f32]) -> Result<MotionHypotheses, Error> {
        let expected = self.standardization.mean.len();
        if feature.len() != expected {
            let actual = feature.len();
            return Err(adapter::Error::FeatureDim { expected, actual }.into());
        }
        if let Some(position) = feature.iter().position(|x| !x.is_finite()) {
            return Err(adapter::Error::NotFinite {
                what: "feature",
                position,
                value: f64::from(feature[position]),
            }
            .into());
        }

        let row = Array2::from_shape_fn((1, expected), |(_, column)| f64::from(feature[column]));
        let query = self.standardization.rows(row.view()).row(0).to_vec();
        let witnesses = self.index.nearest(&query, WITNESSES, None);
        let nearest = witnesses[0];

        let zero_shot = self.motion_by(&self.zero_shot, nearest.frame, feature)?;
        let fitted = self.motion_by(&self.fitted, nearest.frame, feature)?;

        Ok(MotionHypotheses {
            nearest,
            distance: nearest.distance,
            zero_shot,
            fitted,
            disagreement: self.disagreement(&witnesses, feature)?,
        })
    }

    fn motion_by(
        &self,
        reader: &Option<Embedded>,
        from: FrameId,
        feature: &[f32],
    ) -> Result<Option<Twist>, Error> {
        let motion = reader
            .as_ref()
            .map(|embedded| embedded.motion(from, feature));
        Ok(motion.transpose()?)
    }

    /// Median distance from the pose estimated relative to the first witness to the poses estimated
    /// relative to the others; see [`MotionHypotheses::disagreement`].
    fn disagreement(&self, witnesses: &[Neighbor], feature: &[f32]) -> Result<f64, Error> {
        let best_informed = if self.fitted.is_some() {
            &self.fitted
        } else {
            &self.zero_shot
        };

        let mut poses = Vec::with_capacity(witnesses.len());
        for witness in witnesses {
            let motion = self.motion_by(best_informed, witness.frame, feature)?;
            poses.push(self.pose(witness.frame) * exp(&motion.unwrap_or_default()));
        }

        let apart: Vec<f64> = poses[1..]
            .iter()
            .map(|pose| body_twist(&poses[0], pose).norm())
            .collect();
        Ok(if apart.is_empty() {
            0.0
        } else {
            median(&apart)
        })
    }

    /// The adapters in use: zero-shot, then fitted.
    pub fn adapters(&self) -> impl Iterator<Item = &Arc<Adapter>> {
        let readers = [&self.zero_shot, &self.fitted];
        readers
            .into_iter()
            .flatten()
            .map(|embedded| &embedded.adapter)
    }

    /// Pose of a frame, `world_from_camera`.
    pub fn pose(&self, frame: FrameId) -> &Pose {
        &self.poses[frame.row()]
    }

    /// Estimates the pose of a view from its raw feature, with the rules measured for this map.
    ///
    /// # Errors
    /// As [`Localizer::read`].
    pub fn locate(&self, feature: &[f32], rules: &ReadingRules) -> Result<LocatedView, Error> {
        Ok(self.located(&self.read(feature)?, rules))
    }

    /// Estimates the pose of a view from its motion hypotheses.
    pub fn located(&self, readings: &MotionHypotheses, rules: &ReadingRules) -> LocatedView {
        let rule = rules.at(readings.distance);
        let motion = readings.combined(rule.translation, rule.rotation);

        LocatedView {
            nearest: readings.nearest,
            pose: PoseWithCovariance {
                pose: self.pose(readings.nearest.frame) * exp(&motion),
                covariance: rule.covariance_at(readings.distance, readings.disagreement),
            },
            translation: rule.translation,
            rotation: rule.rotation,
        }
    }
}

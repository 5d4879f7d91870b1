//! A room's localizer with its cross-validated reading rules.

use std::sync::Arc;

use super::{Error, Fitted, Localizer, LocatedView, ReadingRules};
use crate::tracking::{PoseReader, PoseWithCovariance};
use seese3_core::adapter::Adapter;
use seese3_core::room::FrameId;
use seese3_core::training::RoomData;

/// Localizes single views of one room with an adapter fitted to it.
pub struct RoomReader {
    /// Estimates motions from the most similar mapped frame.
    pub localizer: Localizer,
    /// Estimator, gain and covariance by distance from the map.
    pub rules: ReadingRules,
}

impl RoomReader {
    /// Builds the reader of an adapter fitted to these mapped frames; `base` is the adapter that
    /// the fit started from.
    ///
    /// # Errors
    /// As [`Localizer::new`].
    pub fn new(
        data: &RoomData<'_>,
        mapped: &[FrameId],
        base: Option<Arc<Adapter>>,
        fitted: &Fitted,
    ) -> Result<Self, Error> {
        Ok(Self {
            localizer: Localizer::new(data, mapped, base, Some(fitted.adapter.clone()))?,
            rules: fitted.rules.clone(),
        })
    }

    /// Estimates the pose of a view from its raw feature, shape (d,).
    ///
    /// # Errors
    /// As [`Localizer::read`].
    pub fn locate(&self, feature: &[f32]) -> Result<LocatedView, Error> {
        self.localizer.locate(feature, &self.rules)
    }
}

impl PoseReader for RoomReader {
    /// `None` also if the view is farther from the map than all held-out views of the rules:
    /// there the errors exceed the covariance.
    fn read_pose(&self, feature: &[f32]) -> Option<PoseWithCovariance> {
        let view = self.locate(feature).ok()?;
        let furthest = self.rules.rules().last()?.up_to;
        (view.nearest.distance <= furthest).then_some(view.pose)
    }

    fn distance_over_range(&self, feature: &[f32]) -> Option<f64> {
        let view = self.locate(feature).ok()?;
        Some(view.nearest.distance / self.rules.rules().last()?.up_to)
    }
}

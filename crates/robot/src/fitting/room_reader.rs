//! A room's localizer with the rules that were measured for it: what reads single views of the room.

use std::sync::Arc;

use super::{Error, Fitted, Localizer, LocatedView, ReadingRules};
use crate::tracking::{PoseReader, PoseWithCovariance};
use seese3_core::adapter::Adapter;
use seese3_core::room::FrameId;
use seese3_core::training::RoomData;

/// Locates single views of one room, by an adapter that was fitted to it.
pub struct RoomReader {
    /// Reads where a view is from the frame that it resembles most.
    pub localizer: Localizer,
    /// How far it is believed.
    pub rules: ReadingRules,
}

impl RoomReader {
    /// The reader of an adapter that was fitted to these mapped frames; `base` is the adapter that
    /// it began from.
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

    /// Where the camera of a view is, from its raw feature of shape (d,).
    ///
    /// # Errors
    /// As [`Localizer::read`].
    pub fn locate(&self, feature: &[f32]) -> Result<LocatedView, Error> {
        self.localizer.locate(feature, &self.rules)
    }
}

impl PoseReader for RoomReader {
    /// None also for a view that is further from the map than any that the rules were made for:
    /// what is read there errs more than its covariance says.
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

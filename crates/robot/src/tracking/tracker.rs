//! The tracker: its maps, its settings and the adapter's error model.

use std::sync::Arc;

use ndarray::{ArrayView1, Axis, s};

use super::{Error, Map};
use seese3_core::adapter::{Adapter, ErrorModel};

/// Settings of a tracker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerSettings {
    /// Keyframe interval, in frame periods of the calibration rooms; at least 1.
    pub keyframe_frames: u32,
    /// Motion since the keyframe that triggers a new one, ‖(v, ω)‖, meters and radians mixed;
    /// above 0.
    pub keyframe_displacement: f64,
    /// Whether matching mapped frames correct the map pose.
    pub fuse: bool,
}

impl TrackerSettings {
    /// Default settings for an adapter. They keep motions within the trained and calibrated range:
    /// the keyframe interval is the longest calibrated motion, and the displacement is twice the
    /// root mean square length of the trained motions.
    ///
    /// Latent differences add up, so more keyframes do not improve the path. The measured errors
    /// hold only for a single predicted motion since the last map pose.
    pub fn of(adapter: &Adapter) -> Self {
        let scale = adapter.scale();
        let mean_square = scale.mean.norm_squared() + scale.deviation.norm_squared();
        let longest = adapter
            .error_model()
            .map_or(1.0, |error_model| error_model.longest_frames());

        Self {
            keyframe_frames: longest as u32,
            keyframe_displacement: 2.0 * mean_square.sqrt(),
            fuse: true,
        }
    }
}

/// Tracks cameras through the maps of one adapter.
pub struct Tracker {
    pub(super) maps: Vec<Arc<Map>>,
    pub(super) settings: TrackerSettings,
    pub(super) error_model: Arc<ErrorModel>,
    pub(super) map_pose_factor: f64,
}

impl Tracker {
    /// Builds a tracker over one or more maps that share an adapter.
    ///
    /// # Errors
    /// [`Error::NoMap`] without a map, [`Error::Adapters`] if the maps have different adapters,
    /// [`Error::NotCalibrated`] if the adapter has no error model.
    pub fn new(maps: Vec<Arc<Map>>, settings: TrackerSettings) -> Result<Self, Error> {
        let adapter = maps
            .first()
            .ok_or(Error::NoMap)?
            .navigator()
            .adapter()
            .clone();
        if maps
            .iter()
            .any(|map| !Arc::ptr_eq(map.navigator().adapter(), &adapter))
        {
            return Err(Error::Adapters);
        }

        let error_model = adapter.error_model().ok_or(Error::NotCalibrated)?.clone();
        let map_pose_factor = error_model.statistics().map_pose_factor;

        Ok(Self {
            maps,
            settings,
            error_model,
            map_pose_factor,
        })
    }

    /// Replaces the map-pose factor of the error model; used by calibration to search the factor.
    #[must_use]
    pub fn with_map_pose_factor(self, map_pose_factor: f64) -> Self {
        Self {
            map_pose_factor,
            ..self
        }
    }

    /// The maps.
    pub fn maps(&self) -> &[Arc<Map>] {
        &self.maps
    }

    /// The settings.
    pub fn settings(&self) -> TrackerSettings {
        self.settings
    }

    pub(super) fn adapter(&self) -> &Arc<Adapter> {
        self.maps[0].navigator().adapter()
    }

    /// Whitens a latent of shape (k,): the result is in standard deviations of frame noise.
    pub(super) fn whitened(&self, latent: ArrayView1<'_, f64>) -> Vec<f64> {
        let coordinates = latent.slice(s![..self.adapter().coordinate_count()]);
        self.error_model
            .frame_noise()
            .whitened(coordinates.insert_axis(Axis(0)))
            .row(0)
            .to_vec()
    }
}

//! A tracker: the maps that it tracks in, its settings, and the adapter's error model.

use std::sync::Arc;

use ndarray::{ArrayView1, Axis, s};

use super::{Error, Map};
use seese3_core::adapter::{Adapter, ErrorModel};

/// Settings of a tracker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerSettings {
    /// A new keyframe is taken after the time that so many frames took in the rooms where the
    /// adapter's errors were measured; at least 1.
    pub keyframe_frames: u32,
    /// A new keyframe is taken after a motion of this length, ‖(v, ω)‖, metres and radians mixed;
    /// above 0.
    pub keyframe_displacement: f64,
    /// Whether mapped frames that look alike correct the pose.
    pub fuse: bool,
}

impl TrackerSettings {
    /// Settings that keep motions within those that the adapter was trained for and its errors were
    /// measured over: a keyframe after as many frames as the longest of them, or after twice the
    /// root mean square of their lengths.
    ///
    /// Differences of latents add up, so many keyframes read a path no better than few; the
    /// measured errors only hold while a single motion is read since the last map pose.
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
    /// A tracker over one or more maps that share an adapter.
    ///
    /// # Errors
    /// [`Error::NoMap`] without a map, [`Error::Adapters`] when the maps have several adapters,
    /// [`Error::NotCalibrated`] when the adapter has no error model.
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

    /// The same tracker with another factor of the covariances of corrected map poses. Calibration
    /// searches the right one with it.
    #[must_use]
    pub fn with_map_pose_factor(self, map_pose_factor: f64) -> Self {
        Self {
            map_pose_factor,
            ..self
        }
    }

    /// The maps that cameras are tracked in.
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

    /// A latent of shape (k,) in standard deviations of frame noise.
    pub(super) fn whitened(&self, latent: ArrayView1<'_, f64>) -> Vec<f64> {
        let coordinates = latent.slice(s![..self.adapter().coordinate_count()]);
        self.error_model
            .frame_noise()
            .whitened(coordinates.insert_axis(Axis(0)))
            .row(0)
            .to_vec()
    }
}

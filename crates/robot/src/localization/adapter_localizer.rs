//! Estimates a view's pose from the most similar mapped frames.

use nalgebra::Matrix6;

use super::Method;
use crate::tracking::{Map, MapQuery, PoseReader, PoseWithCovariance};
use seese3_core::geometry::Pose;
use seese3_core::navigation::Navigator;

/// A room under an adapter.
#[derive(Clone, Copy)]
pub struct AdapterLocalizer<'a> {
    /// The room with the adapter's latents.
    pub navigator: &'a Navigator,
    /// Map of the room, if the adapter is calibrated.
    pub map: Option<&'a Map>,
    /// Localizer from raw features, if an adapter was fitted to the room.
    pub reader: Option<&'a dyn PoseReader>,
}

/// Pose of a view from the most similar mapped frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdapterEstimate {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Covariance of δ in true = pose · exp(δ), ordered (v, ω), meters and radians; `None` for
    /// [`Method::NearestFrame`].
    pub covariance: Option<Matrix6<f64>>,
    /// How the pose was estimated.
    pub method: Method,
    /// Distance of the view from the room divided by the room's limit: above 1 the view looks like
    /// another place. `None` without a calibrated or fitted adapter.
    pub novelty: Option<f64>,
}

impl AdapterLocalizer<'_> {
    /// Estimates the pose of a view.
    ///
    /// The pose comes from the fitted adapter, within its validated range. Otherwise it is blended
    /// from the most similar frames of the map. Without a calibrated adapter it is the pose of the
    /// nearest frame.
    pub fn estimate(&self, query: MapQuery<'_>) -> AdapterEstimate {
        let matched = self.map.map(|map| map.match_view(query, 1));
        let reader = self.reader.zip(query.feature);
        let fitted = reader.and_then(|(reader, feature)| reader.read_pose(feature));

        // Without a calibrated adapter, the validated range of the reader is the limit.
        let novelty = match &matched {
            Some(found) => Some(found.out_of_distribution),
            None => reader.and_then(|(reader, feature)| reader.distance_over_range(feature)),
        };

        let blended = matched.map(|found| found.pose);
        let (pose, method): (PoseWithCovariance, Method) = match (fitted, blended) {
            (Some(fitted), _) => (fitted, Method::FittedAdapter),
            (None, Some(blended)) => (blended, Method::SimilarFrames),
            (None, None) => {
                return AdapterEstimate {
                    // A room has at least one frame, so the list of nearest frames is not empty.
                    pose: self.navigator.nearest(query.latent, 1)[0].pose,
                    covariance: None,
                    method: Method::NearestFrame,
                    novelty,
                };
            }
        };

        AdapterEstimate {
            pose: pose.pose,
            covariance: Some(pose.covariance),
            method,
            novelty,
        }
    }
}

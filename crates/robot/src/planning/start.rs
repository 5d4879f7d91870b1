//! The estimated start pose of a route.

use nalgebra::Matrix6;
use ndarray::ArrayView1;

use crate::tracking::{Map, MapQuery, PoseReader, PoseWithCovariance};
use seese3_core::geometry::Pose;
use seese3_core::navigation::Navigator;

/// The localizers of one room.
#[derive(Clone, Copy)]
pub struct KnownRoom<'a> {
    /// The room with an adapter's latents.
    pub navigator: &'a Navigator,
    /// Map of the room, if the adapter is calibrated.
    pub map: Option<&'a Map>,
    /// Localizer from raw features, if an adapter was fitted to the room.
    pub reader: Option<&'a dyn PoseReader>,
}

/// Estimated start pose of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct BelievedStart {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Covariance of the pose error in its own body frame. Present only if the pose was estimated
    /// from the view by a fitted or calibrated adapter.
    pub covariance: Option<Matrix6<f64>>,
    /// Distance of the view divided by the room's limit, if known: above 1 the view is out of
    /// distribution.
    pub out_of_distribution: Option<f64>,
    /// Whether the pose was estimated from the view, not recorded or given.
    is_seen: bool,
}

impl BelievedStart {
    /// A start at a recorded pose, for example that of a mapped frame.
    pub fn recorded(pose: Pose) -> Self {
        Self {
            pose,
            covariance: None,
            out_of_distribution: None,
            is_seen: false,
        }
    }

    /// A start at a pose given by the caller, for a view with this latent, shape (k,).
    pub fn given(pose: Pose, room: KnownRoom<'_>, latent: ArrayView1<'_, f64>) -> Self {
        let matched = room
            .map
            .map(|map| map.match_view(MapQuery::of_latent(latent), 1));
        Self {
            out_of_distribution: matched.map(|found| found.out_of_distribution),
            ..Self::recorded(pose)
        }
    }

    /// Estimates the start pose from a view: its latent, shape (k,), and its raw feature, shape
    /// (d,), if known.
    ///
    /// The pose comes from the fitted adapter, within its validated range. Otherwise it is blended
    /// from the most similar frames of the map. Without a calibrated adapter it is the pose of the
    /// nearest frame.
    pub fn seen(room: KnownRoom<'_>, latent: ArrayView1<'_, f64>, feature: Option<&[f32]>) -> Self {
        let query = MapQuery { latent, feature };
        let matched = room.map.map(|map| map.match_view(query, 1));
        let reader = room.reader.zip(feature);
        let read = reader.and_then(|(reader, feature)| reader.read_pose(feature));

        // Without a calibrated adapter, the validated range of the reader is the limit.
        let out_of_distribution = match &matched {
            Some(found) => Some(found.out_of_distribution),
            None => reader.and_then(|(reader, feature)| reader.distance_over_range(feature)),
        };

        let belief: Option<PoseWithCovariance> = read.or(matched.map(|found| found.anchor.belief));
        Self {
            // A room has at least one frame, so the list of nearest frames is not empty.
            pose: match &belief {
                Some(belief) => belief.pose,
                None => room.navigator.nearest(latent, 1)[0].pose,
            },
            covariance: belief.map(|belief| belief.covariance),
            out_of_distribution,
            is_seen: true,
        }
    }

    /// Out-of-distribution ratio, if it is above 1 and the pose was estimated from the view. Such a
    /// pose must not be used.
    pub fn beyond_limit(&self) -> Option<f64> {
        self.out_of_distribution
            .filter(|far| *far > 1.0 && self.is_seen)
    }
}

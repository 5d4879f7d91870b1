//! Where a camera is believed to be before it is planned for.

use nalgebra::Matrix6;
use ndarray::ArrayView1;

use crate::tracking::{Map, MapQuery, PoseReader, PoseWithCovariance};
use seese3_core::geometry::Pose;
use seese3_core::navigation::Navigator;

/// What tells where the view of a camera is in a room.
#[derive(Clone, Copy)]
pub struct KnownRoom<'a> {
    /// The room under an adapter.
    pub navigator: &'a Navigator,
    /// Its map, if the adapter is calibrated.
    pub map: Option<&'a Map>,
    /// What reads raw features of this room, if an adapter was fitted to it.
    pub reader: Option<&'a dyn PoseReader>,
}

/// The believed pose of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct BelievedStart {
    /// `world_from_camera`.
    pub pose: Pose,
    /// The covariance of its error in its own body frame, where it is known: of a pose that the
    /// view tells, by a calibrated adapter.
    pub covariance: Option<Matrix6<f64>>,
    /// The view's distance over the room's limit, where that is known: above 1 it looks like
    /// another place.
    pub out_of_distribution: Option<f64>,
    /// Whether the view told the pose. Else it was recorded or given.
    is_seen: bool,
}

impl BelievedStart {
    /// A pose that is recorded.
    pub fn recorded(pose: Pose) -> Self {
        Self {
            pose,
            covariance: None,
            out_of_distribution: None,
            is_seen: false,
        }
    }

    /// A pose that the caller gives for a view with this latent, of shape (k,).
    pub fn given(pose: Pose, room: KnownRoom<'_>, latent: ArrayView1<'_, f64>) -> Self {
        let matched = room
            .map
            .map(|map| map.match_view(MapQuery::of_latent(latent), 1));
        Self {
            out_of_distribution: matched.map(|found| found.out_of_distribution),
            ..Self::recorded(pose)
        }
    }

    /// The pose that a view tells, by its latent of shape (k,) and, if it is known, its raw feature
    /// of shape (d,): as the adapter reads it that was fitted to the room, as far as that was
    /// measured; else between the frames that look most like it; else, without a calibrated
    /// adapter, that of the nearest frame.
    pub fn seen(room: KnownRoom<'_>, latent: ArrayView1<'_, f64>, feature: Option<&[f32]>) -> Self {
        let query = MapQuery { latent, feature };
        let matched = room.map.map(|map| map.match_view(query, 1));
        let reader = room.reader.zip(feature);
        let read = reader.and_then(|(reader, feature)| reader.read_pose(feature));

        // Without a calibrated adapter the range of the reader tells what is not of this room.
        let out_of_distribution = match &matched {
            Some(found) => Some(found.out_of_distribution),
            None => reader.and_then(|(reader, feature)| reader.distance_over_range(feature)),
        };

        let belief: Option<PoseWithCovariance> = read.or(matched.map(|found| found.anchor.belief));
        Self {
            // A room has frames, so that one is nearest.
            pose: match &belief {
                Some(belief) => belief.pose,
                None => room.navigator.nearest(latent, 1)[0].pose,
            },
            covariance: belief.map(|belief| belief.covariance),
            out_of_distribution,
            is_seen: true,
        }
    }

    /// How many times as far from the room as its limit the view is, if it is and its pose was told
    /// by the view: that pose means nothing.
    pub fn beyond_limit(&self) -> Option<f64> {
        self.out_of_distribution
            .filter(|far| *far > 1.0 && self.is_seen)
    }
}

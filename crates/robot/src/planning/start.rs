//! The estimated start pose of a route.

use nalgebra::Matrix6;

use crate::localization::{AdapterEstimate, NotInRoom, PoseEstimate};
use crate::tracking::{Map, MapQuery};
use seese3_core::geometry::Pose;

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
    /// Whether the view is not located in the room, although its most similar frames have a pose.
    is_rejected: bool,
}

impl BelievedStart {
    /// A start at a recorded pose, for example that of a mapped frame.
    pub fn recorded(pose: Pose) -> Self {
        Self {
            pose,
            covariance: None,
            out_of_distribution: None,
            is_seen: false,
            is_rejected: false,
        }
    }

    /// A start at a pose given by the caller, for a view of the room with this map, if it has one.
    pub fn given(pose: Pose, map: Option<&Map>, query: MapQuery<'_>) -> Self {
        let matched = map.map(|map| map.match_view(query, 1));
        Self {
            out_of_distribution: matched.map(|found| found.out_of_distribution),
            ..Self::recorded(pose)
        }
    }

    /// A start at the pose that the most similar frames give.
    pub fn of_adapter(estimate: AdapterEstimate) -> Self {
        Self {
            pose: estimate.pose,
            covariance: estimate.covariance,
            out_of_distribution: estimate.novelty,
            is_seen: true,
            is_rejected: false,
        }
    }

    /// A start at the estimated pose of a view. A view that is not in the room keeps the pose of
    /// the most similar frames, beyond the limit; `None` if there is no such pose.
    pub fn seen(found: Result<PoseEstimate, NotInRoom>) -> Option<Self> {
        match found {
            Ok(estimate) => Some(Self {
                pose: estimate.pose,
                covariance: estimate.covariance,
                out_of_distribution: estimate.novelty,
                is_seen: true,
                is_rejected: false,
            }),
            Err(NotInRoom {
                nearest, novelty, ..
            }) => Some(Self {
                out_of_distribution: novelty,
                is_rejected: true,
                ..Self::of_adapter(*nearest?)
            }),
        }
    }

    /// Whether the pose was estimated from a view that is not located in the room. Such a pose must
    /// not be used.
    pub fn is_unknown(&self) -> bool {
        let is_far = self.out_of_distribution.is_some_and(|far| far > 1.0);
        self.is_seen && (self.is_rejected || is_far)
    }
}

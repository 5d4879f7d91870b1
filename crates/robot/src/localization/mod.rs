//! Estimates where a view is in a mapped room.
//!
//! - [`KeypointRoom`] matches the keypoints of a view with those of the map.
//! - [`AdapterLocalizer`] estimates the pose from the most similar mapped frames: by the adapter
//!   that is fitted to the room, by a blend of several frames, or by the nearest frame.
//! - [`RoomLocalizer`] chooses between them. Matched keypoints come first. The others answer only
//!   if the view resembles the room.

mod adapter_localizer;
mod camera_search;
mod keypoint_room;

pub use adapter_localizer::{AdapterEstimate, AdapterLocalizer};
pub use camera_search::{FOCAL_CANDIDATES, camera_of_views};
pub use keypoint_room::{KeypointRoom, LocatedView, NotLocated};

use nalgebra::Matrix6;

use crate::matched_views::ViewKeypoints;
use crate::tracking::MapQuery;
use seese3_core::geometry::Pose;

/// How a pose was estimated from a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// From keypoints that were matched with those of the map.
    MatchedKeypoints,
    /// By the adapter that is fitted to the room.
    FittedAdapter,
    /// From several similar mapped frames.
    SimilarFrames,
    /// The pose of the most similar mapped frame.
    NearestFrame,
}

/// The localizers of one room.
#[derive(Clone, Copy, Default)]
pub struct RoomLocalizer<'a> {
    /// The keypoints of the room, if it has any.
    pub keypoints: Option<&'a KeypointRoom>,
    /// The room under an adapter, if one serves it.
    pub adapter: Option<AdapterLocalizer<'a>>,
}

/// What is known of a view.
#[derive(Clone, Copy)]
pub struct ViewToLocate<'a> {
    /// Its keypoints and camera, if it is an image.
    pub keypoints: Option<ViewKeypoints<'a>>,
    /// Its latent and feature under the adapter of [`RoomLocalizer`].
    pub query: Option<MapQuery<'a>>,
}

/// Estimated pose of a view.
#[derive(Debug, Clone)]
pub struct PoseEstimate {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Covariance of δ in true = pose · exp(δ), ordered (v, ω), meters and radians; `None` if the
    /// errors of the method were not measured.
    pub covariance: Option<Matrix6<f64>>,
    /// How the pose was estimated.
    pub method: Method,
    /// How unlike the view is to the room, relative to the limit of the method; at most 1. `None`
    /// if unknown.
    pub novelty: Option<f64>,
    /// The matched keypoints of [`Method::MatchedKeypoints`].
    pub located: Option<LocatedView>,
    /// Why matched keypoints did not give the pose, if they were tried.
    pub unmatched: Option<NotLocated>,
}

/// A view that is not in the map, as far as is known.
#[derive(Debug, Clone, PartialEq)]
pub struct NotInRoom {
    /// How unlike the view is to the room, relative to the limit; above 1.
    pub novelty: f64,
    /// Why its keypoints do not locate it, if they were tried.
    pub unmatched: Option<NotLocated>,
    /// The estimate from the most similar frames, which is not to be trusted.
    pub nearest: Option<Box<AdapterEstimate>>,
}

impl RoomLocalizer<'_> {
    /// Estimates the pose of a view.
    ///
    /// # Errors
    /// [`NotInRoom`] if too few keypoints agree with the map and the view does not resemble the
    /// mapped frames either.
    pub fn locate(&self, view: ViewToLocate<'_>) -> Result<PoseEstimate, NotInRoom> {
        let unmatched = match self.keypoints.zip(view.keypoints) {
            Some((room, keypoints)) => match room.locate(keypoints) {
                Ok(located) => return Ok(PoseEstimate::matched(located)),
                Err(why) => Some(why),
            },
            None => None,
        };

        self.locate_by_similarity(view.query, unmatched)
    }

    /// Estimates the pose of a view from the most similar mapped frames. `unmatched` is why its
    /// keypoints do not locate it, if they were tried.
    ///
    /// # Errors
    /// As [`Self::locate`].
    pub fn locate_by_similarity(
        &self,
        query: Option<MapQuery<'_>>,
        unmatched: Option<NotLocated>,
    ) -> Result<PoseEstimate, NotInRoom> {
        let adapter = self.adapter.zip(query);
        let nearest = adapter.map(|(adapter, query)| adapter.estimate(query));
        let by_keypoints = unmatched.map(|why| why.novelty());
        let novelty = match &nearest {
            Some(estimate) => estimate.novelty.or(by_keypoints),
            None => Some(by_keypoints.unwrap_or(f64::INFINITY)),
        };

        // A wrong camera is the caller's mistake, which a less accurate method must not hide.
        let is_contradicted = matches!(unmatched, Some(NotLocated::CameraContradicted { .. }));
        match (nearest, novelty) {
            (Some(estimate), novelty)
                if novelty.is_none_or(|novelty| novelty <= 1.0) && !is_contradicted =>
            {
                Ok(PoseEstimate {
                    pose: estimate.pose,
                    covariance: estimate.covariance,
                    method: estimate.method,
                    novelty,
                    located: None,
                    unmatched,
                })
            }
            (nearest, novelty) => Err(NotInRoom {
                novelty: by_keypoints.or(novelty).unwrap_or(f64::INFINITY),
                unmatched,
                nearest: nearest.map(Box::new),
            }),
        }
    }
}

impl PoseEstimate {
    /// The estimate of matched keypoints.
    pub fn matched(located: LocatedView) -> Self {
        Self {
            pose: located.pose.pose,
            covariance: Some(located.pose.covariance),
            method: Method::MatchedKeypoints,
            novelty: Some(located.novelty),
            located: Some(located),
            unmatched: None,
        }
    }
}

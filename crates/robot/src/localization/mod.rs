//! Estimates where a view is in a mapped room.
//!
//! - [`KeypointRoom`] matches the keypoints of a view with those of the map.
//! - [`AdapterLocalizer`] estimates the pose from the most similar mapped frames: by the adapter
//!   that is fitted to the room, by a blend of several frames, or by the nearest frame.
//! - [`PoseEstimate::choose`] chooses between them. Matched keypoints come first. The others answer
//!   only if the view resembles the room, as far as that is known.

mod adapter_localizer;
mod alignment;
mod camera_search;
mod keypoint_room;

pub use adapter_localizer::{AdapterEstimate, AdapterLocalizer};
pub use alignment::{MapAlignment, NotAligned};
pub use camera_search::FocalSearch;
pub use keypoint_room::{KeypointRoom, LocatedView, NotLocated};

use nalgebra::Matrix6;

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

/// Result for a view that is not located in a room.
#[derive(Debug, Clone, PartialEq)]
pub struct NotInRoom {
    /// How unlike the view is to the room, relative to the limit, above 1; `None` if unknown.
    pub novelty: Option<f64>,
    /// Why its keypoints do not locate it, if they were tried.
    pub unmatched: Option<NotLocated>,
    /// The rejected estimate from the most similar frames.
    pub nearest: Option<Box<AdapterEstimate>>,
}

impl PoseEstimate {
    /// Chooses the pose of a view in a room: from its matched keypoints, else from the most similar
    /// mapped frames.
    ///
    /// - `matched` is the result of the keypoints, `None` if they were not tried.
    /// - `similar` gives the estimate from the most similar frames, `None` without an adapter.
    ///
    /// Similar frames give a pose if their novelty is at most 1. If it is unknown, they give one
    /// only if no keypoints were tried.
    ///
    /// # Errors
    /// [`NotInRoom`] if neither gives a pose, or if the matches contradict the view's camera.
    pub fn choose(
        matched: Option<Result<LocatedView, NotLocated>>,
        similar: impl FnOnce() -> Option<AdapterEstimate>,
    ) -> Result<Self, NotInRoom> {
        let unmatched = match matched {
            Some(Ok(located)) => return Ok(Self::of_keypoints(located)),
            Some(Err(why)) => Some(why),
            None => None,
        };

        // A wrong camera is the caller's mistake, which a less accurate method must not hide.
        let is_contradicted = matches!(unmatched, Some(NotLocated::CameraContradicted { .. }));
        let resembles = |estimate: &AdapterEstimate| match estimate.novelty {
            Some(novelty) => novelty <= 1.0,
            None => unmatched.is_none(),
        };

        match similar() {
            Some(estimate) if resembles(&estimate) && !is_contradicted => Ok(Self {
                pose: estimate.pose,
                covariance: estimate.covariance,
                method: estimate.method,
                novelty: estimate.novelty,
                located: None,
                unmatched,
            }),
            rejected => {
                let by_frames = rejected.and_then(|estimate| estimate.novelty);
                let by_keypoints = unmatched.and_then(|why| why.novelty());
                Err(NotInRoom {
                    novelty: by_frames.filter(|novelty| *novelty > 1.0).or(by_keypoints),
                    unmatched,
                    nearest: rejected.map(Box::new),
                })
            }
        }
    }

    /// The estimate of matched keypoints.
    fn of_keypoints(located: LocatedView) -> Self {
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

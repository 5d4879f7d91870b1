//! Estimates where a view is in a mapped room, by matching its keypoints with those of the map.
//!
//! 1. The mapped frames most similar to the view are retrieved by their keypoints or, near a
//!    predicted pose, by their poses.
//! 2. The view's keypoints are matched with theirs, and the pose is estimated
//!    ([`KeypointMap::match_view`]).
//! 3. The pose is accepted if enough keypoints agree with it and its covariance is small enough.

use std::sync::Arc;

use crate::matched_views::{
    Candidates, KeypointMap, MatchedView, MatchingParameters, PlaceIndex, ViewKeypoints,
};
use crate::tracking::PoseWithCovariance;
use seese3_core::geometry::Pose;

/// A mapped room in which views are located by their keypoints.
#[derive(Debug, Clone)]
pub struct KeypointRoom {
    /// `world_from_camera` of the mapped frames.
    poses: Vec<Pose>,
    places: PlaceIndex,
    map: Arc<KeypointMap>,
    parameters: MatchingParameters,
}

/// The pose of a view that agrees with the map.
#[derive(Debug, Clone)]
pub struct LocatedView {
    /// `world_from_camera`.
    pub pose: PoseWithCovariance,
    /// Number of the view's keypoints that agree with the pose.
    pub inliers: usize,
    /// The matches.
    pub matched: MatchedView,
}

/// Why a view is not located.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum NotLocated {
    #[error("the view has no keypoints: it is blank, blurred or covered")]
    NoKeypoints,
    #[error(
        "only {inliers} of {keypoints} keypoints agree with the map; the view is not in the map"
    )]
    NotInMap { inliers: usize, keypoints: usize },
    #[error(
        "{inliers} keypoints agree with the map, but in a small part of the image or too far from it: the pose is \
         uncertain by {position_m:.2} m and {rotation_deg:.1} degrees"
    )]
    Uncertain {
        inliers: usize,
        position_m: f64,
        rotation_deg: f64,
    },
}

impl KeypointRoom {
    /// A room with these mapped frames: poses `world_from_camera`, and their keypoints.
    ///
    /// # Panics
    /// If poses and map are not of the same number of frames.
    pub fn new(poses: Vec<Pose>, map: Arc<KeypointMap>) -> Self {
        assert_eq!(poses.len(), map.frames.len());
        Self {
            poses,
            places: PlaceIndex::of(&map),
            map,
            parameters: MatchingParameters::default(),
        }
    }

    /// The keypoints of the room.
    pub fn map(&self) -> &KeypointMap {
        &self.map
    }

    /// Estimates the pose of a view.
    ///
    /// # Errors
    /// [`NotLocated`] if the view does not agree with the map.
    pub fn locate(&self, view: ViewKeypoints<'_>) -> Result<LocatedView, NotLocated> {
        self.locate_among(view, Candidates::Similar(&self.places))
    }

    /// Estimates the pose of a view near a predicted pose, `world_from_camera`.
    ///
    /// # Errors
    /// [`NotLocated`] if the view does not agree with the map.
    pub fn locate_near(
        &self,
        view: ViewKeypoints<'_>,
        predicted: &Pose,
    ) -> Result<LocatedView, NotLocated> {
        self.locate_among(view, Candidates::Near(predicted))
    }

    fn locate_among(
        &self,
        view: ViewKeypoints<'_>,
        candidates: Candidates<'_>,
    ) -> Result<LocatedView, NotLocated> {
        let keypoints = view.keypoints;
        if keypoints.is_empty() {
            return Err(NotLocated::NoKeypoints);
        }

        let matched = self
            .map
            .match_view(view, candidates, &self.poses, &self.parameters);
        let not_in_map = |inliers: usize| NotLocated::NotInMap {
            inliers,
            keypoints: keypoints.len(),
        };
        let matched = matched.ok_or_else(|| not_in_map(0))?;
        let inliers = matched.inliers;
        if inliers < self.parameters.min_inliers {
            return Err(not_in_map(inliers));
        }

        let covariance = matched.information.covariance(&self.map.noise);
        let pose = PoseWithCovariance {
            pose: matched.pose,
            covariance: covariance.ok_or_else(|| not_in_map(inliers))?,
        };
        let position_m = pose.position_deviation_m();
        let rotation_rad = pose.rotation_deviation_rad();
        let MatchingParameters {
            min_spread,
            max_position_deviation,
            max_rotation_deviation_rad,
            ..
        } = self.parameters;
        let is_certain = matched.spread >= min_spread
            && position_m <= max_position_deviation * self.map.unit_m
            && rotation_rad <= max_rotation_deviation_rad;
        if !is_certain {
            return Err(NotLocated::Uncertain {
                inliers,
                position_m,
                rotation_deg: rotation_rad.to_degrees(),
            });
        }

        Ok(LocatedView {
            pose,
            inliers,
            matched,
        })
    }
}

//! Estimates where a view is in a mapped room, by matching its keypoints with those of the map.
//!
//! 1. The mapped frames most similar to the view are retrieved by their features or, near a
//!    predicted pose, by their poses.
//! 2. The view's keypoints are matched with theirs, and the pose is estimated
//!    ([`KeypointMap::match_view`]).
//! 3. The pose is accepted if enough keypoints agree with it and its covariance is small enough.

use std::sync::Arc;

use ndarray::{ArrayView1, ArrayView2};

use crate::matched_views::{
    KeypointMap, MatchedView, MatchingParameters, PlaceCandidates, UnitFeatures, ViewKeypoints,
};
use crate::tracking::PoseWithCovariance;
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::keypoints::Keypoints;

/// A mapped room in which views are located by their keypoints.
#[derive(Debug, Clone)]
pub struct KeypointRoom {
    /// `world_from_camera` of the mapped frames.
    poses: Vec<Pose>,
    features: UnitFeatures,
    map: Arc<KeypointMap>,
    parameters: MatchingParameters,
}

/// A view to locate.
#[derive(Debug, Clone, Copy)]
pub struct KeypointQuery<'a> {
    /// Feature of the same encoder pass, shape (d).
    pub feature: ArrayView1<'a, f32>,
    /// Keypoints.
    pub keypoints: &'a Keypoints,
    /// Camera.
    pub camera: &'a CameraIntrinsics,
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
    /// A room with these mapped frames: poses `world_from_camera`, and features of shape (n, d).
    ///
    /// # Panics
    /// If poses, features and map are not of the same number of frames.
    pub fn new(poses: Vec<Pose>, features: ArrayView2<'_, f32>, map: Arc<KeypointMap>) -> Self {
        assert_eq!(poses.len(), features.nrows());
        assert_eq!(poses.len(), map.frames.len());
        Self {
            poses,
            features: UnitFeatures::of(features),
            map,
            parameters: MatchingParameters::default(),
        }
    }

    /// The keypoints of the room.
    pub fn map(&self) -> &KeypointMap {
        &self.map
    }

    /// Rows of the `count` mapped frames most similar to a feature, the most similar first.
    pub fn most_similar(&self, feature: ArrayView1<'_, f32>, count: usize) -> Vec<usize> {
        self.features.nearest(feature, count)
    }

    /// Cosine similarity of the mapped frame in `row` and a feature of shape (d).
    pub fn similarity(&self, row: usize, feature: ArrayView1<'_, f32>) -> f32 {
        self.features.similarity(row, feature)
    }

    /// Estimates the pose of a view.
    ///
    /// # Errors
    /// [`NotLocated`] if the view does not agree with the map.
    pub fn locate(&self, query: KeypointQuery<'_>) -> Result<LocatedView, NotLocated> {
        let candidates = self.most_similar(query.feature, self.parameters.more_frames);
        self.locate_among(query, &candidates)
    }

    /// Estimates the pose of a view near a predicted pose, `world_from_camera`.
    ///
    /// # Errors
    /// [`NotLocated`] if the view does not agree with the map.
    pub fn locate_near(
        &self,
        query: KeypointQuery<'_>,
        predicted: &Pose,
    ) -> Result<LocatedView, NotLocated> {
        let mut order: Vec<(f64, usize)> = self
            .poses
            .iter()
            .enumerate()
            .map(|(row, pose)| (self.map.gap(pose, predicted), row))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        let nearest = order.iter().take(self.parameters.more_frames);
        let candidates: Vec<usize> = nearest.map(|&(_, row)| row).collect();
        self.locate_among(query, &candidates)
    }

    fn locate_among(
        &self,
        query: KeypointQuery<'_>,
        candidates: &[usize],
    ) -> Result<LocatedView, NotLocated> {
        let KeypointQuery {
            keypoints, camera, ..
        } = query;
        if keypoints.is_empty() {
            return Err(NotLocated::NoKeypoints);
        }

        let matched = self.map.match_view(
            ViewKeypoints { keypoints, camera },
            PlaceCandidates { frames: candidates },
            &self.poses,
            &self.parameters,
        );
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

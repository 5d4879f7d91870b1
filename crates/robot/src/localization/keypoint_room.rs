//! Locates views in a mapped room by matching their keypoints with those of the map.
//!
//! 1. The mapped frames most similar to the view are retrieved by their keypoints or, near a
//!    predicted pose, by their poses.
//! 2. The view's keypoints are matched with theirs, and the pose is estimated
//!    ([`KeypointMap::match_view`]).
//! 3. The pose is accepted if enough keypoints agree with it, its covariance is small enough, and
//!    the matches do not contradict the focal length of the view's camera.

use std::sync::Arc;

use crate::matched_views::{
    Candidates, InlierMatch, KeypointMap, MappedKeypoints, MatchedView, MatchingParameters,
    PlaceIndex, ViewKeypoints,
};
use crate::tracking::PoseWithCovariance;
use crate::visual_odometry::KnownDepth;
use nalgebra::Point3;
use seese3_core::geometry::{CameraIntrinsics, Pose};

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
    /// Number of the view's keypoints.
    pub keypoints: usize,
    /// The worst of the acceptance gates: how close the view is to the limit, at most 1. A view
    /// with the fewest accepted inliers has 1, one with twice as many 0.5.
    pub novelty: f64,
    /// The matches.
    pub matched: MatchedView,
}

/// Why a view is not located.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum NotLocated {
    #[error("the view has no keypoints: it is blank, blurred or covered")]
    NoKeypoints,
    #[error("the focal length of the camera is not estimated yet")]
    UnknownCamera,
    #[error(
        "only {inliers} of {keypoints} keypoints agree with the map; at least {needed} are required"
    )]
    NotInMap {
        inliers: usize,
        keypoints: usize,
        needed: usize,
    },
    #[error("{inliers} keypoints agree with the map, but they cover too small a part of the image")]
    Clustered { inliers: usize, novelty: f64 },
    #[error(
        "{inliers} keypoints agree with the map, but the pose is uncertain by {position_m:.2} m and \
         {rotation_deg:.1} degrees"
    )]
    Uncertain {
        inliers: usize,
        position_m: f64,
        rotation_deg: f64,
        novelty: f64,
    },
    #[error("{inliers} keypoints agree with the map, but they do not determine a pose")]
    Undetermined { inliers: usize },
    #[error(
        "the matches contradict the focal length of the view's camera: with {stated:.3} image widths {matches} \
         matches agree, with {fitted:.3} image widths {fitted_matches}"
    )]
    CameraContradicted {
        /// Image widths.
        stated: f64,
        /// Image widths.
        fitted: f64,
        matches: usize,
        fitted_matches: usize,
    },
}

impl NotLocated {
    /// Whether the matches contradict the camera.
    pub fn is_of_camera(&self) -> bool {
        matches!(self, Self::CameraContradicted { .. })
    }

    /// How far the view is beyond the limit of the worst gate; above 1. `None` if the gates do not
    /// measure it.
    pub fn novelty(&self) -> Option<f64> {
        match *self {
            Self::NotInMap {
                inliers, needed, ..
            } if inliers > 0 => Some(needed as f64 / inliers as f64),
            Self::Clustered { novelty, .. } | Self::Uncertain { novelty, .. } => Some(novelty),
            Self::NoKeypoints
            | Self::UnknownCamera
            | Self::NotInMap { .. }
            | Self::Undetermined { .. }
            | Self::CameraContradicted { .. } => None,
        }
    }
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

    /// Approximate memory use, bytes.
    pub fn memory_bytes(&self) -> usize {
        let frames = self.map.frames.iter();
        let keypoints: usize = frames.map(MappedKeypoints::memory_bytes).sum();
        keypoints + self.places.memory_bytes() + size_of_val(self.poses.as_slice())
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

    /// The pose, `world_from_camera`, of a frame of another map of the same encoder; `None` if its
    /// keypoints do not agree with this map.
    pub fn locate_mapped(&self, other: &KeypointMap, row: usize) -> Option<Pose> {
        let matched =
            self.map
                .match_mapped((other, row), &self.places, &self.poses, &self.parameters)?;
        matched
            .is_supported(&self.parameters)
            .then_some(matched.pose)
    }

    /// The pose of a view: near a predicted pose if there is one and it succeeds, else anywhere.
    ///
    /// # Errors
    /// As [`KeypointRoom::locate`].
    pub fn locate_from(
        &self,
        view: ViewKeypoints<'_>,
        predicted: Option<&Pose>,
    ) -> Result<LocatedView, NotLocated> {
        let near = predicted.and_then(|predicted| self.locate_near(view, predicted).ok());
        near.map_or_else(|| self.locate(view), Ok)
    }

    /// The depths of the keypoints of a located view, from the map points that they are matched
    /// with.
    pub fn known_depths(&self, view: &LocatedView) -> Vec<KnownDepth> {
        let matches = view.matched.matches.iter();
        let depth = |found: &InlierMatch| {
            let mapped = &self.map.frames[found.frame];
            let point = mapped.point(found.mapped, &self.map.camera);
            let position = self.poses[found.frame] * Point3::from(point);
            let depth_m = view.pose.pose.inverse_transform_point(&position).z;
            (depth_m > 0.0).then_some(KnownDepth {
                keypoint: found.keypoint,
                depth_m,
                deviation: f64::from(mapped.deviations[found.mapped]),
            })
        };
        matches.filter_map(depth).collect()
    }

    /// The focal length that fits a view's matches best, image widths, and the number of keypoints
    /// that agree with it; `None` if they are too few.
    pub(super) fn fitted_focal(&self, view: ViewKeypoints<'_>) -> Option<(f64, usize)> {
        let candidates = Candidates::Similar(&self.places);
        let matched = self
            .map
            .match_view(view, candidates, &self.poses, &self.parameters)?;
        let fit = matched.focal?;

        let is_enough = fit.inliers >= self.parameters.min_inliers;
        is_enough.then_some((view.camera.focal().x * fit.factor, fit.inliers))
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
            needed: self.parameters.min_inliers,
        };
        let matched = matched.ok_or_else(|| not_in_map(0))?;
        if let Some(contradicted) = self.contradicted(&matched, view.camera) {
            return Err(contradicted);
        }

        let inliers = matched.inliers;
        if inliers < self.parameters.min_inliers {
            return Err(not_in_map(inliers));
        }

        let covariance = matched.information.covariance(&self.map.noise);
        let pose = PoseWithCovariance {
            pose: matched.pose,
            covariance: covariance.ok_or(NotLocated::Undetermined { inliers })?,
        };

        let novelty = self.novelty(&matched, &pose);
        if !matched.is_supported(&self.parameters) {
            return Err(NotLocated::Clustered { inliers, novelty });
        }
        if novelty > 1.0 {
            return Err(NotLocated::Uncertain {
                inliers,
                position_m: pose.position_deviation_m(),
                rotation_deg: pose.rotation_deviation_rad().to_degrees(),
                novelty,
            });
        }

        Ok(LocatedView {
            pose,
            inliers,
            keypoints: keypoints.len(),
            novelty,
            matched,
        })
    }

    /// The worst of the acceptance gates, 1 at the limit.
    fn novelty(&self, matched: &MatchedView, pose: &PoseWithCovariance) -> f64 {
        let MatchingParameters {
            min_inliers,
            min_support,
            max_position_deviation,
            max_rotation_deviation_rad,
            ..
        } = self.parameters;
        let ratios = [
            min_inliers as f64 / matched.inliers as f64,
            min_support / matched.support(),
            pose.position_deviation_m() / (max_position_deviation * self.map.unit_m),
            pose.rotation_deviation_rad() / max_rotation_deviation_rad,
        ];
        ratios.into_iter().fold(0.0, f64::max)
    }

    /// Compares the stated focal length of a view with the one that fits its matches best.
    fn contradicted(&self, matched: &MatchedView, camera: &CameraIntrinsics) -> Option<NotLocated> {
        let MatchingParameters {
            confident_inliers,
            min_inliers,
            min_log_focal,
            min_focal_deviations,
            ..
        } = self.parameters;
        let fit = matched.focal?;

        // A view outside the map also gets some inliers at some focal length.
        let enough = if matched.inliers < min_inliers {
            confident_inliers
        } else {
            min_inliers
        };
        let log_factor = fit.factor.ln().abs();
        let deviations = log_factor / fit.independent_variance.sqrt();
        let is_contradicted = fit.inliers >= enough
            && log_factor >= min_log_focal
            && deviations >= min_focal_deviations;

        let stated = camera.focal().x;
        is_contradicted.then_some(NotLocated::CameraContradicted {
            stated,
            fitted: stated * fit.factor,
            matches: matched.matches.len(),
            fitted_matches: fit.matches,
        })
    }
}

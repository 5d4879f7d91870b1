//! Matches a view with mapped frames and estimates its pose.

use std::collections::BTreeSet;

use nalgebra::{Vector2, Vector6};
use ndarray::Array2;

use super::absolute_pose::{Correspondence, PoseInformation, Search, find_pose};
use super::descriptors::{mutual_matches, unpacked};
use super::focal_fit::{FocalFit, fitted_focal};
use super::keypoint_map::KeypointMap;
use super::parameters::MatchingParameters;
use super::retrieval::PlaceIndex;
use super::triangulation::{pixel_focal, plane_points};
use seese3_core::geometry::{CameraIntrinsics, Pose, Twist, log};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::{mean, root_mean_square};

/// Seed of RANSAC; equal views get equal answers.
const SEED: u64 = 1;

/// The keypoints of a view and its camera.
#[derive(Debug, Clone, Copy)]
pub struct ViewKeypoints<'a> {
    /// Keypoints of the view.
    pub keypoints: &'a Keypoints,
    /// Its camera.
    pub camera: &'a CameraIntrinsics,
}

/// Where a view may be in the map.
#[derive(Debug, Clone, Copy)]
pub enum Candidates<'a> {
    /// The frames with the most similar keypoints.
    Similar(&'a PlaceIndex),
    /// The frames nearest to a predicted pose, `world_from_camera`.
    Near(&'a Pose),
    /// These frames, the best first.
    Listed(&'a [usize]),
}

/// A view whose keypoints agree with the map under one pose.
#[derive(Debug, Clone)]
pub struct MatchedView {
    /// `world_from_camera`.
    pub pose: Pose,
    /// Number of the view's keypoints that agree with the pose.
    pub inliers: usize,
    /// The mapped frames with inliers, in the map's rows.
    pub frames: Vec<usize>,
    /// Spread of the inliers over the image: the product of the standard deviations of their
    /// positions along both axes, fractions of the image's width and height.
    pub spread: f64,
    /// Information of the matches about the pose.
    pub information: PoseInformation,
    /// The focal length of the view that fits the matches best, if there is one.
    pub focal: Option<FocalFit>,
    /// The inliers.
    pub matches: Vec<InlierMatch>,
}

impl MatchedView {
    /// Whether the inliers are enough, and spread widely enough, for an accepted pose.
    pub fn is_supported(&self, parameters: &MatchingParameters) -> bool {
        self.inliers >= parameters.min_inliers && self.support() >= parameters.min_support
    }

    /// The row of the mapped frame with the most inliers; 0 without inliers.
    pub fn best_frame(&self) -> usize {
        let inliers = |frame: &&usize| {
            let matches = self.matches.iter();
            matches.filter(|found| found.frame == **frame).count()
        };
        self.frames.iter().max_by_key(inliers).copied().unwrap_or(0)
    }

    /// Number of inliers times their spread: few inliers have to be spread more widely.
    pub fn support(&self) -> f64 {
        self.inliers as f64 * self.spread
    }
}

/// An inlier of a matched view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InlierMatch {
    /// Place of the keypoint in the view.
    pub keypoint: usize,
    /// Row of the mapped frame.
    pub frame: usize,
    /// Place of the keypoint among those of the mapped frame.
    pub mapped: usize,
}

impl KeypointMap {
    /// Matches a view with candidate frames: first with a few, then with more if there are too few
    /// inliers. `poses` are those of the map's frames, `world_from_camera`. `None` if no pose
    /// agrees with the matches; the caller decides how many inliers it trusts.
    pub fn match_view(
        &self,
        view: ViewKeypoints<'_>,
        candidates: Candidates<'_>,
        poses: &[Pose],
        parameters: &MatchingParameters,
    ) -> Option<MatchedView> {
        let query = Query::new(self, view, parameters);
        self.match_query(&query, candidates, poses, parameters)
    }

    /// Matches a frame of another map of the same encoder, by its row, with the most similar
    /// frames.
    pub fn match_mapped(
        &self,
        (other, row): (&Self, usize),
        index: &PlaceIndex,
        poses: &[Pose],
        parameters: &MatchingParameters,
    ) -> Option<MatchedView> {
        let query = Query::of_mapped(self, other, row);
        self.match_query(&query, Candidates::Similar(index), poses, parameters)
    }

    fn match_query(
        &self,
        query: &Query<'_>,
        candidates: Candidates<'_>,
        poses: &[Pose],
        parameters: &MatchingParameters,
    ) -> Option<MatchedView> {
        let frames = match candidates {
            Candidates::Similar(index) => {
                index.nearest(query.descriptors.view(), parameters.more_frames)
            }
            Candidates::Near(pose) => self.nearest_to(pose, poses, parameters.more_frames),
            Candidates::Listed(rows) => rows.to_vec(),
        };

        let (first, others) = frames.split_at(parameters.first_frames.min(frames.len()));
        let mut matches = FrameMatches::default();
        query.match_frames(first, poses, parameters, &mut matches);
        let found = query.posed(&matches, poses, parameters);
        let is_enough = |found: &MatchedView| found.inliers >= parameters.confident_inliers;
        if found.as_ref().is_some_and(is_enough) || others.is_empty() {
            return found;
        }

        query.match_frames(others, poses, parameters, &mut matches);
        let wider = query.posed(&matches, poses, parameters);
        let count = |found: &Option<MatchedView>| found.as_ref().map_or(0, |found| found.inliers);
        if count(&wider) > count(&found) {
            wider
        } else {
            found
        }
    }

    /// Distance between two camera poses: meters over the median depth, plus radians.
    pub(super) fn distance(&self, a: &Pose, b: &Pose) -> f64 {
        let between = a.inv_mul(b);
        between.translation.vector.norm() / self.unit_m + between.rotation.angle()
    }

    /// Rows of the `count` frames with keypoints nearest to a pose, the nearest first.
    fn nearest_to(&self, pose: &Pose, poses: &[Pose], count: usize) -> Vec<usize> {
        let mut order: Vec<(f64, usize)> = poses
            .iter()
            .enumerate()
            .filter(|&(row, _)| !self.frames[row].is_empty())
            .map(|(row, mapped)| (self.distance(mapped, pose), row))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        order.into_iter().take(count).map(|(_, row)| row).collect()
    }
}

/// Matches of a view with mapped frames.
#[derive(Default)]
struct FrameMatches {
    correspondences: Vec<Correspondence>,
    /// Places of the keypoints in their mapped frames.
    mapped: Vec<usize>,
}

/// A view, prepared for matching.
struct Query<'a> {
    map: &'a KeypointMap,
    /// Positions of the keypoints in the image.
    points: &'a [Vector2<f32>],
    plane: Vec<Vector2<f64>>,
    /// Focal length of the view's camera, pixels.
    focal_px: f64,
    descriptors: Array2<f32>,
}

impl<'a> Query<'a> {
    fn new(map: &'a KeypointMap, view: ViewKeypoints<'a>, parameters: &MatchingParameters) -> Self {
        let plane = plane_points(view.keypoints, view.camera, parameters.candidates);
        let mut compressed = map.basis.compress(view.keypoints);
        compressed.truncate(plane.len() * super::COMPRESSED);
        Self {
            map,
            points: view.keypoints.points(),
            plane,
            focal_px: pixel_focal(view.camera),
            descriptors: unpacked(&compressed),
        }
    }

    /// A frame of another map. Its keypoints are those with the best scores.
    fn of_mapped(map: &'a KeypointMap, other: &'a KeypointMap, row: usize) -> Self {
        let frame = &other.frames[row];
        let plane = (0..frame.len()).map(|place| {
            let point = frame.point(place, &other.camera);
            point.xy() / point.z
        });
        let compressed = map.basis.compress_again(&frame.descriptors, &other.basis);
        Self {
            map,
            points: &frame.points,
            plane: plane.collect(),
            focal_px: pixel_focal(&other.camera),
            descriptors: unpacked(&compressed),
        }
    }

    /// Adds the matches with some mapped frames.
    fn match_frames(
        &self,
        frames: &[usize],
        poses: &[Pose],
        parameters: &MatchingParameters,
        matches: &mut FrameMatches,
    ) {
        for &frame in frames {
            let mapped = &self.map.frames[frame];
            let pose = &poses[frame];
            let in_camera = mapped.in_camera(&self.map.camera);
            let pairs = mutual_matches(
                self.descriptors.view(),
                unpacked(&mapped.descriptors).view(),
                parameters.min_cosine,
            );

            for (keypoint, place) in pairs {
                let from_camera = pose.rotation * in_camera[place];
                matches.correspondences.push(Correspondence {
                    keypoint,
                    frame,
                    plane: self.plane[keypoint],
                    world: pose.translation.vector + from_camera,
                    from_frame: from_camera,
                    deviation: f64::from(mapped.deviations[place]),
                });
                matches.mapped.push(place);
            }
        }
    }

    /// The pose that most matches agree with.
    fn posed(
        &self,
        matches: &FrameMatches,
        poses: &[Pose],
        parameters: &MatchingParameters,
    ) -> Option<MatchedView> {
        let FrameMatches {
            correspondences,
            mapped,
        } = matches;
        let search = Search {
            focal_px: self.focal_px,
            threshold_px: parameters.threshold_px(self.map.epipolar_px),
            deviation_px: parameters.deviation_px,
            iterations: parameters.iterations,
            miss_probability: parameters.miss_probability,
            seed: SEED,
        };
        let found = find_pose(correspondences, &search)?;

        let inliers = || found.inliers.iter().map(|&place| &correspondences[place]);
        let unique: BTreeSet<usize> = inliers().map(|match_| match_.keypoint).collect();
        let frames: BTreeSet<usize> = inliers().map(|match_| match_.frame).collect();
        let matches = found
            .inliers
            .iter()
            .map(|&place| InlierMatch {
                keypoint: correspondences[place].keypoint,
                frame: correspondences[place].frame,
                mapped: mapped[place],
            })
            .collect();

        let displacements = inliers().map(|match_| {
            let Twist { linear, angular } = log(&found.pose.inv_mul(&poses[match_.frame]));
            let linear = linear / self.map.unit_m;
            Twist { linear, angular }.to_vector()
        });
        let count = found.inliers.len().max(1) as f64;
        let gap = (displacements.sum::<Vector6<f64>>() / count).norm();

        Some(MatchedView {
            pose: found.pose,
            inliers: unique.len(),
            frames: frames.into_iter().collect(),
            spread: spread(self.points, &unique),
            information: PoseInformation {
                independent: found.information,
                gap,
                unit_m: self.map.unit_m,
            },
            focal: fitted_focal(&search, correspondences, &found.pose, found.variance_px),
            matches,
        })
    }
}

/// Product of the standard deviations along both axes of some of the points.
fn spread(points: &[Vector2<f32>], places: &BTreeSet<usize>) -> f64 {
    let deviation = |axis: usize| {
        let values: Vec<f64> = places
            .iter()
            .map(|&place| f64::from(points[place][axis]))
            .collect();
        let center = mean(&values);
        root_mean_square(&values.iter().map(|x| x - center).collect::<Vec<f64>>())
    };
    deviation(0) * deviation(1)
}

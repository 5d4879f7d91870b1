//! Visual odometry: the motion of a camera from the keypoints of its images, without a map.
//!
//! - The keypoints of a keyframe are landmarks on their rays. A landmark without parallax has the
//!   usual depth of rooms, with a wide deviation.
//! - A frame is matched with the landmarks near their predicted positions. A robust adjustment
//!   gives its pose; far from the prediction it starts at the pose of P3P in LO-RANSAC.
//! - A frame with enough parallax, or with too few matches left, becomes a keyframe. The newest
//!   keyframes and their landmarks are then adjusted together.
//! - Known depths, for example of keypoints that are matched with a map, set the scale. Without
//!   them it is that of the usual depth of rooms, and drifts.

mod adjustment;
mod bundle;
mod local_map;
mod parameters;

pub use parameters::{OdometryParameters, ScaleDeviations};

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix6, Vector2};

use crate::matched_views::{
    Correspondence, Search, ViewKeypoints, find_pose, pixel_focal, plane_points,
};
use adjustment::FrameMatch;
use bundle::{Bundle, BundleLandmark, Objective};
use local_map::{Candidate, KeypointId, LocalMap};
use seese3_core::geometry::{Pose, Twist, exp, log};
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::median;

/// Seed of RANSAC; equal streams get equal answers.
const SEED: u64 = 1;
/// Accepted probability that RANSAC draws no all-inlier sample.
const MISS_PROBABILITY: f64 = 1e-3;
/// Share of the velocity that a frame without a pose keeps.
const LOST_VELOCITY_SHARE: f64 = 0.5;
/// Largest difference of an inlier's inverse depth from its prior mean, standard deviations.
const MAX_DEPTH_ERROR: f64 = 3.0;

/// A frame of a stream.
#[derive(Debug, Clone, Copy)]
pub struct OdometryView<'a> {
    /// Its keypoints and its camera.
    pub view: ViewKeypoints<'a>,
    /// Seconds since the last frame.
    pub seconds: f64,
    /// The motion since the last frame, `last_from_this`, if another sensor measures it. Without it
    /// the camera keeps its velocity.
    pub predicted_motion: Option<Pose>,
    /// Depths of keypoints that are known.
    pub depths: &'a [KnownDepth],
}

/// Depth of a keypoint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownDepth {
    /// Place of the keypoint in the view.
    pub keypoint: usize,
    /// Along the optical axis, meters.
    pub depth_m: f64,
    /// Relative standard deviation.
    pub deviation: f64,
}

/// Motion of the camera to a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct VisualMotion {
    /// `last_from_this`, the pose of the frame in the camera frame of the last one.
    pub motion: Pose,
    /// Covariance of δ in true = pose · exp(δ) of the frame in the local map, ordered (v, ω),
    /// meters and radians. The drift of the local map is not part of it.
    pub pose_covariance: Matrix6<f64>,
    /// Relative standard deviation of the scale.
    pub scale_deviation: f64,
    /// Number of keypoints that agree with the pose.
    pub inliers: usize,
}

/// Visual odometry of one stream.
#[derive(Debug, Clone)]
pub struct VisualOdometry {
    parameters: OdometryParameters,
    map: LocalMap,
    /// Pose of the last frame in the local map; predicted if it was not tracked.
    pose: Pose,
    /// The pose of the frame before, if the last one was not tracked.
    before: Option<Pose>,
    /// Pose of the last tracked frame, and the time since then, seconds.
    tracked_pose: Pose,
    untracked_s: f64,
    /// Motion per second between the last two frames, in the camera's body frame.
    velocity: Twist,
    scale_deviation: f64,
    lost_frames: u32,
}

/// The keypoints of a frame.
struct Frame<'a> {
    keypoints: &'a Keypoints,
    /// On the plane at depth 1.
    plane: Vec<Vector2<f64>>,
    /// Lengths of the descriptors.
    lengths: Vec<f32>,
    focal_px: f64,
}

/// Which landmarks a frame is matched with.
#[derive(Clone, Copy)]
enum Reach {
    /// Those near their predicted positions.
    Near,
    /// Those of twice as many keyframes, anywhere in the image.
    Wide,
}

/// The pose of a frame in the local map.
struct Tracked {
    pose: Pose,
    covariance: Matrix6<f64>,
    /// Landmarks by keypoint.
    inliers: BTreeMap<usize, KeypointId>,
}

/// A frame, its last camera, with an adjusted pose.
struct PosedFrame {
    bundle: Bundle,
    covariance: Matrix6<f64>,
}

impl VisualOdometry {
    /// The odometry of a new stream.
    pub fn new(parameters: OdometryParameters) -> Self {
        Self {
            parameters,
            map: LocalMap::new(),
            pose: Pose::identity(),
            before: None,
            tracked_pose: Pose::identity(),
            untracked_s: 0.0,
            velocity: Twist::default(),
            scale_deviation: parameters.scale_deviations.usual,
            lost_frames: 0,
        }
    }

    /// The parameters.
    pub fn parameters(&self) -> &OdometryParameters {
        &self.parameters
    }

    /// Number of keyframes of the local map.
    pub fn keyframe_count(&self) -> usize {
        self.map.keyframes.len()
    }

    /// Adds a frame; `None` if there is no motion to it: it is the first one, or it does not agree
    /// with the local map.
    pub fn observe(&mut self, observed: &OdometryView<'_>) -> Option<VisualMotion> {
        let frame = Frame::new(observed.view, self.parameters.candidates);
        if self.map.keyframes.is_empty() {
            self.begin(&frame, observed.depths);
            return None;
        }

        let constant_velocity = || exp(&self.velocity.scaled(observed.seconds));
        let motion = observed.predicted_motion.unwrap_or_else(constant_velocity);
        let predicted = self.pose * motion;
        self.untracked_s += observed.seconds;
        let Some(found) = self.tracked(&predicted, &frame) else {
            self.predict(predicted);
            self.lose();
            return None;
        };

        self.lost_frames = 0;
        self.before = None;
        let mut last = std::mem::replace(&mut self.pose, found.pose);
        if self.needs_keyframe(&found, &frame) {
            self.add_keyframe(&frame, &found.inliers);
            let is_reversed = self.map.adjust(frame.focal_px, &self.parameters);
            if let Some(newest) = self.map.keyframes.back() {
                self.pose = newest.pose;
            }
            if is_reversed {
                // Exclude the correction of earlier poses from the motion of this frame.
                let motion = last.inv_mul(&found.pose);
                last = self.pose * motion.inverse();
                self.tracked_pose = self.pose;
            }
        }

        let mut motion = last.inv_mul(&self.pose);
        motion.translation.vector *= self.corrected_scale(&found, &frame, observed.depths);
        // After frames without a pose, `motion` also corrects what was assumed of them.
        let since_tracked = self.tracked_pose.inv_mul(&self.pose);
        if self.untracked_s > 0.0 {
            self.velocity = log(&since_tracked).scaled(self.untracked_s.recip());
        }
        self.tracked_pose = self.pose;
        self.untracked_s = 0.0;
        Some(VisualMotion {
            motion,
            pose_covariance: found.covariance,
            scale_deviation: self.scale_deviation,
            inliers: found.inliers.len(),
        })
    }

    /// Begins a local map.
    fn begin(&mut self, frame: &Frame<'_>, depths: &[KnownDepth]) {
        if frame.plane.len() < self.parameters.min_inliers {
            return;
        }

        self.lost_frames = 0;
        self.before = None;
        self.tracked_pose = self.pose;
        self.untracked_s = 0.0;
        self.add_keyframe(frame, &BTreeMap::new());
        self.scale_deviation = self.parameters.scale_deviations.usual;
        let Some(newest) = self.map.keyframes.back() else {
            return;
        };
        let own = (0..frame.plane.len()).map(|place| (place, (newest.number, place)));
        let own = own.collect();
        self.map
            .take_depths(&own, &self.pose, &frame.plane, depths, &self.parameters);
        if depths.len() >= self.parameters.min_known_depths {
            self.scale_deviation = self.parameters.scale_deviations.of_frame;
            self.map.update_depth_factor(&self.parameters);
        }
    }

    /// Adds a frame without a usable image, some seconds after the last one: the camera is
    /// predicted to keep its velocity.
    pub fn skip(&mut self, seconds: f64) {
        self.repeat(seconds);
        self.lose();
    }

    /// Adds a frame whose image is the last one again. It is as [`Self::skip`], but the frame does
    /// not count as lost.
    pub fn repeat(&mut self, seconds: f64) {
        self.untracked_s += seconds;
        self.predict(self.pose * exp(&self.velocity.scaled(seconds)));
    }

    /// Sets the motion to the last frame to this estimate if the images gave none. The motion to
    /// the next tracked frame then corrects it.
    pub fn assume(&mut self, motion: &Pose) {
        if let Some(before) = self.before {
            self.pose = before * motion;
        }
    }

    /// Predicts the pose of a frame without one.
    fn predict(&mut self, predicted: Pose) {
        self.before = Some(std::mem::replace(&mut self.pose, predicted));
        self.velocity = self.velocity.scaled(LOST_VELOCITY_SHARE);
    }

    /// Counts a lost frame.
    fn lose(&mut self) {
        self.lost_frames += 1;
        if self.lost_frames >= self.parameters.max_lost_frames {
            self.map.keyframes.clear();
            self.lost_frames = 0;
        }
    }

    fn add_keyframe(&mut self, frame: &Frame<'_>, matched: &BTreeMap<usize, KeypointId>) {
        let plane = frame.plane.clone();
        self.map
            .add(self.pose, plane, frame.keypoints, matched, &self.parameters);
        let growth = self.parameters.scale_deviations.of_keyframe;
        let usual = self.parameters.scale_deviations.usual;
        self.scale_deviation = self.scale_deviation.hypot(growth).min(usual);
    }

    /// Corrects the scale of the local map by known depths, and returns the factor.
    fn corrected_scale(
        &mut self,
        found: &Tracked,
        frame: &Frame<'_>,
        depths: &[KnownDepth],
    ) -> f64 {
        let parameters = &self.parameters;
        let ratio = self
            .map
            .scale_ratio(&found.inliers, &self.pose, depths, parameters);
        let factor = ratio.map_or(1.0, |ratio| {
            let prior = self.scale_deviation.powi(2);
            let noise = parameters.scale_deviations.of_frame.powi(2);
            let gain = prior / (prior + noise);
            self.scale_deviation = (prior * (1.0 - gain)).sqrt();
            ratio.powf(gain)
        });
        self.map.rescale(&self.pose.translation.vector, factor);
        self.map
            .take_depths(&found.inliers, &self.pose, &frame.plane, depths, parameters);
        factor
    }

    /// Matches a frame near its predicted pose, else more widely.
    fn tracked(&self, predicted: &Pose, frame: &Frame<'_>) -> Option<Tracked> {
        let count = |found: &Option<Tracked>| found.as_ref().map_or(0, |found| found.inliers.len());
        let near = self.matched(predicted, frame, Reach::Near);
        if count(&near) >= 2 * self.parameters.min_inliers {
            return near;
        }

        let wide = self.matched(predicted, frame, Reach::Wide);
        if count(&wide) > count(&near) {
            wide
        } else {
            near
        }
    }

    fn matched(&self, predicted: &Pose, frame: &Frame<'_>, reach: Reach) -> Option<Tracked> {
        let parameters = &self.parameters;
        let keyframes = match reach {
            Reach::Near => parameters.near_keyframes,
            Reach::Wide => 2 * parameters.near_keyframes,
        };
        let candidates = self.map.candidates(predicted, keyframes);
        let pairs = self.pairs(&candidates, predicted, frame, reach);
        let matches: Vec<FrameMatch> = pairs
            .iter()
            .map(|&(candidate, keypoint)| FrameMatch {
                anchor: candidates[candidate].anchor,
                point: frame.plane[keypoint],
            })
            .collect();

        let start = match reach {
            Reach::Near => *predicted,
            Reach::Wide => self.ransac(&matches, frame.focal_px)?,
        };
        let bundle = self
            .map
            .frame_bundle(&matches, start, frame.focal_px, parameters);
        let PosedFrame { bundle, covariance } = self.posed(bundle, &matches)?;

        let is_inlier = |landmark: &BundleLandmark| {
            let [mean, deviation] = landmark.prior;
            let (camera, point) = landmark.observations[0];
            bundle.error_px(landmark, camera, &point) < parameters.threshold_px
                && (landmark.inverse_depth - mean).abs() < MAX_DEPTH_ERROR * deviation
        };
        let inliers: BTreeMap<usize, KeypointId> = bundle
            .landmarks
            .iter()
            .zip(pairs.iter().zip(&matches))
            .filter(|(landmark, _)| is_inlier(landmark))
            .map(|(_, (&(_, keypoint), match_))| (keypoint, match_.anchor))
            .collect();

        let pose = *bundle.poses.last()?;
        (inliers.len() >= parameters.min_inliers).then_some(Tracked {
            pose,
            covariance,
            inliers,
        })
    }

    /// Estimates the pose of a frame from the landmarks of known depth if there are at least
    /// `min_known_landmarks`, then fits the other depths to it. Otherwise uses all landmarks.
    ///
    /// Landmarks of unknown depth are left out because their prior has independent deviations. True
    /// depths deviate from it together, as those of a wall, and the adjustment would explain that
    /// by a rotation.
    fn posed(&self, mut bundle: Bundle, matches: &[FrameMatch]) -> Option<PosedFrame> {
        let parameters = &self.parameters;
        let is_known = |match_: &FrameMatch| {
            let landmark = self.map.landmark(match_.anchor);
            landmark.is_some_and(|landmark| landmark.is_known(parameters))
        };
        let known: Vec<BundleLandmark> = bundle
            .landmarks
            .iter()
            .zip(matches)
            .filter(|(_, match_)| is_known(match_))
            .map(|(landmark, _)| landmark.clone())
            .collect();
        if known.len() < parameters.min_known_landmarks {
            bundle.adjust_from_afar(parameters.adjustment_steps);
            let covariance = bundle.covariance()?;
            return Some(PosedFrame { bundle, covariance });
        }

        let mut by_known = Bundle {
            landmarks: known,
            objective: Objective::Joint,
            ..bundle.clone()
        };
        by_known.adjust_from_afar(parameters.adjustment_steps);
        let covariance = by_known.covariance()?;

        bundle.poses = by_known.poses;
        bundle.is_free.fill(false);
        bundle.objective = Objective::Joint;
        bundle.adjust(parameters.adjustment_steps);
        Some(PosedFrame { bundle, covariance })
    }

    /// Pairs of a candidate and a keypoint that are each other's most similar one.
    fn pairs(
        &self,
        candidates: &[Candidate],
        predicted: &Pose,
        frame: &Frame<'_>,
        reach: Reach,
    ) -> Vec<(usize, usize)> {
        let radius = self.parameters.search_radius_px / frame.focal_px;
        let mut best_keypoint: Vec<Option<(usize, f32)>> = vec![None; candidates.len()];
        let mut best_candidate: Vec<Option<(usize, f32)>> = vec![None; frame.plane.len()];
        let descriptors: Vec<&[i8]> = frame.keypoints.descriptors().collect();
        let cells = Cells::of(&frame.plane, radius);
        let all: Vec<usize> = (0..frame.plane.len()).collect();
        for (place, candidate) in candidates.iter().enumerate() {
            let position = self.map.position(candidate.anchor);
            let keyframe = self.map.keyframe(candidate.keypoint.0);
            let Some((position, keyframe)) = position.zip(keyframe) else {
                continue;
            };

            let seen = predicted.inverse_transform_point(&position).coords;
            let expected = seen.xy() / seen.z;
            let near: Vec<usize> = match reach {
                Reach::Near if seen.z > 0.0 => cells.within(&frame.plane, &expected, radius),
                Reach::Near => Vec::new(),
                Reach::Wide => all.clone(),
            };
            let descriptor = keyframe.keypoints.descriptor(candidate.keypoint.1);
            let length = length(descriptor);
            for keypoint in near {
                let product = dot(descriptor, descriptors[keypoint]) as f32;
                let cosine = product / (length * frame.lengths[keypoint]);
                let is_better = |best: Option<(usize, f32)>| best.is_none_or(|(_, of)| cosine > of);
                if is_better(best_keypoint[place]) {
                    best_keypoint[place] = Some((keypoint, cosine));
                }
                if is_better(best_candidate[keypoint]) {
                    best_candidate[keypoint] = Some((place, cosine));
                }
            }
        }

        let mutual = best_keypoint
            .iter()
            .enumerate()
            .filter_map(|(place, best)| {
                let (keypoint, cosine) = (*best)?;
                let is_mutual = best_candidate[keypoint].is_some_and(|(back, _)| back == place);
                (is_mutual && cosine >= self.parameters.min_cosine).then_some((place, keypoint))
            });
        mutual.collect()
    }

    /// The pose that most landmarks of known depth agree with.
    fn ransac(&self, matches: &[FrameMatch], focal_px: f64) -> Option<Pose> {
        let correspondences: Vec<Correspondence> = matches
            .iter()
            .enumerate()
            .filter_map(|(keypoint, match_)| {
                let landmark = self.map.landmark(match_.anchor)?;
                let world = self.map.position(match_.anchor)?.coords;
                let keyframe = self.map.keyframe(match_.anchor.0)?;
                landmark
                    .is_known(&self.parameters)
                    .then_some(Correspondence {
                        keypoint,
                        frame: 0,
                        plane: match_.point,
                        world,
                        from_frame: world - keyframe.pose.translation.vector,
                        deviation: landmark.deviation
                            / (landmark.inverse_depth * self.parameters.deviation_px),
                    })
            })
            .collect();

        let search = Search {
            focal_px,
            threshold_px: self.parameters.threshold_px,
            deviation_px: self.parameters.deviation_px,
            iterations: self.parameters.iterations,
            miss_probability: MISS_PROBABILITY,
            seed: SEED,
        };
        Some(find_pose(&correspondences, &search)?.pose)
    }

    /// Whether a frame has enough parallax, or too few matches left.
    fn needs_keyframe(&self, found: &Tracked, frame: &Frame<'_>) -> bool {
        let parameters = &self.parameters;
        let Some(newest) = self.map.keyframes.back() else {
            return true;
        };
        let newest_from_camera = newest.pose.inv_mul(&found.pose);
        let share = found.inliers.len() as f64 / frame.plane.len() as f64;
        if share < parameters.keyframe_share
            || newest_from_camera.rotation.angle() > parameters.keyframe_angle_rad
        {
            return true;
        }

        // Displacements of the landmarks of the last keyframe, without that of the rotation.
        let anchors: BTreeSet<KeypointId> = (0..newest.shown.len())
            .filter_map(|place| self.map.anchor_of((newest.number, place)))
            .collect();
        let shared = found.inliers.values().filter(|id| anchors.contains(id));
        let displacements: Vec<f64> = shared
            .filter_map(|&anchor| {
                let position = self.map.position(anchor)?;
                let there = newest.pose.inverse_transform_point(&position);
                let turned = newest_from_camera.rotation.inverse() * there;
                let here = found.pose.inverse_transform_point(&position);
                let shift: Vector2<f64> = here.coords.xy() / here.z - turned.coords.xy() / turned.z;
                Some(shift.norm() * frame.focal_px)
            })
            .collect();
        displacements.is_empty() || median(&displacements) > parameters.keyframe_parallax_px
    }
}

/// Points by the square cell that they lie in.
struct Cells {
    size: f64,
    /// The least coordinates of the points.
    origin: Vector2<f64>,
    columns: usize,
    /// Row by row.
    points: Vec<Vec<usize>>,
}

/// Maximum number of cells along each axis.
const MOST_CELLS: usize = 64;

impl Cells {
    /// Cells that are at least this large.
    fn of(points: &[Vector2<f64>], least_size: f64) -> Self {
        let bound = |of: fn(f64, f64) -> f64, from: f64| {
            let corner = Vector2::repeat(from);
            let points = points.iter();
            points.fold(corner, |corner, point| corner.zip_map(point, of))
        };
        let origin = bound(f64::min, f64::INFINITY);
        let extent = bound(f64::max, f64::NEG_INFINITY) - origin;
        let size = least_size.max(extent.max() / MOST_CELLS as f64);
        let count = |axis: usize| (extent[axis].max(0.0) / size) as usize + 1;
        let mut cells = Self {
            size,
            origin,
            columns: count(0),
            points: vec![Vec::new(); count(0) * count(1)],
        };
        for (place, point) in points.iter().enumerate() {
            let [x, y] = [0, 1].map(|axis| ((point[axis] - origin[axis]) / size) as usize);
            cells.points[y * cells.columns + x].push(place);
        }
        cells
    }

    /// Places of the points less than `radius` from a center; it is at most the size of a cell.
    fn within(&self, points: &[Vector2<f64>], center: &Vector2<f64>, radius: f64) -> Vec<usize> {
        let rows = self.points.len() / self.columns;
        let around = |axis: usize, count: usize| {
            let cell = (center[axis] - self.origin[axis]) / self.size;
            let bound = |cell: f64| cell.clamp(0.0, count as f64) as usize;
            bound(cell.floor() - 1.0)..bound(cell.floor() + 2.0)
        };
        let is_near = |place: &usize| (points[*place] - center).norm() < radius;
        let mut near = Vec::new();
        for row in around(1, rows) {
            for column in around(0, self.columns) {
                let places = &self.points[row * self.columns + column];
                near.extend(places.iter().copied().filter(is_near));
            }
        }
        near
    }
}

impl<'a> Frame<'a> {
    fn new(view: ViewKeypoints<'a>, candidates: usize) -> Self {
        let keypoints = view.keypoints;
        let plane = plane_points(keypoints, view.camera, candidates);
        let lengths = keypoints.descriptors().take(plane.len()).map(length);
        Self {
            keypoints,
            lengths: lengths.collect(),
            plane,
            focal_px: pixel_focal(view.camera),
        }
    }
}

fn dot(a: &[i8], b: &[i8]) -> i32 {
    let products = a.iter().zip(b);
    products
        .map(|(&a, &b)| i32::from(i16::from(a) * i16::from(b)))
        .sum()
}

fn length(descriptor: &[i8]) -> f32 {
    (dot(descriptor, descriptor) as f32).sqrt().max(1.0)
}

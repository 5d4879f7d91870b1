//! Keyframes and landmarks of visual odometry.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::{Point3, Vector2, Vector3};

use super::KnownDepth;
use super::parameters::OdometryParameters;
use crate::two_view::usual_log_inverse_depth;
use seese3_core::geometry::Pose;
use seese3_core::keypoints::Keypoints;
use seese3_core::statistics::median;

/// Range of the factor by which one keyframe changes the expected depths.
const DEPTH_FACTORS: [f64; 2] = [0.5, 2.0];
/// Smallest relative deviation of a known depth.
const MIN_DEPTH_DEVIATION: f64 = 0.02;
/// Minimum depth of a landmark, meters.
const MIN_DEPTH_M: f64 = 1e-3;

/// A keypoint of a keyframe: the number of the keyframe, and the keypoint's place in it.
pub(super) type KeypointId = (u64, usize);

/// A point of the scene, on the ray of a keypoint of its anchor.
#[derive(Debug, Clone)]
pub(super) struct Landmark {
    /// Inverse depth in the anchor, 1/m.
    pub inverse_depth: f64,
    /// Its standard deviation.
    pub deviation: f64,
    /// Its prior: mean and standard deviation.
    pub prior: [f64; 2],
    /// The keypoints of other keyframes that show it.
    pub observations: Vec<KeypointId>,
}

impl Landmark {
    fn of_prior(prior: [f64; 2]) -> Self {
        Self {
            inverse_depth: prior[0],
            deviation: prior[1],
            prior,
            observations: Vec::new(),
        }
    }

    /// Whether its depth is known.
    pub fn is_known(&self, parameters: &OdometryParameters) -> bool {
        self.deviation < parameters.known_depth_deviation * self.inverse_depth
    }

    /// Multiplies the inverse depth by a factor.
    fn scale(&mut self, factor: f64) {
        self.inverse_depth *= factor;
        self.deviation *= factor;
        self.prior = self.prior.map(|value| value * factor);
    }
}

/// What a keypoint of a keyframe shows.
#[derive(Debug, Clone)]
pub(super) enum Shown {
    /// A landmark with this keypoint as its anchor.
    Anchored(Landmark),
    /// The landmark with that anchor.
    Landmark(KeypointId),
    /// Nothing that is tracked.
    Nothing,
}

/// A keyframe.
#[derive(Debug, Clone)]
pub(super) struct Keyframe {
    pub number: u64,
    /// `odom_from_camera`.
    pub pose: Pose,
    /// Keypoints on the plane at depth 1.
    pub plane: Vec<Vector2<f64>>,
    pub keypoints: Keypoints,
    /// One per keypoint.
    pub shown: Vec<Shown>,
}

/// A landmark to be matched.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    pub anchor: KeypointId,
    /// The keypoint that shows it from the nearest keyframe.
    pub keypoint: KeypointId,
}

/// Keyframes, the oldest first.
#[derive(Debug, Clone)]
pub(super) struct LocalMap {
    pub keyframes: VecDeque<Keyframe>,
    /// Mean inverse depth of the scene over the usual one.
    pub depth_factor: f64,
    next_number: u64,
}

impl LocalMap {
    pub fn new() -> Self {
        Self {
            keyframes: VecDeque::new(),
            depth_factor: 1.0,
            next_number: 0,
        }
    }

    pub fn keyframe(&self, number: u64) -> Option<&Keyframe> {
        self.keyframes.get(self.place(number)?)
    }

    /// The place of a keyframe among those that are left.
    pub fn place(&self, number: u64) -> Option<usize> {
        self.keyframes
            .binary_search_by_key(&number, |keyframe| keyframe.number)
            .ok()
    }

    /// The landmark anchored at a keypoint.
    pub fn landmark(&self, anchor: KeypointId) -> Option<&Landmark> {
        match self.keyframe(anchor.0)?.shown.get(anchor.1)? {
            Shown::Anchored(landmark) => Some(landmark),
            Shown::Landmark(_) | Shown::Nothing => None,
        }
    }

    pub fn landmark_mut(&mut self, anchor: KeypointId) -> Option<&mut Landmark> {
        let place = self.place(anchor.0)?;
        match self.keyframes[place].shown.get_mut(anchor.1)? {
            Shown::Anchored(landmark) => Some(landmark),
            Shown::Landmark(_) | Shown::Nothing => None,
        }
    }

    /// The anchor of the landmark that a keypoint shows.
    pub fn anchor_of(&self, keypoint: KeypointId) -> Option<KeypointId> {
        match self.keyframe(keypoint.0)?.shown.get(keypoint.1)? {
            Shown::Anchored(_) => Some(keypoint),
            Shown::Landmark(anchor) => Some(*anchor),
            Shown::Nothing => None,
        }
    }

    /// Position of a landmark, odom frame, meters.
    pub fn position(&self, anchor: KeypointId) -> Option<Point3<f64>> {
        let landmark = self.landmark(anchor)?;
        let keyframe = self.keyframe(anchor.0)?;
        let in_camera = keyframe.plane[anchor.1].push(1.0) / landmark.inverse_depth;
        Some(keyframe.pose * Point3::from(in_camera))
    }

    /// Inverse depth that a new landmark at a point on the plane at depth 1 is expected at.
    pub fn expected_inverse_depth(&self, point: &Vector2<f64>) -> f64 {
        usual_log_inverse_depth(*point).exp() * self.depth_factor
    }

    /// Expected depth in the center of an image, meters.
    fn unit_m(&self) -> f64 {
        self.expected_inverse_depth(&Vector2::zeros()).recip()
    }

    /// The landmarks of the `count` keyframes nearest to a predicted pose, and of the newest one.
    pub fn candidates(&self, predicted: &Pose, count: usize) -> Vec<Candidate> {
        let unit_m = self.unit_m();
        let distance = |keyframe: &Keyframe| {
            let between = keyframe.pose.inv_mul(predicted);
            between.translation.vector.norm() / unit_m + between.rotation.angle()
        };
        let mut order: Vec<(f64, usize)> = (0..self.keyframes.len())
            .map(|place| (distance(&self.keyframes[place]), place))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));

        let newest = self.keyframes.len().saturating_sub(1);
        let near = order.iter().take(count).map(|&(_, place)| place);
        let without_newest = !near.clone().any(|place| place == newest);
        let near: Vec<usize> = near.chain(without_newest.then_some(newest)).collect();

        let mut known = BTreeSet::new();
        let mut candidates = Vec::new();
        for place in near {
            let Some(keyframe) = self.keyframes.get(place) else {
                continue;
            };
            for at in 0..keyframe.shown.len() {
                let keypoint = (keyframe.number, at);
                let anchor = self.anchor_of(keypoint);
                let found = anchor.and_then(|anchor| Some((anchor, self.landmark(anchor)?)));
                let Some((anchor, landmark)) = found else {
                    continue;
                };

                // Keypoints that no later keyframe showed again are seldom found.
                let is_stable = !landmark.observations.is_empty() || place == newest;
                if is_stable && known.insert(anchor) {
                    candidates.push(Candidate { anchor, keypoint });
                }
            }
        }
        candidates
    }

    /// Adds a keyframe. `matched` are its keypoints with the landmarks that they show. Every other
    /// keypoint becomes a landmark.
    pub fn add(
        &mut self,
        pose: Pose,
        plane: Vec<Vector2<f64>>,
        keypoints: &Keypoints,
        matched: &BTreeMap<usize, KeypointId>,
        parameters: &OdometryParameters,
    ) {
        let number = self.next_number;
        self.next_number += 1;
        let shown = plane.iter().enumerate().map(|(place, point)| {
            let anchor = matched.get(&place).copied();
            let expected = self.expected_inverse_depth(point);
            let prior = [expected, parameters.depth_deviations[0] * expected];
            anchor.map_or_else(
                || Shown::Anchored(Landmark::of_prior(prior)),
                Shown::Landmark,
            )
        });
        let keyframe = Keyframe {
            number,
            pose,
            shown: shown.collect(),
            plane,
            keypoints: keypoints.clone(),
        };
        self.keyframes.push_back(keyframe);

        for (&place, &anchor) in matched {
            if let Some(landmark) = self.landmark_mut(anchor) {
                landmark.observations.push((number, place));
            }
        }
        while self.keyframes.len() > parameters.max_keyframes {
            self.drop_oldest();
        }
    }

    /// Drops the oldest keyframe. Its landmarks are anchored at the next keyframe that shows them.
    fn drop_oldest(&mut self) {
        let Some(oldest) = self.keyframes.pop_front() else {
            return;
        };
        for (place, shown) in oldest.shown.iter().enumerate() {
            if let Shown::Anchored(landmark) = shown {
                let in_camera = oldest.plane[place].push(1.0) / landmark.inverse_depth;
                self.anchor_anew(landmark, oldest.pose * Point3::from(in_camera));
            }
        }

        for keyframe in &mut self.keyframes {
            for shown in &mut keyframe.shown {
                if let Shown::Anchored(landmark) = shown {
                    let is_left = |(number, _): &KeypointId| *number != oldest.number;
                    landmark.observations.retain(is_left);
                }
            }
        }
    }

    fn anchor_anew(&mut self, landmark: &Landmark, position: Point3<f64>) {
        let Some((&anchor, others)) = landmark.observations.split_first() else {
            return;
        };
        let Some(keyframe) = self.keyframe(anchor.0) else {
            return;
        };

        let depth = keyframe.pose.inverse_transform_point(&position).z;
        let anew = (depth > MIN_DEPTH_M).then(|| {
            let mut anew = Landmark {
                observations: others.to_vec(),
                ..landmark.clone()
            };
            anew.scale((depth * landmark.inverse_depth).recip());
            anew
        });

        let is_usable = anew.is_some();
        self.show(anchor, anew.map_or(Shown::Nothing, Shown::Anchored));
        for &other in others {
            let shown = if is_usable {
                Shown::Landmark(anchor)
            } else {
                Shown::Nothing
            };
            self.show(other, shown);
        }
    }

    /// Sets what a keypoint shows.
    pub fn show(&mut self, keypoint: KeypointId, shown: Shown) {
        if let Some(place) = self.place(keypoint.0) {
            self.keyframes[place].shown[keypoint.1] = shown;
        }
    }

    /// Takes known depths as those of landmarks whose own depth is not known. `landmarks` are those
    /// of a view's keypoints, `plane` the keypoints on the plane at depth 1.
    pub fn take_depths(
        &mut self,
        landmarks: &BTreeMap<usize, KeypointId>,
        pose: &Pose,
        plane: &[Vector2<f64>],
        depths: &[KnownDepth],
        parameters: &OdometryParameters,
    ) {
        for known in depths {
            let Some(&anchor) = landmarks.get(&known.keypoint) else {
                continue;
            };
            let Some(keyframe) = self.keyframe(anchor.0) else {
                continue;
            };
            let in_view = plane[known.keypoint].push(1.0) * known.depth_m;
            let position = pose * Point3::from(in_view);
            let depth = keyframe.pose.inverse_transform_point(&position).z;

            let landmark = self.landmark_mut(anchor);
            let unknown = landmark.filter(|landmark| !landmark.is_known(parameters));
            if let Some(landmark) = unknown.filter(|_| depth > MIN_DEPTH_M) {
                let deviation = known.deviation.max(MIN_DEPTH_DEVIATION);
                let observations = std::mem::take(&mut landmark.observations);
                *landmark = Landmark {
                    observations,
                    ..Landmark::of_prior([depth.recip(), deviation / depth])
                };
            }
        }
    }

    /// Median ratio of known depths to those of the landmarks; `None` if there are too few.
    pub fn scale_ratio(
        &self,
        landmarks: &BTreeMap<usize, KeypointId>,
        pose: &Pose,
        depths: &[KnownDepth],
        parameters: &OdometryParameters,
    ) -> Option<f64> {
        let ratio = |known: &KnownDepth| {
            let anchor = *landmarks.get(&known.keypoint)?;
            let is_known = self.landmark(anchor)?.is_known(parameters);
            let depth = pose.inverse_transform_point(&self.position(anchor)?).z;
            (is_known && depth > MIN_DEPTH_M).then(|| known.depth_m / depth)
        };
        let ratios: Vec<f64> = depths.iter().filter_map(ratio).collect();
        (ratios.len() >= parameters.min_known_depths).then(|| median(&ratios))
    }

    /// Multiplies all distances from a camera position by a factor.
    pub fn rescale(&mut self, center: &Vector3<f64>, factor: f64) {
        for keyframe in &mut self.keyframes {
            let from_center = keyframe.pose.translation.vector - center;
            keyframe.pose.translation.vector = center + from_center * factor;
            for shown in &mut keyframe.shown {
                if let Shown::Anchored(landmark) = shown {
                    landmark.scale(factor.recip());
                }
            }
        }
        self.depth_factor /= factor;
    }

    /// Updates the depths that new landmarks are expected at, by those that the newest keyframe
    /// shows. Landmarks of unknown depth count as unchanged.
    pub fn update_depth_factor(&mut self, parameters: &OdometryParameters) {
        let Some(newest) = self.keyframes.back() else {
            return;
        };
        let change = |place: usize| {
            let anchor = self.anchor_of((newest.number, place))?;
            let landmark = self.landmark(anchor)?;
            if landmark.observations.is_empty() {
                return None;
            }
            if !landmark.is_known(parameters) {
                return Some(0.0);
            }

            let depth = newest
                .pose
                .inverse_transform_point(&self.position(anchor)?)
                .z;
            let expected = self.expected_inverse_depth(&newest.plane[place]);
            let ratio = (depth.max(MIN_DEPTH_M) * expected).recip();
            Some(ratio.min(2.0 * DEPTH_FACTORS[1]) - 1.0)
        };
        let changes: Vec<f64> = (0..newest.shown.len()).filter_map(change).collect();
        let mean = changes.iter().sum::<f64>() / changes.len().max(1) as f64;
        let [least, most] = DEPTH_FACTORS;
        self.depth_factor *= (1.0 + mean).clamp(least, most);
    }
}

//! Adjustment of the local map, and of the pose of a frame in it.

use std::collections::BTreeSet;

use super::bundle::{Bundle, BundleLandmark, Objective};
use super::local_map::{KeypointId, Landmark, LocalMap, Shown};
use super::parameters::OdometryParameters;
use nalgebra::Vector2;
use seese3_core::geometry::Pose;

/// A landmark that a keypoint of a frame shows.
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameMatch {
    pub anchor: KeypointId,
    /// The keypoint on the plane at depth 1.
    pub point: Vector2<f64>,
}

impl LocalMap {
    /// A bundle with the pose of a frame, its last camera, as the only free one.
    pub fn frame_bundle(
        &self,
        matches: &[FrameMatch],
        start: Pose,
        focal_px: f64,
        parameters: &OdometryParameters,
    ) -> Bundle {
        let camera = self.keyframes.len();
        let landmarks = matches.iter().filter_map(|match_| {
            let landmark = self.landmark(match_.anchor)?;
            let prior = if landmark.is_known(parameters) {
                [landmark.inverse_depth, landmark.deviation]
            } else {
                let place = self.place(match_.anchor.0)?;
                let point = &self.keyframes[place].plane[match_.anchor.1];
                let expected = self.expected_inverse_depth(point);
                [expected, parameters.depth_deviations[1] * expected]
            };
            let seen = vec![(camera, match_.point)];
            self.bundle_landmark(match_.anchor, landmark, prior, seen)
        });

        let keyframes = self.keyframes.iter().map(|keyframe| keyframe.pose);
        Bundle {
            landmarks: landmarks.collect(),
            poses: keyframes.chain([start]).collect(),
            is_free: (0..=camera).map(|place| place == camera).collect(),
            objective: Objective::Marginal,
            focal_px,
            deviation_px: parameters.deviation_px,
        }
    }

    /// Adjusts the newest keyframes and the landmarks that they show, and removes outliers. If only
    /// the first keyframe is fixed, it also tries the reversed scene. Returns whether the reversed
    /// scene was accepted.
    pub fn adjust(&mut self, focal_px: f64, parameters: &OdometryParameters) -> bool {
        let count = self.keyframes.len();
        if count < 2 {
            return false;
        }

        let first_free = count.saturating_sub(parameters.window).max(1);
        let anchors = self.adjustable(first_free - 1, focal_px, parameters);
        let landmarks = anchors.iter().filter_map(|&anchor| {
            let landmark = self.landmark(anchor)?;
            let observations = landmark.observations.iter().filter_map(|&(number, place)| {
                let camera = self.place(number)?;
                Some((camera, self.keyframes[camera].plane[place]))
            });
            self.bundle_landmark(anchor, landmark, landmark.prior, observations.collect())
        });
        let mut bundle = Bundle {
            landmarks: landmarks.collect(),
            poses: self
                .keyframes
                .iter()
                .map(|keyframe| keyframe.pose)
                .collect(),
            is_free: (0..count).map(|place| place >= first_free).collect(),
            objective: Objective::Joint,
            focal_px,
            deviation_px: parameters.deviation_px,
        };
        let reversed = (first_free == 1).then(|| bundle.reversed());
        bundle.adjust(parameters.adjustment_steps);
        let reversed = reversed.and_then(|mut reversed| {
            reversed.adjust(parameters.adjustment_steps);
            if reversed.cost() < bundle.cost() {
                // A lower cost may only mean that the other is not at its minimum.
                bundle.adjust(2 * parameters.adjustment_steps);
            }
            (reversed.cost() < bundle.cost()).then_some(reversed)
        });
        let is_reversed = reversed.is_some();
        let bundle = reversed.unwrap_or(bundle);

        for (keyframe, pose) in self.keyframes.iter_mut().zip(&bundle.poses) {
            keyframe.pose = *pose;
        }
        for (&anchor, adjusted) in anchors.iter().zip(&bundle.landmarks) {
            self.take_adjusted(anchor, adjusted, &bundle, parameters);
        }
        self.update_depth_factor(parameters);
        is_reversed
    }

    /// The landmarks that the keyframes from `first` on show, with a known depth or enough
    /// parallax.
    fn adjustable(
        &self,
        first: usize,
        focal_px: f64,
        parameters: &OdometryParameters,
    ) -> Vec<KeypointId> {
        let keyframes = self.keyframes.iter().skip(first);
        let keypoints = keyframes.flat_map(|keyframe| {
            let number = keyframe.number;
            (0..keyframe.shown.len()).map(move |place| (number, place))
        });
        let anchors: BTreeSet<KeypointId> = keypoints
            .filter_map(|keypoint| self.anchor_of(keypoint))
            .collect();

        let is_determined = |anchor: &KeypointId| {
            let landmark = self.landmark(*anchor);
            landmark.is_some_and(|landmark| {
                landmark.is_known(parameters)
                    || self.parallax_px(*anchor, landmark, focal_px) > parameters.min_parallax_px
            })
        };
        anchors.into_iter().filter(is_determined).collect()
    }

    fn bundle_landmark(
        &self,
        anchor: KeypointId,
        landmark: &Landmark,
        prior: [f64; 2],
        observations: Vec<(usize, Vector2<f64>)>,
    ) -> Option<BundleLandmark> {
        let camera = self.place(anchor.0)?;
        Some(BundleLandmark {
            anchor: camera,
            direction: self.keyframes[camera].plane[anchor.1].push(1.0),
            inverse_depth: landmark.inverse_depth,
            prior,
            observations,
            deviation: landmark.deviation,
        })
    }

    /// Largest displacement of a landmark between its anchor and another keyframe, without that of
    /// the rotation, pixels.
    fn parallax_px(&self, anchor: KeypointId, landmark: &Landmark, focal_px: f64) -> f64 {
        let Some(keyframe) = self.keyframe(anchor.0) else {
            return 0.0;
        };
        let direction = keyframe.pose.rotation * keyframe.plane[anchor.1].push(1.0);
        let displacements = landmark.observations.iter().filter_map(|&(number, place)| {
            let other = self.keyframe(number)?;
            let turned = other.pose.rotation.inverse() * direction;
            Some((other.plane[place] - turned.xy() / turned.z).norm() * focal_px)
        });
        displacements.fold(0.0, f64::max)
    }

    /// Takes an adjusted depth, without the observations that contradict it.
    fn take_adjusted(
        &mut self,
        anchor: KeypointId,
        adjusted: &BundleLandmark,
        bundle: &Bundle,
        parameters: &OdometryParameters,
    ) {
        let Some(landmark) = self.landmark_mut(anchor) else {
            return;
        };
        let is_good = |(camera, point): &(usize, Vector2<f64>)| {
            bundle.error_px(adjusted, *camera, point) < parameters.threshold_px
        };
        let observations = std::mem::take(&mut landmark.observations);
        let (good, bad): (Vec<_>, Vec<_>) = observations
            .into_iter()
            .zip(&adjusted.observations)
            .partition(|(_, observed)| is_good(observed));

        landmark.observations = good.into_iter().map(|(keypoint, _)| keypoint).collect();
        let [mean, deviation] = landmark.prior;
        let is_seen = !landmark.observations.is_empty();
        landmark.inverse_depth = if is_seen {
            adjusted.inverse_depth
        } else {
            mean
        };
        landmark.deviation = if is_seen {
            adjusted.deviation
        } else {
            deviation
        };
        for (keypoint, _) in bad {
            self.show(keypoint, Shown::Nothing);
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use std::collections::BTreeMap;

    use nalgebra::Vector3;
    use seese3_testing::keypoint_scene::{Random, Scene, distorted_camera};

    use super::*;
    use crate::matched_views::{pixel_focal, plane_points};

    /// Oracle: the true pose, 0.3 m to the side. The map holds the reversed scene: the camera on
    /// the other side, turned by 0.15 rad, and near points far away.
    #[test]
    fn a_reversed_map_is_reversed() {
        let scene = Scene::in_box(300, 1);
        let camera = distorted_camera();
        let mut random = Random::new(3);
        let truth = Pose::translation(0.3, 0.0, 0.0);
        let [first, second] =
            [Pose::identity(), truth].map(|pose| scene.view(&pose, &camera, 0.5, &mut random));
        let parameters = OdometryParameters::default();
        let planes = [&first, &second].map(|view| plane_points(&view.keypoints, &camera, 600));

        let mut map = LocalMap::new();
        let [first_plane, second_plane] = planes;
        map.add(
            Pose::identity(),
            first_plane,
            &first.keypoints,
            &BTreeMap::new(),
            &parameters,
        );
        let anchor = |point: &usize| first.shown.iter().position(|shown| shown == point);
        let matched = second.shown.iter().enumerate();
        let matched = matched.filter_map(|(place, point)| Some((place, (0, anchor(point)?))));
        let wrong = Pose::new(Vector3::x() * -0.3, Vector3::y() * -0.15);
        let matched = matched.collect();
        map.add(
            wrong,
            second_plane,
            &second.keypoints,
            &matched,
            &parameters,
        );
        for (place, point) in first.shown.iter().enumerate() {
            let landmark = map.landmark_mut((0, place)).unwrap();
            landmark.inverse_depth = (0.5 - 1.0 / scene.points[*point].z).max(0.05);
        }

        assert!(map.adjust(pixel_focal(&camera), &parameters));
        let found = map.keyframes[1].pose;
        assert!(found.translation.vector.x > 0.1, "{found}");
        assert!(found.rotation.angle() < 0.01, "{found}");
    }
}

//! Odometry without a map: its drift, beside simple baselines on the same frames.

use serde::Serialize;

use super::player::{PlayedView, Player, Reader, Sensed, Sight, ViewInput};
use super::simulated_sensors::{has_depths, wheels};
use super::tracking_scores::Drift;
use seese3_core::geometry::{Pose, PoseError};
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::two_view;

/// The true length is given over the first part of a stream: at least this many meters and seconds.
const FIRST_PART: [f64; 2] = [0.15, 1.0];
/// Time between the views of the two-view baseline, seconds.
const TWO_VIEW_S: f64 = 0.3;

/// Drift of odometry without a map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MaplessDrift {
    /// Of `odom_from_camera` by images alone; the scale is that of the usual depth of rooms.
    pub images: Drift,
    /// The same, scaled to the true length of the first part.
    pub images_true_length: Drift,
    /// By images with simulated depths.
    pub depths: Drift,
    /// By images and simulated wheels.
    pub wheels: Drift,
    /// By the wheels alone.
    pub wheels_alone: Drift,
    /// Composed motions of pairs of views, each with its true length; NaN without keypoints.
    pub two_view_true_lengths: Drift,
}

/// True and estimated poses of a stream.
struct Paths {
    truth: Vec<Pose>,
    estimated: Vec<Pose>,
}

impl MaplessDrift {
    /// Plays all streams of a room without its map; `depths` are simulated depths of their views.
    pub(super) fn of<'a>(
        streams: &[&[PlayedView<'a>]],
        player: &dyn Fn(Option<Pose>) -> Player<'a>,
        depths: &[Vec<Sensed>],
    ) -> Self {
        let truth = |views: &[PlayedView<'_>]| views.iter().map(|view| view.truth).collect();
        let played = |views: &[PlayedView<'a>], sensed: &[Sensed]| {
            let mut player = player(None);
            let odom = views.iter().zip(sensed).map(|(view, sensed)| {
                let update = player.step(view, Sight::Unmapped, sensed);
                update.map_or_else(Pose::identity, |update| update.odom.pose)
            });
            Paths {
                estimated: odom.collect(),
                truth: truth(views),
            }
        };

        let all = streams.iter();
        let images: Vec<Paths> = all
            .clone()
            .map(|views| played(views, &vec![Sensed::default(); views.len()]))
            .collect();
        let scaled = images.iter().zip(streams);
        let with_depths: Vec<Paths> = if has_depths(streams, depths) {
            let both = all.clone().zip(depths);
            both.map(|(views, depths)| played(views, depths)).collect()
        } else {
            Vec::new()
        };
        let with_wheels = all
            .clone()
            .enumerate()
            .map(|(number, views)| played(views, &wheels(views, number as u64)));
        let alone = all.clone().enumerate().map(|(number, views)| {
            let sensed = wheels(views, number as u64);
            let measured = sensed.iter().filter_map(|sensed| sensed.measured);
            Paths {
                truth: truth(views),
                estimated: measured.map(|measured| measured.pose).collect(),
            }
        });
        Self {
            images: drift(&images),
            images_true_length: drift(
                &scaled
                    .map(|(paths, views)| paths.with_true_length(views))
                    .collect::<Vec<_>>(),
            ),
            depths: drift(&with_depths),
            wheels: drift(&with_wheels.collect::<Vec<_>>()),
            wheels_alone: drift(&alone.collect::<Vec<_>>()),
            two_view_true_lengths: drift(
                &all.map(|views| two_views(views, &player(None)))
                    .collect::<Vec<_>>(),
            ),
        }
    }

    /// Means over rooms.
    pub fn mean<'a>(rooms: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let of = |drift: fn(&Self) -> &Drift| Drift::mean(rooms.clone().map(drift));
        Self {
            images: of(|drifts| &drifts.images),
            images_true_length: of(|drifts| &drifts.images_true_length),
            depths: of(|drifts| &drifts.depths),
            wheels: of(|drifts| &drifts.wheels),
            wheels_alone: of(|drifts| &drifts.wheels_alone),
            two_view_true_lengths: of(|drifts| &drifts.two_view_true_lengths),
        }
    }
}

fn drift(paths: &[Paths]) -> Drift {
    Drift::of_paths(
        paths
            .iter()
            .map(|paths| (&paths.truth[..], &paths.estimated[..])),
    )
}

impl Paths {
    /// The estimated path, with the distances from its beginning in the first part as long as the
    /// true ones.
    fn with_true_length(&self, views: &[PlayedView<'_>]) -> Self {
        let distance =
            |poses: &[Pose], row: usize| PoseError::between(&poses[0], &poses[row]).translation_m;
        let seconds = |row: usize| (views[row].time_ns - views[0].time_ns) as f64 * 1e-9;
        let is_enough = |row: &usize| {
            distance(&self.truth, *row) >= FIRST_PART[0] && seconds(*row) >= FIRST_PART[1]
        };
        let end = (1..views.len()).find(is_enough).unwrap_or(views.len());
        let sum = |poses: &[Pose]| (1..end).map(|row| distance(poses, row)).sum::<f64>();

        let factor = sum(&self.truth) / sum(&self.estimated).max(1e-9);
        let scaled = self.estimated.iter().map(|pose| Pose {
            translation: (pose.translation.vector * factor).into(),
            rotation: pose.rotation,
        });
        Self {
            truth: self.truth.clone(),
            estimated: scaled.collect(),
        }
    }
}

/// Composed motions of pairs of views.
fn two_views(views: &[PlayedView<'_>], player: &Player<'_>) -> Paths {
    let mut paths = Paths {
        truth: Vec::new(),
        estimated: Vec::new(),
    };
    let Reader::Keypoints { map, .. } = &player.reader else {
        return paths;
    };

    let mut last: Option<(&PlayedView<'_>, ViewKeypoints<'_>)> = None;
    for view in views {
        let ViewInput::Keypoints { keypoints, .. } = view.input else {
            return paths;
        };
        let is_due = |(before, _): &(&PlayedView<'_>, ViewKeypoints<'_>)| {
            (view.time_ns - before.time_ns) as f64 * 1e-9 >= TWO_VIEW_S
        };
        if last.as_ref().is_some_and(|last| !is_due(last)) {
            continue;
        }

        let now = ViewKeypoints {
            keypoints,
            camera: &map.map().camera,
        };
        let motion = last.map_or_else(Pose::identity, |(before, then)| {
            let mut motion = two_view::estimate(then, now).motion;
            let length = PoseError::between(&before.truth, &view.truth).translation_m;
            let estimated = motion.translation.vector.norm().max(1e-9);
            motion.translation.vector *= length / estimated;
            motion
        });
        let pose = paths.estimated.last().map_or(motion, |last| last * motion);
        paths.estimated.push(pose);
        paths.truth.push(view.truth);
        last = Some((view, now));
    }
    paths
}

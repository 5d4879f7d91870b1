//! Locates views of a stream by the most similar mapped frames.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use nalgebra::Matrix6;
use ndarray::ArrayView1;

use super::ImageReading;
use crate::pose_filter::{LocatedPose, Source, ViewObservation};
use crate::tracking::{BestMatch, Map, MapMatch, MapQuery, PoseWithCovariance, ROOM_RATIO};
use seese3_core::geometry::Pose;

/// Largest novelty of a view that shows the room for certain. Other views only correct a pose that
/// agrees with them. Chosen on eight drawn rooms. With a limit of 1, 54 % of the TRACKING poses of
/// another visit were wrong; with 0.5, 8 %. On mapped paths, TRACKING fell from 100 % to 95 %.
const CERTAIN_NOVELTY: f64 = 0.5;

/// A view of one of the robot's cameras.
#[derive(Debug, Clone, Copy)]
pub struct StreamView<'a> {
    /// The camera; `None` for the stream's own camera.
    pub other: Option<OtherCamera>,
    /// Latent under the adapter of the maps, shape (k,).
    pub latent: ArrayView1<'a, f64>,
    /// Raw feature of that latent, shape (d,), if known.
    pub feature: Option<&'a [f32]>,
    /// Whether the image is known to be blank.
    pub is_blank: bool,
}

/// Another camera on the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OtherCamera {
    /// Its number.
    pub number: u32,
    /// Its pose when its view was taken, in the stream's own camera at the time of the frame.
    pub camera_from_other: Pose,
    /// Covariance of the motion between these two times, of δ on the right of the pose of the
    /// stream's own camera, ordered (v, ω).
    pub motion_covariance: Matrix6<f64>,
}

/// The front end of a stream of latents and features, kept in memory while the stream is open.
#[derive(Debug, Clone, Default)]
pub struct RetrievalFrontEnd {
    /// The last view of each camera that was not blank, by the camera's number: its fingerprint.
    last: HashMap<Option<u32>, u64>,
}

/// What the views of one frame tell.
#[derive(Debug, Clone)]
pub struct RetrievalReading {
    /// Poses of the stream's own camera, the most similar view first.
    pub located: Vec<LocatedPose>,
    /// The most similar mapped frame.
    pub best_match: Option<BestMatch>,
    /// Least novelty of the views, relative to the limit; infinite if all are blank.
    pub novelty: f64,
    /// Why no view certainly shows a room; empty if one does.
    pub unlocated: String,
    /// Equal for identical views of the stream's own camera; `None` for a blank one.
    pub fingerprint: Option<u64>,
}

/// A view with its best match.
struct Retrieved<'a> {
    view: StreamView<'a>,
    room: usize,
    matched: MapMatch,
    /// Whether no other room is nearly as similar.
    is_clear: bool,
    /// Whether it differs from the last view of its camera.
    is_new: bool,
}

impl RetrievalFrontEnd {
    /// Forgets the stream.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// Retrieves the views of one frame, the stream's own first, in one room of `maps` or, if it is
    /// unknown, in all.
    pub fn read(
        &mut self,
        views: &[StreamView<'_>],
        maps: &[Arc<Map>],
        room: Option<usize>,
    ) -> RetrievalReading {
        let mut fingerprint = None;
        let mut found: Vec<Retrieved<'_>> = Vec::new();
        for view in views.iter().filter(|view| !view.is_blank) {
            let (seen, is_new) = self.fingerprint_of(view);
            if view.other.is_none() {
                fingerprint = Some(seen);
            }
            found.extend(retrieved(*view, maps, room).map(|found| Retrieved { is_new, ..found }));
        }

        let strangeness = |found: &Retrieved<'_>| {
            let is_usable = found.is_new && found.is_clear;
            (!is_usable, found.matched.out_of_distribution)
        };
        found.sort_by(|a, b| {
            let (a, b) = (strangeness(a), strangeness(b));
            a.0.cmp(&b.0).then(a.1.total_cmp(&b.1))
        });

        let leading = found.first();
        let room = leading.map(|leading| leading.room);
        let is_used = |view: &&Retrieved<'_>| {
            let has_pose = view.matched.is_by_feature || view.is_of_room();
            view.is_new && view.is_clear && Some(view.room) == room && has_pose
        };
        RetrievalReading {
            located: found
                .iter()
                .filter(is_used)
                .map(|view| view.located(maps))
                .collect(),
            best_match: leading.map(|leading| BestMatch {
                room: leading.room,
                frame: leading.matched.nearest[0],
                camera: leading.view.other.map(|other| other.number),
            }),
            novelty: leading.map_or(f64::INFINITY, |leading| leading.matched.out_of_distribution),
            unlocated: why_unlocated(leading),
            fingerprint,
        }
    }

    /// The fingerprint of a view, and whether it differs from the last view of its camera.
    fn fingerprint_of(&mut self, view: &StreamView<'_>) -> (u64, bool) {
        let mut hasher = DefaultHasher::new();
        for value in view.latent {
            value.to_bits().hash(&mut hasher);
        }
        let fingerprint = hasher.finish();
        let camera = view.other.map(|other| other.number);
        let last = self.last.insert(camera, fingerprint);
        (fingerprint, last != Some(fingerprint))
    }
}

/// The best match of a view.
fn retrieved<'a>(
    view: StreamView<'a>,
    maps: &[Arc<Map>],
    room: Option<usize>,
) -> Option<Retrieved<'a>> {
    let query = MapQuery {
        latent: view.latent,
        feature: view.feature,
    };
    let asked = maps.iter().enumerate();
    let asked = asked.filter(|(place, _)| room.is_none_or(|room| room == *place));
    let mut matches: Vec<(usize, MapMatch)> = asked
        .map(|(place, map)| (place, map.match_view(query, 1)))
        .collect();
    matches.sort_by(|a, b| a.1.distance.total_cmp(&b.1.distance));

    let second = matches.get(1).map(|(_, second)| second.distance);
    let (room, matched) = matches.into_iter().next()?;
    Some(Retrieved {
        view,
        room,
        is_clear: second.is_none_or(|second| matched.distance <= ROOM_RATIO * second),
        is_new: true,
        matched,
    })
}

impl Retrieved<'_> {
    /// Whether the view certainly shows its room.
    fn is_of_room(&self) -> bool {
        self.is_new && self.is_clear && self.matched.out_of_distribution <= CERTAIN_NOVELTY
    }

    /// The pose of the stream's own camera. A localizer of the room estimates that of a certain
    /// match; outside the mapped part it is overconfident.
    fn located(&self, maps: &[Arc<Map>]) -> LocatedPose {
        let feature = self.view.feature.filter(|_| self.matched.is_certain);
        let by_reader = maps[self.room].pose_by_reader(feature);
        let pose: PoseWithCovariance = by_reader.unwrap_or(self.matched.pose);
        LocatedPose {
            room: self.room,
            pose: match &self.view.other {
                Some(other) => {
                    let own = pose.of_attached(&other.camera_from_other.inverse());
                    PoseWithCovariance {
                        covariance: own.covariance + other.motion_covariance,
                        ..own
                    }
                }
                None => pose,
            },
            source: Source::Retrieved,
            is_of_room: self.is_of_room(),
            camera: self.view.other.map(|other| other.number),
        }
    }
}

fn why_unlocated(leading: Option<&Retrieved<'_>>) -> String {
    match leading {
        None => "the image is blank: it has nearly uniform brightness".to_owned(),
        Some(view) if view.is_of_room() => String::new(),
        Some(view) if !view.is_new => "the view is identical to the one before".to_owned(),
        Some(view) if !view.is_clear => {
            "two rooms are nearly as similar to the view as each other".to_owned()
        }
        Some(view) if view.matched.out_of_distribution <= 1.0 => {
            "the view resembles the mapped frames, but not closely".to_owned()
        }
        Some(view) => format!(
            "the view shows nothing known: it is {:.1} times as far from the mapped frames as views of the room are \
             at most",
            view.matched.out_of_distribution
        ),
    }
}

impl RetrievalReading {
    /// The observation of a frame with these views, without other sensors. The keypoints of the
    /// stream's own image, if they are matched, locate it better.
    pub fn observation(
        mut self,
        image: &ImageReading,
        time_ns: i64,
        sequence: u64,
    ) -> ViewObservation {
        if let Some(matched) = &image.matched {
            self.located
                .retain(|located| located.camera.is_some() && located.room == matched.room);
            self.located.insert(0, matched.located());
            self.best_match = Some(matched.best_match());
            self.novelty = matched.novelty;
            self.unlocated = String::new();
        }
        ViewObservation {
            located: self.located,
            best_match: self.best_match,
            novelty: self.novelty,
            unlocated: self.unlocated,
            fingerprint: self.fingerprint,
            visual: image.motion.clone(),
            ..ViewObservation::empty(time_ns, sequence)
        }
    }
}

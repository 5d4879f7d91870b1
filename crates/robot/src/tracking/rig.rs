//! Multi-camera rigs: matches the simultaneous views of all cameras of a robot.
//!
//! The stream's own camera is the one for which pose and motion are estimated. Other cameras have
//! known extrinsics. The view most similar to the room leads: only this view may relocalize the
//! robot. The other views only correct the believed pose.

use ndarray::{Array1, ArrayView1};

use super::map::MapMatch;
use super::sight::{Sight, UNCHANGED_DISTANCE, distance};
use super::state::{MatchedPose, Observation, State};
use super::tracker::Tracker;
use super::{MapAnchor, MapQuery, PoseWithCovariance, ROOM_RATIO, RecentMatches};
use seese3_core::geometry::Pose;

/// View of another camera on the same robot, simultaneous with a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct OtherView {
    /// Camera number, constant over the stream.
    pub camera: u32,
    /// Pose of the other camera in the frame of the stream's own camera, meters.
    pub camera_from_other: Pose,
    /// Latent under the tracker's adapter, shape (k,).
    pub latent: Array1<f64>,
    /// Raw feature of that latent, shape (d,), if known.
    pub feature: Option<Vec<f32>>,
    /// Whether the image is known to be blank.
    pub is_blank: bool,
}

/// State of another camera.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OtherCamera {
    /// Camera number.
    pub camera: u32,
    /// Whitened latent of its last view that was not blank.
    pub last: Vec<f64>,
    /// Number of consecutive views identical to their predecessor.
    pub unchanged_frames: u32,
}

/// A view with its best match among the maps.
pub(super) struct MatchedView<'a> {
    /// The other camera's view; `None` for the stream's own camera.
    pub other: Option<&'a OtherView>,
    /// Raw feature, if known.
    pub feature: Option<&'a [f32]>,
    pub sight: Sight,
    /// Whether the view is identical to the previous view of its camera.
    pub is_repeated: bool,
    /// The matched map, an index of [`Tracker::maps`].
    pub room: usize,
    /// Whether no other map matches nearly as well, by [`ROOM_RATIO`].
    pub is_clear: bool,
    /// Whether matched keypoints give the pose. They prove the place, whatever the distance of the
    /// latent.
    pub is_proven: bool,
    pub matched: MapMatch,
}

impl MatchedView<'_> {
    /// The view with the pose of its matched keypoints.
    fn proven_by(self, found: &MatchedPose) -> Self {
        Self {
            is_clear: true,
            is_proven: true,
            matched: MapMatch {
                is_certain: true,
                out_of_distribution: found.novelty,
                anchor: MapAnchor {
                    belief: found.pose,
                    memory_s: 0.0,
                    lasting_share: 0.0,
                },
                ..self.matched
            },
            ..self
        }
    }

    /// Whether the view is usable and in distribution.
    pub(super) fn matches_room(&self) -> bool {
        self.sight == Sight::Clear && self.matched.out_of_distribution <= 1.0
    }

    /// Pose of the stream's own camera estimated from the match.
    pub(super) fn placed(&self) -> PoseWithCovariance {
        let belief = self.matched.anchor.belief;
        match self.other {
            Some(other) => belief.of_attached(&other.camera_from_other.inverse()),
            None => belief,
        }
    }

    /// Criterion for the leading view, lowest first. It is infinite for views that are unusable,
    /// repeated, or ambiguous between rooms.
    fn strangeness(&self) -> f64 {
        if self.sight == Sight::Clear && !self.is_repeated && self.is_clear {
            self.matched.out_of_distribution
        } else {
            f64::INFINITY
        }
    }
}

/// Matches of the simultaneous views of all cameras.
pub(super) struct RigMatches<'a> {
    /// Best match; the stream's own view if no other is better.
    pub leading: MatchedView<'a>,
    /// Whether the stream's own view matches a room.
    pub own_matches_room: bool,
    /// Whether another camera's view matches the room with certainty.
    pub is_seen_by_other: bool,
    /// The other usable views that are not repeated.
    pub beside: Vec<MatchedView<'a>>,
}

impl Tracker {
    /// Matches all views of a frame, and records the views of other cameras in the state. The
    /// stream's own view was recorded before.
    pub(super) fn look<'a>(&self, state: &mut State, frame: &'a Observation) -> RigMatches<'a> {
        let own = View {
            latent: frame.latent.view(),
            feature: frame.feature.as_deref(),
            is_blank: frame.is_blank,
            unchanged_frames: state.unchanged_frames,
        };
        let mut leading = match &frame.matched {
            Some(matched) => self
                .matched(Some(matched.room), &own, None)
                .proven_by(matched),
            None => self.matched(state.room, &own, None),
        };
        if leading.sight == Sight::Clear && !leading.is_proven {
            let anchor = &leading.matched.anchor.belief;
            let recent = RecentMatches::after(state.recent_matches, frame.time_ns, anchor);
            state.recent_matches = Some(recent);
        }

        let own_matches_room = leading.matches_room();
        let mut is_seen_by_other = false;
        let mut beside = Vec::new();

        for other in &frame.other_views {
            let view = View {
                latent: other.latent.view(),
                feature: other.feature.as_deref(),
                is_blank: other.is_blank,
                unchanged_frames: self.record_other(state, other),
            };
            let mut matched = self.matched(state.room, &view, Some(other));

            is_seen_by_other |=
                matched.matches_room() && matched.matched.is_certain && !matched.is_repeated;
            if matched.strangeness() < leading.strangeness() {
                std::mem::swap(&mut leading, &mut matched);
            }
            beside.push(matched);
        }

        beside.retain(|view| view.sight == Sight::Clear && !view.is_repeated);
        RigMatches {
            leading,
            own_matches_room,
            is_seen_by_other,
            beside,
        }
    }

    /// Records another camera's view; returns its number of consecutive identical views.
    fn record_other(&self, state: &mut State, other: &OtherView) -> u32 {
        let mut cameras = state.other_cameras.iter_mut();
        let known = cameras.find(|known| known.camera == other.camera);
        if other.is_blank {
            return known.map_or(0, |known| known.unchanged_frames);
        }

        let whitened = self.whitened(other.latent.view());
        let Some(known) = known else {
            state.other_cameras.push(OtherCamera {
                camera: other.camera,
                last: whitened,
                unchanged_frames: 0,
            });
            return 0;
        };

        known.unchanged_frames = if distance(&known.last, &whitened) <= UNCHANGED_DISTANCE {
            known.unchanged_frames.saturating_add(1)
        } else {
            0
        };
        known.last = whitened;
        known.unchanged_frames
    }

    /// Matches a view with the stream's room or, if that is unknown, with the best of all maps.
    fn matched<'a>(
        &self,
        room: Option<usize>,
        view: &View<'a>,
        other: Option<&'a OtherView>,
    ) -> MatchedView<'a> {
        let query = MapQuery {
            latent: view.latent,
            feature: view.feature,
        };

        let mut matches: Vec<(usize, MapMatch)> = self
            .maps
            .iter()
            .enumerate()
            .filter(|(place, _)| room.is_none_or(|room| room == *place))
            .map(|(place, map)| (place, map.match_view(query, 1)))
            .collect();
        let distance = |found: &(usize, MapMatch)| found.1.distance;
        matches.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.0.cmp(&b.0)));

        let is_clear = matches
            .get(1)
            .is_none_or(|second| distance(&matches[0]) <= ROOM_RATIO * distance(second));
        let (room, matched) = matches.swap_remove(0);

        MatchedView {
            other,
            feature: view.feature,
            sight: Sight::of(view.is_blank, view.unchanged_frames),
            is_repeated: view.unchanged_frames > 0,
            room,
            is_clear,
            is_proven: false,
            matched,
        }
    }
}

/// A view of one camera.
struct View<'a> {
    latent: ArrayView1<'a, f64>,
    feature: Option<&'a [f32]>,
    is_blank: bool,
    unchanged_frames: u32,
}

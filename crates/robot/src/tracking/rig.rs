//! Several cameras on one robot: what each of them sees at one time, and which of them looks most
//! like the room.
//!
//! A stream has one camera of its own, whose pose is told and whose motion is read. What other
//! cameras see at the same time, from known places beside it, tells where the robot is as well: the
//! view that looks most like the room leads, and may find the robot; the others correct what is
//! believed.

use ndarray::{Array1, ArrayView1};

use super::map::MapMatch;
use super::sight::{Sight, UNCHANGED_DISTANCE, distance};
use super::state::{Observation, State};
use super::tracker::Tracker;
use super::{MapQuery, PoseWithCovariance, ROOM_RATIO, RecentMatches};
use seese3_core::geometry::Pose;

/// What another camera on the same robot saw at the time of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct OtherView {
    /// Which camera it is: always the same number for the same one.
    pub camera: u32,
    /// Its pose in the frame of the stream's own camera, metres.
    pub camera_from_other: Pose,
    /// Its latent under the tracker's adapter, shape (k,).
    pub latent: Array1<f64>,
    /// The raw feature of that latent, shape (d,), if it is known.
    pub feature: Option<Vec<f32>>,
    /// Whether the image is known to show nothing.
    pub is_blank: bool,
}

/// What a stream remembers of another camera.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct OtherCamera {
    /// Which one.
    pub camera: u32,
    /// The latent of its last view that was not blank, in standard deviations of frame noise.
    pub last: Vec<f64>,
    /// Views in a row that showed exactly what the one before did.
    pub unchanged_frames: u32,
}

/// A view, and the map that it matches best.
pub(super) struct MatchedView<'a> {
    /// The other camera that it is of; none for the stream's own.
    pub other: Option<&'a OtherView>,
    /// Its raw feature, if it is known.
    pub feature: Option<&'a [f32]>,
    pub sight: Sight,
    /// Whether it shows exactly what its camera's view before did, and so tells nothing new.
    pub is_repeated: bool,
    /// An index of [`Tracker::maps`].
    pub room: usize,
    /// Whether no other map matches nearly as well.
    pub is_clear: bool,
    pub matched: MapMatch,
}

impl MatchedView<'_> {
    /// Whether it looks like the room.
    pub(super) fn matches_room(&self) -> bool {
        self.sight == Sight::Clear && self.matched.out_of_distribution <= 1.0
    }

    /// Where the mapped frames that it resembles place the stream's own camera.
    pub(super) fn placed(&self) -> PoseWithCovariance {
        let belief = self.matched.anchor.belief;
        match self.other {
            Some(other) => belief.of_attached(&other.camera_from_other.inverse()),
            None => belief,
        }
    }

    /// How little it resembles the room, for the choice of the view that leads: one that shows
    /// nothing, nothing new, or what several rooms show as well, leads only if all do.
    fn strangeness(&self) -> f64 {
        if self.sight == Sight::Clear && !self.is_repeated && self.is_clear {
            self.matched.out_of_distribution
        } else {
            f64::INFINITY
        }
    }
}

/// What all cameras see at one time.
pub(super) struct RigMatches<'a> {
    /// The view that looks most like a room: the stream's own, if none looks more like it.
    pub leading: MatchedView<'a>,
    /// Whether the stream's own view looks like a room.
    pub own_matches_room: bool,
    /// Whether another camera's view certainly shows the room.
    pub is_seen_by_other: bool,
    /// The others that may correct what is believed: those that show something.
    pub beside: Vec<MatchedView<'a>>,
}

impl Tracker {
    /// Matches all views of a frame. The stream's own has been recorded before; those of other cameras
    /// are recorded here.
    pub(super) fn look<'a>(&self, state: &mut State, frame: &'a Observation) -> RigMatches<'a> {
        let own = View {
            latent: frame.latent.view(),
            feature: frame.feature.as_deref(),
            is_blank: frame.is_blank,
            unchanged_frames: state.unchanged_frames,
        };
        let mut leading = self.matched(state.room, &own, None);
        if leading.sight == Sight::Clear {
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

    /// Records another camera's view; how many views in a row have been identical to it.
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

    /// How a view matches the believed room or, if no room is believed yet, the one of all maps that
    /// it matches best.
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
            matched,
        }
    }
}

/// What one camera sees.
struct View<'a> {
    latent: ArrayView1<'a, f64>,
    feature: Option<&'a [f32]>,
    is_blank: bool,
    unchanged_frames: u32,
}

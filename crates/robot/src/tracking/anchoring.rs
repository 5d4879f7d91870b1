//! Correction: the mapped frame that looks like the view, taken as an anchor of the map pose.

use nalgebra::Matrix6;

use super::dead_reckoning::{EarlierView, Poses};
use super::gravity::CountedGravity;
use super::health::TrackingHealth;
use super::rig::{MatchedView, RigMatches};
use super::sight::Sight;
use super::state::{Candidate, Observation, State};
use super::tracker::Tracker;
use super::{MapAnchor, PoseVelocity, PoseWithCovariance};
use seese3_core::geometry::Twist;

/// 99 % of χ² with six degrees of freedom: an anchor whose surprise is larger counts for less.
const GATE: f64 = 16.81;
/// An anchor whose surprise is larger than this many times the gate is refused.
const REFUSED_BEYOND: f64 = 4.0;
/// Anchors in a row that must agree on a place before it replaces another one, or is believed where
/// none was.
pub const ANCHORS_TO_AGREE: u32 = 10;
/// Anchors are taken to be as far apart in time at most, seconds: after a pause the next one is as
/// good as an independent one.
const LONGEST_PAUSE_S: f64 = 10.0;

/// An anchor as it counts beside those before it.
#[derive(Debug, Clone, Copy)]
struct InflatedAnchor {
    /// Its covariance is multiplied for the likeness of its error to those of anchors before it.
    belief: PoseWithCovariance,
    /// The covariance of its error, if that lasts; else zero.
    lasting: Matrix6<f64>,
}

impl InflatedAnchor {
    /// The anchor as one of several of one time, which together tell as much as one.
    fn shared_by(self, count: usize) -> Self {
        Self {
            belief: PoseWithCovariance {
                covariance: self.belief.covariance * count as f64,
                ..self.belief
            },
            ..self
        }
    }
}

/// What an anchor did to the map pose.
pub(super) struct Correction {
    /// Whether the anchor was applied.
    pub is_applied: bool,
    /// The squared Mahalanobis distance of the anchor from the believed pose, if there was one.
    pub surprise: Option<f64>,
}

impl Correction {
    /// No anchor was tried.
    pub(super) const NONE: Self = Self {
        is_applied: false,
        surprise: None,
    };
}

/// Corrects the map pose by an anchor that is within the gate of it; else nothing changes.
fn correct_believed(
    state: &mut State,
    poses: &mut Poses,
    frame: &Observation,
    room: usize,
    counted: InflatedAnchor,
) -> Correction {
    let anchor = counted.belief;
    let Some(believed) = poses.map_pose.filter(|_| state.room == Some(room)) else {
        return Correction::NONE;
    };
    let surprise = surprise_at(&believed.place(), &anchor);
    if surprise > REFUSED_BEYOND * GATE {
        return Correction {
            is_applied: false,
            surprise: Some(surprise),
        };
    }

    // Motions and errors have heavier tails than a Gaussian: a surprising anchor is believed less,
    // but believed.
    let doubted = PoseWithCovariance {
        covariance: anchor.covariance * (surprise / GATE).max(1.0).powi(2),
        ..anchor
    };
    poses.map_pose = Some(believed.corrected(&doubted));
    poses.lasting = counted.lasting;
    state.corrected_ns = Some(frame.time_ns);
    Correction {
        is_applied: true,
        surprise: Some(surprise),
    }
}

/// The squared Mahalanobis distance of an anchor from a believed pose.
fn surprise_at(believed: &PoseWithCovariance, anchor: &PoseWithCovariance) -> f64 {
    believed
        .innovation(anchor)
        .map_or(f64::INFINITY, |innovation| innovation.squared_length)
}

impl MatchedView<'_> {
    /// Whether the view is tried as an anchor at all.
    fn may_correct(&self, health: TrackingHealth) -> bool {
        if self.matches_room() {
            self.is_clear
        } else {
            self.is_hint(health)
        }
    }

    /// Whether the view is tried as an anchor although it does not look like the room: images that
    /// are blurred, noisy or partly hidden do not, and their features still tell where they were
    /// taken. Only where the camera is known to be in the room, and only if the features tell more
    /// than a view of an unmapped part does. The limit was chosen on calibration rooms and the
    /// kitchen: at three times [`PoseWithCovariance::tells_a_place`] unmapped parts make poses worse.
    fn is_hint(&self, health: TrackingHealth) -> bool {
        health.is_confirmed()
            && self.matched.is_by_feature
            && self.matched.anchor.belief.hints_at_a_place()
    }
}

impl Tracker {
    /// Corrects the map pose by what all cameras see: first by the view that leads, which may find the
    /// camera at another place, then by the others, which may not, and cannot object.
    pub(super) fn correct_by_views(
        &self,
        state: &mut State,
        poses: &mut Poses,
        frame: &Observation,
        seen: &RigMatches<'_>,
        gravity: Option<&CountedGravity>,
    ) -> Correction {
        let leading = &seen.leading;
        let beside = |view: &&MatchedView<'_>| {
            self.settings.fuse && view.room == leading.room && view.may_correct(state.health)
        };
        let others: Vec<&MatchedView<'_>> = seen.beside.iter().filter(beside).collect();

        // Cameras on one robot see the same part of the map, or of what is not mapped: several count
        // as much as one.
        let of_others = others.iter().map(|view| {
            let anchor = self.anchor(state, frame, view, gravity);
            anchor.shared_by(1 + others.len())
        });
        let of_others: Vec<InflatedAnchor> = of_others.collect();

        // An image that is repeated tells nothing new.
        let correction = if leading.is_repeated || leading.sight != Sight::Clear {
            Correction::NONE
        } else {
            let anchor = self.anchor(state, frame, leading, gravity);
            let anchor = anchor.shared_by(1 + of_others.len());
            self.correct_by_leading(state, poses, frame, leading, anchor)
        };

        let mut is_corrected = correction.is_applied;
        for anchor in of_others {
            let lasting = poses.lasting;
            let applied = correct_believed(state, poses, frame, leading.room, anchor).is_applied;

            // Of the anchors of one frame, the lasting error is that of the best.
            if applied && is_corrected && lasting.trace() < poses.lasting.trace() {
                poses.lasting = lasting;
            }
            is_corrected |= applied;
        }

        correction
    }

    /// Tries the match of the view that leads as an anchor: one that looks clearly like one map may
    /// speak for another place than the believed one; a hint may not, see
    /// [`MatchedView::is_hint`].
    fn correct_by_leading(
        &self,
        state: &mut State,
        poses: &mut Poses,
        frame: &Observation,
        view: &MatchedView<'_>,
        anchor: InflatedAnchor,
    ) -> Correction {
        if !self.settings.fuse || !view.may_correct(state.health) {
            return Correction::NONE;
        }

        if view.matches_room() {
            self.correct(state, poses, frame, view.room, anchor)
        } else {
            correct_believed(state, poses, frame, view.room, anchor)
        }
    }

    /// The pose of the stream's camera by a view: by the reader of its room if there is one and the
    /// view certainly shows the room, else by the frames that it matches: beyond the mapped part a
    /// reader is surer than it should be. Its covariance is that with which it counts beside the
    /// anchors before it.
    fn anchor(
        &self,
        state: &State,
        frame: &Observation,
        view: &MatchedView<'_>,
        gravity: Option<&CountedGravity>,
    ) -> InflatedAnchor {
        let MapAnchor {
            belief,
            memory_s,
            lasting_share,
        } = view.matched.anchor;
        let feature = view.feature.filter(|_| view.matched.is_certain);
        let by_reader = self.maps[view.room].pose_by_reader(feature);
        let mut belief = by_reader.unwrap_or_else(|| match &state.recent_matches {
            Some(recent) if view.other.is_none() => recent.tempered(belief),
            _ => belief,
        });

        if let Some(other) = view.other {
            belief = belief.of_attached(&other.camera_from_other.inverse());
        }
        if let Some(gravity) = gravity {
            belief = belief.levelled(gravity);
        }

        // Anchors whose errors are alike tell less than independent ones: a row of them with the
        // correlation ρ from one to the next tells as much as independent ones of (1 + ρ)/(1 − ρ)
        // times the covariance.
        let pause = state.corrected_ns.map_or(LONGEST_PAUSE_S, |before| {
            (frame.time_ns.abs_diff(before) as f64 * 1e-9).min(LONGEST_PAUSE_S)
        });
        let inflation = if memory_s > 0.0 {
            let correlation = (-pause / memory_s).exp();
            (1.0 + correlation) / (1.0 - correlation)
        } else {
            1.0
        };

        InflatedAnchor {
            belief: PoseWithCovariance {
                covariance: belief.covariance * inflation,
                ..belief
            },
            lasting: belief.covariance * lasting_share,
        }
    }

    /// Corrects the map pose by an anchor. An anchor within the gate of the believed pose is
    /// applied at once. Any other one, and each one where nothing is believed, becomes a candidate,
    /// which is applied once several anchors in a row agree.
    fn correct(
        &self,
        state: &mut State,
        poses: &mut Poses,
        frame: &Observation,
        room: usize,
        counted: InflatedAnchor,
    ) -> Correction {
        let anchor = counted.belief;

        // While a stream is lost no place is a candidate. Frames that miss the room or match
        // several rooms do not come here, so that anchors "in a row" may have such frames between
        // them.
        let earlier_candidate = state.candidate.take();
        if state.health.is_lost() {
            return Correction::NONE;
        }

        let within_gate = correct_believed(state, poses, frame, room, counted);
        if within_gate.is_applied {
            return within_gate;
        }

        // The earlier candidate was seen some frames ago: carry it to this frame, then compare.
        let carried = earlier_candidate
            .filter(|candidate| candidate.room == room)
            .map(|candidate| self.carried_candidate(state, candidate, frame));
        let (map_pose, agreeing_anchors) = match carried {
            Some((map_pose, agreeing)) if surprise_at(&map_pose, &anchor) <= GATE => {
                (map_pose.corrected(&anchor), agreeing + 1)
            }
            _ => (anchor, 1),
        };

        let is_applied = agreeing_anchors >= ANCHORS_TO_AGREE;
        if is_applied {
            state.room = Some(room);
            state.corrected_ns = Some(frame.time_ns);
            let prior = self.maps[room].motion_prior();
            poses.map_pose = Some(PoseVelocity::at(map_pose, prior));
            poses.lasting = counted.lasting;
        } else {
            let sight = Sight::of(frame.is_blank, state.unchanged_frames);
            state.candidate = Some(Candidate {
                room,
                time_ns: frame.time_ns,
                sequence: frame.sequence,
                latent: (sight == Sight::Clear).then(|| frame.latent.to_vec()),
                map_pose,
                agreeing_anchors,
            });
        }

        Correction {
            is_applied,
            ..within_gate
        }
    }

    /// Where a candidate's camera would be at this frame, and how many anchors agreed on it.
    fn carried_candidate(
        &self,
        state: &State,
        candidate: Candidate,
        frame: &Observation,
    ) -> (PoseWithCovariance, u32) {
        // Where another camera speaks for the place, the stream's own may see no motion.
        let sight = Sight::of(frame.is_blank, state.unchanged_frames);
        let seen = candidate.latent.filter(|_| sight == Sight::Clear);
        let (motion, covariance) = match &seen {
            Some(latent) => {
                let from = EarlierView {
                    latent,
                    time_ns: candidate.time_ns,
                };
                self.motion_between(Some(candidate.room), from, frame)
            }
            None => (Twist::default(), self.error_model.unread_errors()),
        };

        let map_pose = candidate.map_pose.moved(motion, &covariance);
        (map_pose, candidate.agreeing_anchors)
    }
}

//! Correction: the mapped frame that looks like the view, taken as an anchor of the map pose.

use super::Belief;
use super::dead_reckoning::{EarlierView, Poses};
use super::map::MapMatch;
use super::state::{Candidate, Observation, State};
use super::tracker::Tracker;

/// 99 % of χ² with six degrees of freedom: an anchor whose surprise is larger is refused.
const GATE: f64 = 16.81;
/// Successive anchors err alike: each one's covariance is multiplied by this.
const ANCHOR_INFLATION: f64 = 2.0;
/// Accepted frames from one anchor to the next: those in between err alike and tell nothing new.
const ANCHOR_EVERY: u32 = 3;
/// Anchors in a row that must agree on a place before it replaces another one, or is believed where
/// none was.
pub const ANCHORS_TO_AGREE: u32 = 4;

/// The map that a view matches best.
pub(super) struct BestMap {
    /// An index of [`Tracker::maps`].
    pub room: usize,
    /// Whether no other map matches nearly as well.
    pub is_clear: bool,
    pub matched: MapMatch,
}

/// A pose that a view was read to have, to correct the map pose by.
#[derive(Debug, Clone, Copy)]
pub(super) struct Anchor {
    pub belief: Belief,
    /// The covariance of a map pose that was corrected by it, over its own.
    pub reported_factor: f64,
}

/// What an anchor did to the map pose.
pub(super) struct Correction {
    /// The anchor, if it was applied.
    pub applied: Option<Anchor>,
    /// The squared Mahalanobis distance of the anchor from the believed pose, if there was one.
    pub surprise: Option<f64>,
}

impl Correction {
    /// No anchor was tried.
    const NONE: Self = Self {
        applied: None,
        surprise: None,
    };
}

impl Tracker {
    /// Tries the best match as an anchor, if one is due and the view clearly matches one map.
    pub(super) fn correct_when_due(
        &self,
        state: &mut State,
        poses: &mut Poses,
        frame: &Observation,
        view: &BestMap,
    ) -> Correction {
        state.frames_since_anchor = state.frames_since_anchor.saturating_add(1);
        let is_due = state.frames_since_anchor >= ANCHOR_EVERY || state.keyframe.is_none();
        let matches_room = view.matched.out_of_distribution <= 1.0;

        if !(self.settings.fuse && matches_room && is_due) {
            return Correction::NONE;
        }

        state.frames_since_anchor = 0;
        if view.is_clear {
            let anchor = self.anchor(frame, view);
            self.correct(state, poses, frame, view.room, anchor)
        } else {
            Correction::NONE
        }
    }

    /// The pose of a view by the reader of its room if there is one and the view certainly shows the
    /// room, else by the frame that it matches: beyond the mapped part a reader is surer than it
    /// should be.
    fn anchor(&self, frame: &Observation, view: &BestMap) -> Anchor {
        let feature = frame.feature.as_deref().filter(|_| view.matched.is_certain);
        match self.maps[view.room].pose_by_reader(feature) {
            // Its covariance was measured on the errors of single views of this room.
            Some(belief) => Anchor {
                belief,
                reported_factor: 1.0,
            },
            None => Anchor {
                belief: view.matched.anchor,
                reported_factor: self.map_pose_factor,
            },
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
        given: Anchor,
    ) -> Correction {
        // While a stream is lost no place is a candidate. Frames that miss the room or match
        // several rooms do not come here, so that anchors "in a row" may have such frames between
        // them.
        let earlier_candidate = state.candidate.take();
        if state.health.is_lost() {
            return Correction::NONE;
        }

        // The filter takes the inflated covariance; what is reported is measured with the plain
        // one.
        let anchor = Belief {
            pose: given.belief.pose,
            covariance: given.belief.covariance * ANCHOR_INFLATION,
        };
        let surprise_at = |belief: &Belief| {
            belief
                .innovation(&anchor)
                .map_or(f64::INFINITY, |innovation| innovation.squared_length)
        };

        let believed = poses.map_pose.filter(|_| state.room == Some(room));
        let surprise = believed.as_ref().map(surprise_at);
        if let (Some(believed), Some(surprise)) = (believed, surprise)
            && surprise <= GATE
        {
            poses.map_pose = Some(believed.corrected(&anchor));
            return Correction {
                applied: Some(given),
                surprise: Some(surprise),
            };
        }

        // The earlier candidate was seen some frames ago: carry it to this frame, then compare.
        let carried = earlier_candidate
            .filter(|candidate| candidate.room == room)
            .map(|candidate| self.carried_candidate(candidate, frame));
        let (map_pose, agreeing_anchors) = match carried {
            Some((map_pose, agreeing)) if surprise_at(&map_pose) <= GATE => {
                (map_pose.corrected(&anchor), agreeing + 1)
            }
            _ => (anchor, 1),
        };

        let is_applied = agreeing_anchors >= ANCHORS_TO_AGREE;
        if is_applied {
            state.room = Some(room);
            poses.map_pose = Some(map_pose);
        } else {
            state.candidate = Some(Candidate {
                room,
                sequence: frame.sequence,
                latent: frame.latent.to_vec(),
                map_pose,
                agreeing_anchors,
            });
        }

        Correction {
            applied: is_applied.then_some(given),
            surprise,
        }
    }

    /// Where a candidate's camera would be at this frame, and how many anchors agreed on it.
    fn carried_candidate(&self, candidate: Candidate, frame: &Observation) -> (Belief, u32) {
        let from = EarlierView {
            latent: &candidate.latent,
            sequence: candidate.sequence,
        };
        let (motion, covariance) = self.motion_between(Some(candidate.room), from, frame);

        let map_pose = candidate.map_pose.moved(motion, &covariance);
        (map_pose, candidate.agreeing_anchors)
    }

    /// A corrected map pose as it is reported: with the covariance of the anchor that corrected it,
    /// times its factor. The filter would combine many anchors into one very sure pose, but anchors
    /// on the same part of a path err alike.
    pub(super) fn reported(map_pose: Belief, anchor: &Anchor) -> Belief {
        Belief {
            covariance: anchor.belief.covariance * anchor.reported_factor,
            ..map_pose
        }
    }
}

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

/// What an anchor did to the map pose.
pub(super) struct Correction {
    pub is_applied: bool,
    /// The squared Mahalanobis distance of the anchor from the believed pose, if there was one.
    pub surprise: Option<f64>,
}

impl Correction {
    /// No anchor was tried.
    const NONE: Self = Self {
        is_applied: false,
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
            self.correct(state, poses, frame, view)
        } else {
            Correction::NONE
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
        view: &BestMap,
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
            pose: view.matched.anchor.pose,
            covariance: view.matched.anchor.covariance * ANCHOR_INFLATION,
        };
        let surprise_at = |belief: &Belief| {
            belief
                .innovation(&anchor)
                .map_or(f64::INFINITY, |innovation| innovation.squared_length)
        };

        let believed = poses.map_pose.filter(|_| state.room == Some(view.room));
        let surprise = believed.as_ref().map(surprise_at);
        if let (Some(believed), Some(surprise)) = (believed, surprise)
            && surprise <= GATE
        {
            poses.map_pose = Some(believed.corrected(&anchor));
            return Correction {
                is_applied: true,
                surprise: Some(surprise),
            };
        }

        // The earlier candidate was seen some frames ago: carry it to this frame, then compare.
        let carried = earlier_candidate
            .filter(|candidate| candidate.room == view.room)
            .map(|candidate| self.carried_candidate(candidate, frame));
        let (map_pose, agreeing_anchors) = match carried {
            Some((map_pose, agreeing)) if surprise_at(&map_pose) <= GATE => {
                (map_pose.corrected(&anchor), agreeing + 1)
            }
            _ => (anchor, 1),
        };

        let is_applied = agreeing_anchors >= ANCHORS_TO_AGREE;
        if is_applied {
            state.room = Some(view.room);
            poses.map_pose = Some(map_pose);
        } else {
            state.candidate = Some(Candidate {
                room: view.room,
                sequence: frame.sequence,
                latent: frame.latent.to_vec(),
                map_pose,
                agreeing_anchors,
            });
        }

        Correction {
            is_applied,
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
    /// times the factor that calibration found. The filter would combine many anchors into one very
    /// sure pose, but anchors on the same part of a path err alike.
    pub(super) fn reported(&self, map_pose: Belief, anchor: &Belief) -> Belief {
        Belief {
            covariance: anchor.covariance * self.map_pose_factor,
            ..map_pose
        }
    }
}

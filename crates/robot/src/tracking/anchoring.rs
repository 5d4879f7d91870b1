//! Correction of the map pose by anchors: poses estimated from matching mapped frames.

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

/// Gate: 99 % quantile of χ² with six degrees of freedom. Above it, an anchor is downweighted.
const GATE: f64 = 16.81;
/// Rejection threshold for the surprise of an anchor, as a multiple of [`GATE`].
const REFUSED_BEYOND: f64 = 4.0;
/// Number of consecutive anchors that must agree before their pose becomes the map pose.
pub const ANCHORS_TO_AGREE: u32 = 10;
/// The same for poses from matched keypoints.
const MATCHED_VIEWS_TO_AGREE: u32 = 2;
/// Upper bound of the time between two anchors, seconds: after such a pause they are independent.
const LONGEST_PAUSE_S: f64 = 10.0;

/// An anchor with its covariance inflated for time correlation.
#[derive(Debug, Clone, Copy)]
struct InflatedAnchor {
    /// Pose with the inflated covariance.
    belief: PoseWithCovariance,
    /// Covariance of the time-correlated part of the error; zero if uncorrelated.
    lasting: Matrix6<f64>,
}

impl InflatedAnchor {
    /// Multiplies the covariance by `count`: simultaneous anchors together count as one.
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

/// Result of a correction.
pub(super) struct Correction {
    /// Whether the anchor was applied.
    pub is_applied: bool,
    /// Squared Mahalanobis distance of the anchor from the believed pose, if both exist.
    pub surprise: Option<f64>,
}

impl Correction {
    /// No anchor was tried.
    pub(super) const NONE: Self = Self {
        is_applied: false,
        surprise: None,
    };
}

/// Corrects the believed map pose by an anchor. Nothing changes if there is no believed pose in the
/// room, or the surprise is above the rejection threshold.
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

    // Errors have heavier tails than a Gaussian: downweight an anchor above the gate.
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

/// Squared Mahalanobis distance of an anchor from a believed pose.
fn surprise_at(believed: &PoseWithCovariance, anchor: &PoseWithCovariance) -> f64 {
    believed
        .innovation(anchor)
        .map_or(f64::INFINITY, |innovation| innovation.squared_length)
}

impl MatchedView<'_> {
    /// Number of anchors like this one that must agree on a place.
    pub(super) fn anchors_needed(&self) -> u32 {
        if self.is_proven {
            MATCHED_VIEWS_TO_AGREE
        } else {
            ANCHORS_TO_AGREE
        }
    }

    /// Whether the view may serve as an anchor.
    fn may_correct(&self, health: TrackingHealth) -> bool {
        if self.matches_room() {
            self.is_clear
        } else {
            self.is_hint(health)
        }
    }

    /// Whether an out-of-distribution view may still serve as an anchor, because its feature gives
    /// a usable pose. This covers blurred, noisy or partly occluded images.
    ///
    /// It requires confirmed health and an anchor uncertainty that views of unmapped parts exceed.
    /// The limit, twice that of [`PoseWithCovariance::tells_a_place`], was chosen on calibration
    /// rooms and the kitchen. At three times, unmapped parts make poses worse.
    fn is_hint(&self, health: TrackingHealth) -> bool {
        health.is_confirmed()
            && self.matched.is_by_feature
            && self.matched.anchor.belief.hints_at_a_place()
    }
}

impl Tracker {
    /// Corrects the map pose by the views of all cameras. The leading view comes first and may
    /// start or confirm a candidate. The other views can only correct the believed pose.
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

        // Simultaneous views of one robot have correlated errors: together they count as one.
        let of_others = others.iter().map(|view| {
            let anchor = self.anchor(state, frame, view, gravity);
            anchor.shared_by(1 + others.len())
        });
        let of_others: Vec<InflatedAnchor> = of_others.collect();

        // A repeated image has no new information.
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

            // Of the anchors of one frame, keep the smallest correlated error.
            if applied && is_corrected && lasting.trace() < poses.lasting.trace() {
                poses.lasting = lasting;
            }
            is_corrected |= applied;
        }

        correction
    }

    /// Tries the leading match as an anchor. A match in distribution may start a candidate at
    /// another place; a hint, see [`MatchedView::is_hint`], may only correct the believed pose.
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
            let needed = view.anchors_needed();
            self.correct(state, poses, frame, (view.room, needed), anchor)
        } else {
            correct_believed(state, poses, frame, view.room, anchor)
        }
    }

    /// Anchor of the stream's camera from a view, with a covariance inflated for time correlation.
    ///
    /// Matched keypoints give the pose, if there are any. Otherwise it comes from the room's
    /// [`super::PoseReader`] if there is one and the match is
    /// certain; otherwise from the matched frames. Outside the mapped part a reader is
    /// overconfident.
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
        let mut belief = if view.is_proven {
            belief
        } else {
            let feature = view.feature.filter(|_| view.matched.is_certain);
            let by_reader = self.maps[view.room].pose_by_reader(feature);
            by_reader.unwrap_or_else(|| match &state.recent_matches {
                Some(recent) if view.other.is_none() => recent.tempered(belief),
                _ => belief,
            })
        };

        if let Some(other) = view.other {
            belief = belief.of_attached(&other.camera_from_other.inverse());
        }
        if let Some(gravity) = gravity {
            belief = belief.levelled(gravity);
        }

        // Anchors with correlated errors have less information. With the correlation ρ between
        // successive anchors, the covariance is inflated by (1 + ρ)/(1 − ρ).
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

    /// Corrects the map pose by an anchor. An anchor below the rejection threshold is applied at
    /// once. Otherwise, or without a believed pose, the anchor supports a candidate. The candidate
    /// is applied once `needed` consecutive anchors agree.
    fn correct(
        &self,
        state: &mut State,
        poses: &mut Poses,
        frame: &Observation,
        (room, needed): (usize, u32),
        counted: InflatedAnchor,
    ) -> Correction {
        let anchor = counted.belief;

        // A lost stream has no candidate. Frames that match no room, or several, are not passed to
        // this function, so they do not interrupt a series of anchors.
        let earlier_candidate = state.candidate.take();
        if state.health.is_lost() {
            return Correction::NONE;
        }

        let within_gate = correct_believed(state, poses, frame, room, counted);
        if within_gate.is_applied {
            return within_gate;
        }

        // Predict the earlier candidate at this frame, then compare.
        let carried = earlier_candidate
            .filter(|candidate| candidate.room == room)
            .map(|candidate| self.carried_candidate(state, candidate, frame));
        let (map_pose, agreeing_anchors) = match carried {
            Some((map_pose, agreeing)) if surprise_at(&map_pose, &anchor) <= GATE => {
                (map_pose.corrected(&anchor), agreeing + 1)
            }
            _ => (anchor, 1),
        };

        let is_applied = agreeing_anchors >= needed;
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

    /// Predicts a candidate's pose at this frame; returns it with the number of agreeing anchors.
    fn carried_candidate(
        &self,
        state: &State,
        candidate: Candidate,
        frame: &Observation,
    ) -> (PoseWithCovariance, u32) {
        // If the candidate came from another camera, this camera may be frozen or covered.
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

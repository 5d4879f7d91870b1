//! Tracking health: whether a stream's frames are continuous and match the room. It distinguishes a
//! lost camera from one that explores an unmapped part of the room.
//!
//! A frame far from every mapped frame has two explanations. If the stream was confirmed in the
//! room and each view is continuous with the previous one, the camera has left the mapped part. If
//! the stream was never confirmed, or the view jumped, the camera is lost.

/// Number of consecutive certain matches after which a lost stream is consistent again.
pub const FRAMES_TO_RECOVER: u32 = 5;
/// Score at which a stream is confirmed in the room: a match adds 1, a mismatch subtracts
/// [`MISMATCH_COST`].
const CONFIRMED_SCORE: i32 = 20;
/// Amount that a mismatch subtracts from the score of an unconfirmed stream.
const MISMATCH_COST: i32 = 2;

/// Health of a stream, updated with every frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum TrackingHealth {
    /// No frame was observed yet.
    #[default]
    NotStarted,
    /// The frames are continuous, back to one that matched the room or had a given pose.
    Consistent {
        /// Number of matches minus twice the number of mismatches; frozen once the stream is
        /// confirmed.
        score: i32,
        /// Whether the stream is certainly in this room. Frames that do not match then show
        /// unmapped parts of the room.
        confirmed: bool,
    },
    /// The frames do not match the room, or are not continuous.
    Lost {
        /// Number of consecutive certain matches so far.
        certain_matches: u32,
    },
}

/// Evidence of one frame about the health of its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameEvidence {
    /// Whether the frame matches the room: it is within the out-of-distribution limit.
    pub matches_room: bool,
    /// Whether the match is certain: hardly any frame of another room is that near.
    pub matches_certainly: bool,
    /// Whether matched keypoints prove the place.
    pub is_proven: bool,
    /// Continuity with the previous frames.
    pub continuity: Continuity,
}

/// Continuity of a frame with the previous frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Continuity {
    /// The view changed no more than the view of a moving camera can.
    Continuous,
    /// A jump could not be detected: [`JUMP_WINDOW`](seese3_core::adapter::JUMP_WINDOW) or more
    /// frames were dropped, or the pause, or the time without a new image, was too long.
    Gap,
    /// The view changed more than the view of a moving camera can.
    Jump,
}

impl TrackingHealth {
    /// Health of a stream with a given pose: it is in the room by assumption.
    pub fn confirmed() -> Self {
        Self::Consistent {
            score: CONFIRMED_SCORE,
            confirmed: true,
        }
    }

    /// The health after one more frame.
    #[must_use]
    pub fn after(self, evidence: FrameEvidence) -> Self {
        match self {
            _ if evidence.is_proven => Self::confirmed(),
            Self::NotStarted if evidence.matches_room => Self::ONE_MATCH,
            Self::NotStarted => Self::NEWLY_LOST,
            Self::Consistent { score, confirmed } => {
                Self::after_consistent(score, confirmed, evidence)
            }
            Self::Lost { certain_matches } => Self::after_lost(certain_matches, evidence),
        }
    }

    /// Whether the frames do not match the room or are not continuous. A
    /// [`Status`](super::Status) can also be LOST because the position is too uncertain.
    pub fn is_lost(self) -> bool {
        matches!(self, Self::Lost { .. })
    }

    /// Whether the stream was confirmed in the room and has had no gap or jump since.
    pub fn is_confirmed(self) -> bool {
        matches!(
            self,
            Self::Consistent {
                confirmed: true,
                ..
            }
        )
    }

    /// One match, with no usable frames before it.
    const ONE_MATCH: Self = Self::Consistent {
        score: 1,
        confirmed: false,
    };

    const NEWLY_LOST: Self = Self::Lost { certain_matches: 0 };

    fn after_consistent(score: i32, confirmed: bool, evidence: FrameEvidence) -> Self {
        match evidence.continuity {
            Continuity::Jump => return Self::NEWLY_LOST,
            // The gap may hide a jump, so this frame must match the room again.
            Continuity::Gap if evidence.matches_room => return Self::ONE_MATCH,
            Continuity::Gap => return Self::NEWLY_LOST,
            Continuity::Continuous => {}
        }

        if confirmed {
            return Self::Consistent { score, confirmed };
        }

        let score = if evidence.matches_room {
            score + 1
        } else {
            score - MISMATCH_COST
        };
        if score < 0 {
            return Self::NEWLY_LOST;
        }

        Self::Consistent {
            score,
            confirmed: score >= CONFIRMED_SCORE,
        }
    }

    fn after_lost(certain_matches: u32, evidence: FrameEvidence) -> Self {
        if evidence.continuity == Continuity::Jump || !evidence.matches_certainly {
            return Self::NEWLY_LOST;
        }

        if certain_matches + 1 >= FRAMES_TO_RECOVER {
            return Self::Consistent {
                score: 0,
                confirmed: false,
            };
        }

        Self::Lost {
            certain_matches: certain_matches + 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of a continuous stream that matches the room with certainty.
    const MATCH: FrameEvidence = FrameEvidence {
        matches_room: true,
        matches_certainly: true,
        is_proven: false,
        continuity: Continuity::Continuous,
    };
    const MISMATCH: FrameEvidence = FrameEvidence {
        matches_room: false,
        matches_certainly: false,
        is_proven: false,
        continuity: Continuity::Continuous,
    };
    const JUMP: FrameEvidence = FrameEvidence {
        continuity: Continuity::Jump,
        ..MISMATCH
    };

    /// After each frame, whether the stream is lost.
    fn lost_after_each(start: TrackingHealth, frames: &[FrameEvidence]) -> Vec<bool> {
        let mut health = start;
        frames
            .iter()
            .map(|&evidence| {
                health = health.after(evidence);
                health.is_lost()
            })
            .collect()
    }

    /// Oracle: the rules by hand.
    #[test]
    fn a_known_camera_may_explore_but_not_jump() {
        let confirmed = TrackingHealth::confirmed();
        assert_eq!(lost_after_each(confirmed, &[MISMATCH; 50]), [false; 50]);
        assert_eq!(
            lost_after_each(confirmed, &[MATCH, JUMP, MISMATCH]),
            [false, true, true]
        );
    }

    /// Oracle: the rules by hand.
    #[test]
    fn an_unknown_camera_has_to_match_the_room() {
        let fresh = TrackingHealth::NotStarted;
        assert_eq!(lost_after_each(fresh, &[MISMATCH; 3]), [true; 3]);

        // One match makes the stream consistent but unconfirmed; the next mismatch makes it lost.
        assert_eq!(
            lost_after_each(fresh, &[MATCH, MISMATCH, MATCH]),
            [false, true, true]
        );

        // Five consecutive certain matches make the stream consistent.
        let frames = [&[MISMATCH][..], &[MATCH; 6]].concat();
        assert_eq!(
            lost_after_each(fresh, &frames),
            [true, true, true, true, true, false, false]
        );

        // Twenty matches confirm the stream, which may then leave the mapped part.
        let frames = [&[MATCH; 20][..], &[MISMATCH; 9]].concat();
        assert!(lost_after_each(fresh, &frames).iter().all(|lost| !lost));
    }

    /// Oracle: the rules by hand: after a gap even a confirmed stream must match the room again.
    #[test]
    fn a_gap_ends_confirmation() {
        let gap = |evidence: FrameEvidence| {
            TrackingHealth::confirmed().after(FrameEvidence {
                continuity: Continuity::Gap,
                ..evidence
            })
        };

        assert!(gap(MISMATCH).is_lost());
        assert_eq!(
            gap(MATCH),
            TrackingHealth::Consistent {
                score: 1,
                confirmed: false
            }
        );
    }
}

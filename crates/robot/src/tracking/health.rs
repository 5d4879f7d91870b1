//! Tracking health: whether a stream's frames follow from one another and match the room. It tells
//! a camera that is lost from one that explores a part of the room that is not mapped.
//!
//! A frame far from every mapped frame can mean two things. If the stream was confirmed to be in
//! the room, and each view follows from the one before, the camera has only left the mapped part.
//! If the stream was never confirmed, or the view jumped, nobody knows where the camera is.

/// Frames in a row that must match the room with certainty before a lost stream's health is
/// consistent again.
pub const FRAMES_TO_RECOVER: u32 = 5;
/// The score at which a stream is confirmed to be in the room: each matching frame adds one, each
/// other frame takes away [`MISMATCH_COST`].
const CONFIRMED_SCORE: i32 = 20;
/// What a frame that does not match the room takes away from the score of an unconfirmed stream.
const MISMATCH_COST: i32 = 2;

/// What the frames of a stream say so far about whether its place in the room can be known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum TrackingHealth {
    /// No frame was observed yet.
    #[default]
    NotStarted,
    /// Each frame follows from the one before, back to one that matched the room or whose pose was
    /// given.
    Consistent {
        /// Matching frames, less two for each other one; not counted on once the stream is
        /// confirmed.
        score: i32,
        /// Whether the stream is certainly in this room, so that frames unlike the map show parts
        /// of the room that are not mapped.
        confirmed: bool,
    },
    /// The frames do not match the room, or do not follow from one another.
    Lost {
        /// Frames in a row, up to now, that match the room with certainty.
        certain_matches: u32,
    },
}

/// What one frame says about the health of its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameEvidence {
    /// Whether the frame is near enough to the map to be of this room.
    pub matches_room: bool,
    /// Whether the frame is so near that hardly any frame of another room would be.
    pub matches_certainly: bool,
    /// How the frame follows from those before it.
    pub continuity: Continuity,
}

/// How a frame follows from the frames before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Continuity {
    /// The view changed no more than a moving camera's view can.
    Continuous,
    /// So many frames are missing before this one, [`JUMP_WINDOW`](seese3_core::adapter::JUMP_WINDOW) or
    /// more, that a jump could not be noticed.
    Gap,
    /// The view changed by more than a camera can move between the two frames.
    Jump,
}

impl TrackingHealth {
    /// The health of a stream whose pose was given: it is in the room by assumption.
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
            Self::NotStarted if evidence.matches_room => Self::ONE_MATCH,
            Self::NotStarted => Self::NEWLY_LOST,
            Self::Consistent { score, confirmed } => {
                Self::after_consistent(score, confirmed, evidence)
            }
            Self::Lost { certain_matches } => Self::after_lost(certain_matches, evidence),
        }
    }

    /// Whether the frames contradict the room or one another. A [`Status`](super::Status) can be
    /// LOST for another reason too: a position that is too uncertain.
    pub fn is_lost(self) -> bool {
        matches!(self, Self::Lost { .. })
    }

    /// Whether the stream was certainly in the room once and has not been lost since.
    pub fn is_confirmed(self) -> bool {
        matches!(
            self,
            Self::Consistent {
                confirmed: true,
                ..
            }
        )
    }

    /// One frame matched the room, and nothing is known of those before it.
    const ONE_MATCH: Self = Self::Consistent {
        score: 1,
        confirmed: false,
    };

    const NEWLY_LOST: Self = Self::Lost { certain_matches: 0 };

    fn after_consistent(score: i32, confirmed: bool, evidence: FrameEvidence) -> Self {
        match evidence.continuity {
            Continuity::Jump => return Self::NEWLY_LOST,
            // The missing frames may hide a jump, so this frame has to show the room anew.
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
        continuity: Continuity::Continuous,
    };
    const MISMATCH: FrameEvidence = FrameEvidence {
        matches_room: false,
        matches_certainly: false,
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

        // One matching frame makes an unconfirmed stream, which the next other frame ends.
        assert_eq!(
            lost_after_each(fresh, &[MATCH, MISMATCH, MATCH]),
            [false, true, true]
        );

        // Five in a row end the loss.
        let frames = [&[MISMATCH][..], &[MATCH; 6]].concat();
        assert_eq!(
            lost_after_each(fresh, &frames),
            [true, true, true, true, true, false, false]
        );

        // Twenty confirm the stream, which then may explore.
        let frames = [&[MATCH; 20][..], &[MISMATCH; 9]].concat();
        assert!(lost_after_each(fresh, &frames).iter().all(|lost| !lost));
    }

    /// Oracle: the rules by hand: behind a gap even a confirmed stream has to show the room again.
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

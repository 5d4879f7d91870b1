//! Contiguous fifths of a recording.

use crate::room::FrameId;

/// A contiguous fifth of a recording's frames: frames ⌊kN/5⌋ to ⌊(k+1)N/5⌋ − 1 of N, k from 0 to 4.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fifth {
    /// k = 0.
    First,
    /// k = 1.
    Second,
    /// k = 2.
    Third,
    /// k = 3.
    Fourth,
    /// k = 4.
    Last,
}

impl Fifth {
    /// Name of the fold with this fifth as test set.
    pub(super) fn fold_name(self) -> &'static str {
        match self {
            Self::First => "fold1",
            Self::Second => "fold2",
            Self::Third => "fold3",
            Self::Fourth => "fold4",
            Self::Last => "fold5",
        }
    }

    /// Whether a frame is in this fifth of a recording with `frame_count` frames.
    pub(super) fn holds(self, frame: FrameId, frame_count: usize) -> bool {
        let k = self as usize;
        let begin = frame_count * k / 5;
        let end = frame_count * (k + 1) / 5;

        (begin..end).contains(&frame.row())
    }
}

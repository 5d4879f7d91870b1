//! Splits of a recording into mapped frames and frames that are tracked against the map.

use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use crate::room::{FrameId, Timeline};

/// Number of blocks of a recording for [`HoldOut::Blocks`].
const BLOCKS: usize = 20;
/// One of this many consecutive blocks is held out.
const BLOCK_PERIOD: usize = 5;
/// Index of the held-out block in its period; not 0, so that the start of a recording is mapped.
const LEFT_OUT_BLOCK: usize = 2;

/// Split of a recording into mapped and tracked frames.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
pub enum HoldOut {
    /// Map every second frame, replay the others.
    Interleaved,
    /// As interleaved, but a fifth of the path stays unmapped.
    ///
    /// 4 of 20 blocks of the recording (every fifth) have no mapped frames.
    Blocks,
    /// Map the first four fifths, replay the last.
    Time,
    /// Map the first sequence, replay all others: another visit of the same room.
    Visit,
}

impl HoldOut {
    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The mapped frames of a recording, in order.
    pub fn mapped(self, timeline: &Timeline) -> Vec<FrameId> {
        let frame_count = timeline.frame_count;
        let is_mapped = |row: &usize| match self {
            Self::Visit => is_in_first_sequence(*row, timeline),
            Self::Interleaved => row.is_multiple_of(2),
            Self::Blocks => row.is_multiple_of(2) && !is_in_left_out_block(*row, frame_count),
            Self::Time => *row < frame_count * 4 / 5,
        };

        frames_where(frame_count, is_mapped)
    }

    /// The tracked frames of a recording, in order; disjoint from the mapped ones. Empty for
    /// [`HoldOut::Visit`] if the recording has one sequence only.
    pub fn tracked(self, timeline: &Timeline) -> Vec<FrameId> {
        let frame_count = timeline.frame_count;
        let is_tracked = |row: &usize| match self {
            Self::Visit => !is_in_first_sequence(*row, timeline),
            Self::Interleaved | Self::Blocks => row % 2 == 1,
            Self::Time => *row >= frame_count * 4 / 5,
        };

        frames_where(frame_count, is_tracked)
    }

    /// Whether the frames directly before and after a tracked frame are mapped.
    pub fn has_mapped_neighbors(self, frame: FrameId, frame_count: usize) -> bool {
        match self {
            Self::Interleaved => true,
            Self::Blocks => !is_in_left_out_block(frame.row(), frame_count),
            Self::Time | Self::Visit => false,
        }
    }
}

fn is_in_first_sequence(row: usize, timeline: &Timeline) -> bool {
    timeline.joins(FrameId(0), FrameId(row as u32))
}

/// Whether a row is in a held-out block of [`HoldOut::Blocks`].
pub fn is_in_left_out_block(row: usize, frame_count: usize) -> bool {
    let block_length = frame_count.div_ceil(BLOCKS).max(1);
    (row / block_length) % BLOCK_PERIOD == LEFT_OUT_BLOCK
}

fn frames_where(frame_count: usize, keep: impl Fn(&usize) -> bool) -> Vec<FrameId> {
    (0..frame_count)
        .filter(keep)
        .map(|row| FrameId(row as u32))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition: mapped and tracked frames are disjoint.
    #[test]
    fn what_is_tracked_is_not_mapped() {
        let timeline = Timeline {
            sequences: (0..400).map(|row| u32::from(row >= 200)).collect(),
            ..Timeline::unbroken(400)
        };
        for &hold_out in HoldOut::VARIANTS {
            let name = hold_out.name();
            let mapped = hold_out.mapped(&timeline);
            let tracked = hold_out.tracked(&timeline);

            assert!(
                tracked.iter().all(|frame| !mapped.contains(frame)),
                "{name}"
            );
            assert!(mapped.len() >= 160 && tracked.len() >= 80, "{name}");
        }

        // With 400 frames a block has 20; the third block is rows 40 to 59.
        let mapped = HoldOut::Blocks.mapped(&timeline);
        assert!(!mapped.contains(&FrameId(40)) && mapped.contains(&FrameId(38)));

        let visit = HoldOut::Visit.mapped(&timeline);
        assert_eq!((visit.len(), visit[199]), (200, FrameId(199)));
        assert!(HoldOut::Visit.tracked(&Timeline::unbroken(400)).is_empty());
    }
}

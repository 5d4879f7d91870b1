//! Splits of a recording into mapped frames and frames that are tracked against the map.

use strum::{EnumMessage, EnumString, IntoStaticStr, VariantArray};

use crate::room::FrameId;

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
}

impl HoldOut {
    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The mapped frames of a recording with `frame_count` frames, in order.
    pub fn mapped(self, frame_count: usize) -> Vec<FrameId> {
        let is_mapped = |row: &usize| match self {
            Self::Interleaved => row.is_multiple_of(2),
            Self::Blocks => row.is_multiple_of(2) && !is_in_left_out_block(*row, frame_count),
            Self::Time => *row < frame_count * 4 / 5,
        };

        frames_where(frame_count, is_mapped)
    }

    /// The tracked frames of a recording with `frame_count` frames, in order; disjoint from the
    /// mapped ones.
    pub fn tracked(self, frame_count: usize) -> Vec<FrameId> {
        let is_tracked = |row: &usize| match self {
            Self::Interleaved | Self::Blocks => row % 2 == 1,
            Self::Time => *row >= frame_count * 4 / 5,
        };

        frames_where(frame_count, is_tracked)
    }

    /// Whether the frames directly before and after a tracked frame are mapped.
    pub fn has_mapped_neighbours(self, frame: FrameId, frame_count: usize) -> bool {
        match self {
            Self::Interleaved => true,
            Self::Blocks => !is_in_left_out_block(frame.row(), frame_count),
            Self::Time => false,
        }
    }
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
        for &hold_out in HoldOut::VARIANTS {
            let name = hold_out.name();
            let mapped = hold_out.mapped(400);
            let tracked = hold_out.tracked(400);

            assert!(
                tracked.iter().all(|frame| !mapped.contains(frame)),
                "{name}"
            );
            assert!(mapped.len() >= 160 && tracked.len() >= 80, "{name}");
        }

        // With 400 frames a block has 20; the third block is rows 40 to 59.
        let mapped = HoldOut::Blocks.mapped(400);
        assert!(!mapped.contains(&FrameId(40)) && mapped.contains(&FrameId(38)));
    }
}

//! Train/test splits of frame pairs, and the candidate frames for retrieval.
//!
//! A pair (i, j) is two frames of one room, j = i + stride: the source i and the target j.

mod hold_out;

pub use hold_out::{HoldOut, is_in_left_out_block};

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use strum::{Display, EnumMessage, EnumString, IntoStaticStr, VariantArray};

use crate::room::{FrameId, Timeline};

/// Number of frames in a block of [`Split::Blocks`].
const BLOCK_FRAMES: usize = 50;

/// Why a room has no pairs.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("stride must be at least 1")]
    ZeroStride,
    #[error(
        "{frame_count} frames are too few for stride {stride} under the split '{split}': no {side} pair is left"
    )]
    NoPairs {
        frame_count: usize,
        stride: u32,
        split: Split,
        side: &'static str,
    },
    #[error(
        "the split 'dataset' needs a split in the recording, and this room has none; use time or blocks"
    )]
    NoDatasetSplit,
    #[error("strides {low} to {high} are not a range: low must be at least 1 and at most high")]
    EmptyRange { low: u32, high: u32 },
}

/// Two frames of one room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// The frame at the start of the motion.
    pub source: FrameId,
    /// The frame at the end of the motion.
    pub target: FrameId,
}

/// Split of frames or pairs into a training side and a test side.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Display, EnumMessage, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "lowercase")]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(rename_all = "lowercase")
)]
pub enum Split {
    /// Train on the first 80 % of the frames, test on the rest.
    ///
    /// Both frames of a pair are on the same side. The paper's split.
    Time,
    /// Test on the first fifth of the frames, train on the rest.
    ///
    /// Fold k tests the frames ⌊(k−1)N/5⌋ to ⌊kN/5⌋ − 1 of N. Both frames of a pair are on the same
    /// side.
    Fold1,
    /// Test on the second fifth, train on the others.
    Fold2,
    /// Test on the third fifth, train on the others.
    Fold3,
    /// Test on the fourth fifth, train on the others.
    Fold4,
    /// Test on the last fifth, train on the others: as time.
    Fold5,
    /// Test on every fifth block of 50 frames, train on the others.
    ///
    /// Block b tests if b mod 5 = 2. A test pair lies within one block; both frames of a training
    /// pair lie outside the test blocks.
    Blocks,
    /// Every fifth source frame gives a test pair. Training and test pairs share frames: only for
    /// checking an implementation, not for measuring generalization.
    ///
    /// The pair (i, j) tests if i mod 5 = 2.
    Pairs,
    /// The recording's own split, if it has one.
    ///
    /// 7-Scenes' TestSplit, 12-Scenes' first sequence. Both frames of a pair are on the same side.
    Dataset,
    /// Use every pair for training and for testing: for rooms that are training or held-out rooms
    /// as a whole.
    Whole,
}

impl Split {
    /// The five folds of a recording; each frame is tested in exactly one.
    pub const FOLDS: [Self; 5] = [
        Self::Fold1,
        Self::Fold2,
        Self::Fold3,
        Self::Fold4,
        Self::Fold5,
    ];

    /// Name on the command line, on the wire and in a manifest.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Training pairs at one stride, ordered by source frame.
    ///
    /// # Errors
    /// [`Error::ZeroStride`] for a stride of 0; [`Error::NoDatasetSplit`] under [`Split::Dataset`]
    /// when the recording has no split; [`Error::NoPairs`] when there are no pairs.
    pub fn train_pairs(self, timeline: &Timeline, stride: u32) -> Result<Vec<Pair>, Error> {
        self.pairs(timeline, stride, Side::Train)
    }

    /// Test pairs at one stride, ordered by source frame.
    ///
    /// # Errors
    /// As [`Split::train_pairs`].
    pub fn test_pairs(self, timeline: &Timeline, stride: u32) -> Result<Vec<Pair>, Error> {
        self.pairs(timeline, stride, Side::Test)
    }

    /// Whether a pair is a test pair, at any stride.
    pub fn tests(self, timeline: &Timeline, pair: Pair) -> bool {
        self.is_on(timeline, pair, Side::Test)
    }

    /// Uninterrupted runs of training frames, as ranges of rows: no test frame lies within a run,
    /// and all its frames are in one sequence. Under [`Split::Pairs`] and [`Split::Whole`], which
    /// hold out no frames, these are the sequences.
    pub fn training_runs(self, timeline: &Timeline) -> Vec<Range<usize>> {
        let mut runs: Vec<Range<usize>> = Vec::new();
        for frame in frames(timeline.frame_count) {
            if self.tests_frame(timeline, frame) {
                continue;
            }

            match runs.last_mut() {
                Some(run)
                    if run.end == frame.row() && timeline.joins(FrameId(frame.0 - 1), frame) =>
                {
                    run.end += 1;
                }
                _ => runs.push(frame.row()..frame.row() + 1),
            }
        }

        runs
    }

    /// Candidate frames for a test query: the test frames, or all frames under
    /// [`Split::Pairs`] and [`Split::Whole`], which hold out no frames.
    pub fn candidates(self, timeline: &Timeline) -> Vec<FrameId> {
        let all = matches!(self, Self::Pairs | Self::Whole);
        let candidate = |&frame: &FrameId| all || self.tests_frame(timeline, frame);
        frames(timeline.frame_count).filter(candidate).collect()
    }

    /// Draws `count` training pairs, with replacement, from all pairs of all rooms with a stride in
    /// `low..=high`. Each is returned with the index of its room. This is the paper's range pairing
    /// with replacement, because its 30,000 pairs exceed the distinct pairs of a room.
    ///
    /// # Errors
    /// [`Error::EmptyRange`] when `low` is 0 or above `high`; [`Error::NoPairs`] when a room has no
    /// pair in the range.
    pub fn sampled_range(
        self,
        timelines: &[&Timeline],
        range: &StrideRange,
        seed: u64,
    ) -> Result<Vec<(usize, Pair)>, Error> {
        let &StrideRange { low, high, count } = range;
        if low == 0 || low > high {
            return Err(Error::EmptyRange { low, high });
        }

        // The pool has all distinct pairs, drawn with equal probability.
        let mut pool: Vec<(usize, Pair)> = Vec::new();
        for (room, timeline) in timelines.iter().enumerate() {
            let before = pool.len();

            // Strides longer than the room have no pairs; skip them, so that a huge `high` costs
            // nothing.
            let longest = u32::try_from(timeline.frame_count).unwrap_or(u32::MAX);
            let pairs = (low..=high.min(longest))
                .filter_map(|stride| self.train_pairs(timeline, stride).ok())
                .flatten();
            pool.extend(pairs.map(|pair| (room, pair)));

            // A room without pairs is an error; otherwise it would be missing from the training
            // without notice.
            if pool.len() == before {
                let frame_count = timeline.frame_count;
                return Err(Error::NoPairs {
                    frame_count,
                    stride: low,
                    split: self,
                    side: Side::Train.into(),
                });
            }
        }

        let mut random = ChaCha8Rng::seed_from_u64(seed);
        Ok((0..count)
            .map(|_| pool[random.random_range(0..pool.len())])
            .collect())
    }

    fn pairs(self, timeline: &Timeline, stride: u32, side: Side) -> Result<Vec<Pair>, Error> {
        if stride == 0 {
            return Err(Error::ZeroStride);
        }
        if self == Self::Dataset && timeline.held_out.is_empty() {
            return Err(Error::NoDatasetSplit);
        }

        let frame_count = timeline.frame_count;
        let last_source = frame_count.saturating_sub(stride as usize);

        let pairs: Vec<Pair> = frames(last_source)
            .map(|source| Pair {
                source,
                target: FrameId(source.0 + stride),
            })
            .filter(|&pair| self.is_on(timeline, pair, side))
            .collect();

        if pairs.is_empty() {
            return Err(Error::NoPairs {
                frame_count,
                stride,
                split: self,
                side: side.into(),
            });
        }

        Ok(pairs)
    }

    fn is_on(self, timeline: &Timeline, pair: Pair, side: Side) -> bool {
        match self {
            Self::Whole => timeline.joins(pair.source, pair.target),
            _ => self.side(timeline, pair) == Some(side),
        }
    }

    /// The side of a pair; `None` when its frames are on different sides or in different sequences.
    fn side(self, timeline: &Timeline, pair: Pair) -> Option<Side> {
        if !timeline.joins(pair.source, pair.target) {
            return None;
        }

        let tested = |frame| self.tests_frame(timeline, frame);
        let block = |frame: FrameId| frame.row() / BLOCK_FRAMES;
        if self == Self::Pairs {
            return Some(if pair.source.0 % 5 == 2 {
                Side::Test
            } else {
                Side::Train
            });
        }

        match (tested(pair.source), tested(pair.target)) {
            (false, false) => Some(Side::Train),
            // Training blocks lie between test blocks, so a test pair must stay within one block.
            (true, true) if self != Self::Blocks || block(pair.source) == block(pair.target) => {
                Some(Side::Test)
            }
            _ => None,
        }
    }

    fn tests_frame(self, timeline: &Timeline, frame: FrameId) -> bool {
        let is_in_fifth = |k: usize| {
            let begin = timeline.frame_count * k / 5;
            let end = timeline.frame_count * (k + 1) / 5;
            (begin..end).contains(&frame.row())
        };

        match self {
            Self::Fold1 => is_in_fifth(0),
            Self::Fold2 => is_in_fifth(1),
            Self::Fold3 => is_in_fifth(2),
            Self::Fold4 => is_in_fifth(3),
            Self::Time | Self::Fold5 => is_in_fifth(4),
            Self::Dataset => timeline.held_out.get(frame.row()).copied().unwrap_or(false),
            Self::Blocks => (frame.row() / BLOCK_FRAMES) % 5 == 2,
            Self::Pairs | Self::Whole => false,
        }
    }
}

/// Range of strides for sampled training pairs, and their number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StrideRange {
    /// The smallest stride.
    pub low: u32,
    /// The largest stride.
    pub high: u32,
    /// Number of pairs.
    pub count: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr)]
enum Side {
    #[strum(serialize = "training")]
    Train,
    #[strum(serialize = "test")]
    Test,
}

fn frames(count: usize) -> impl Iterator<Item = FrameId> {
    (0..count as u32).map(FrameId)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Of 100 frames, `time` trains on the first 80 and `fold2` tests 20 to 39; the
    /// second sequence begins at frame 50.
    #[test]
    fn training_runs_end_at_test_frames_and_sequences() {
        let timeline = Timeline {
            sequences: (0..100).map(|row| u32::from(row >= 50)).collect(),
            ..Timeline::unbroken(100)
        };

        assert_eq!(Split::Time.training_runs(&timeline), [0..50, 50..80]);
        assert_eq!(
            Split::Fold2.training_runs(&timeline),
            [0..20, 40..50, 50..100]
        );
        assert_eq!(Split::Whole.training_runs(&timeline), [0..50, 50..100]);
    }

    /// Oracle: the pair counts of the published PyTorch reference on 1,000 frames: its column n.
    #[test]
    fn test_pair_counts_are_the_reference_ones() {
        for (split, stride, expected) in [
            (Split::Pairs, 10, 198),
            (Split::Pairs, 20, 196),
            (Split::Pairs, 40, 192),
            (Split::Time, 10, 190),
            (Split::Time, 20, 180),
            (Split::Time, 40, 160),
        ] {
            assert_eq!(
                split
                    .test_pairs(&Timeline::unbroken(1000), stride)
                    .unwrap()
                    .len(),
                expected,
                "{split} {stride}"
            );
        }

        assert_eq!(
            Split::Time
                .train_pairs(&Timeline::unbroken(1000), 40)
                .unwrap()
                .len(),
            760
        );
    }

    /// Oracle: the definition of a time split, floor(0.8 N) frames train.
    #[test]
    fn no_frame_is_on_both_sides_of_the_time_or_block_split() {
        for split in [Split::Time, Split::Blocks] {
            let ends = |pairs: Vec<Pair>| {
                pairs
                    .into_iter()
                    .flat_map(|pair| [pair.source, pair.target])
            };
            let trained: std::collections::HashSet<_> =
                ends(split.train_pairs(&Timeline::unbroken(503), 10).unwrap()).collect();

            assert!(
                ends(split.test_pairs(&Timeline::unbroken(503), 10).unwrap())
                    .all(|frame| !trained.contains(&frame)),
                "{split}"
            );

            assert!(
                split
                    .candidates(&Timeline::unbroken(503))
                    .iter()
                    .all(|frame| !trained.contains(frame)),
                "{split}"
            );
        }

        assert_eq!(
            Split::Time.candidates(&Timeline::unbroken(503))[0],
            FrameId(402)
        );
    }

    /// Oracle: the definition: every frame is tested in one fold; training and test pairs of a fold
    /// share no frame; both frames of a test pair are in one fifth.
    #[test]
    fn each_frame_is_tested_in_one_fold() {
        let room = Timeline::unbroken(503);
        let mut tested = vec![0; 503];

        for split in Split::FOLDS {
            let candidates = split.candidates(&room);
            for frame in &candidates {
                tested[frame.row()] += 1;
            }

            let test = split.test_pairs(&room, 10).unwrap();
            assert_eq!(test.len(), candidates.len() - 10, "{split}");

            let is_tested = |frame: &FrameId| candidates.contains(frame);
            let train = split.train_pairs(&room, 10).unwrap();
            assert!(
                train
                    .iter()
                    .all(|pair| !is_tested(&pair.source) && !is_tested(&pair.target)),
                "{split}"
            );
        }

        assert_eq!(tested, vec![1; 503]);
        assert_eq!(
            Split::FOLDS[4].test_pairs(&room, 10),
            Split::Time.test_pairs(&room, 10)
        );
    }

    /// Oracle: by hand. 320 training frames have Σ (320 − s) = 9,145 distinct pairs over the
    /// strides s from 10 to 40.
    #[test]
    fn range_pairing_draws_from_the_papers_pool() {
        let distinct: usize = (10..=40)
            .map(|s| {
                Split::Time
                    .train_pairs(&Timeline::unbroken(400), s)
                    .unwrap()
                    .len()
            })
            .sum();

        assert_eq!(distinct, 9_145);

        let range = StrideRange {
            low: 10,
            high: 40,
            count: 30_000,
        };

        let room = Timeline::unbroken(400);
        let drawn = Split::Time.sampled_range(&[&room], &range, 7).unwrap();
        assert_eq!(drawn.len(), 30_000);

        let fits = |pair: &Pair| {
            (10..=40).contains(&(pair.target.0 - pair.source.0)) && pair.target.0 < 320
        };

        assert!(drawn.iter().all(|(room, pair)| *room == 0 && fits(pair)));

        assert_ne!(
            drawn,
            Split::Time.sampled_range(&[&room], &range, 8).unwrap()
        );

        let pooled = Split::Time
            .sampled_range(&[&room, &room, &room], &range, 7)
            .unwrap();

        let share = |of: usize| {
            pooled
                .iter()
                .filter(|(room, pair)| *room == of && fits(pair))
                .count()
        };

        assert!(
            (0..3).all(|of| share(of).abs_diff(10_000) < 500),
            "rooms are drawn from alike"
        );
    }

    /// Oracle: by hand.
    #[test]
    fn a_whole_room_trains_and_tests() {
        let room = Timeline::unbroken(10);
        let train = Split::Whole.train_pairs(&room, 4).unwrap();
        assert_eq!(train.len(), 6);
        assert_eq!(train, Split::Whole.test_pairs(&room, 4).unwrap());

        assert_eq!(Split::Whole.candidates(&room).len(), 10);
    }

    #[test]
    fn a_room_too_short_for_its_stride_is_refused() {
        assert!(matches!(
            Split::Time.test_pairs(&Timeline::unbroken(100), 40),
            Err(Error::NoPairs { side: "test", .. })
        ));

        assert_eq!(
            Split::Time.test_pairs(&Timeline::unbroken(100), 0),
            Err(Error::ZeroStride)
        );
    }

    /// Oracle: by hand. Two sequences of four frames, the second held out: no pair spans both, and
    /// the recording's own split tests the second.
    #[test]
    fn pairs_stay_in_their_sequence_and_the_datasets_own_split_is_kept() {
        let timeline = Timeline {
            frame_count: 8,
            sequences: vec![0, 0, 0, 0, 1, 1, 1, 1],
            held_out: vec![false, false, false, false, true, true, true, true],
        };

        let rows = |pairs: Vec<Pair>| {
            pairs
                .iter()
                .map(|p| (p.source.0, p.target.0))
                .collect::<Vec<_>>()
        };

        assert_eq!(
            rows(Split::Dataset.train_pairs(&timeline, 2).unwrap()),
            [(0, 2), (1, 3)]
        );

        assert_eq!(
            rows(Split::Dataset.test_pairs(&timeline, 2).unwrap()),
            [(4, 6), (5, 7)]
        );

        assert_eq!(
            rows(Split::Time.train_pairs(&timeline, 2).unwrap()),
            [(0, 2), (1, 3)]
        );

        assert_eq!(
            Split::Dataset.candidates(&timeline),
            [4, 5, 6, 7].map(FrameId)
        );

        assert_eq!(
            Split::Dataset.test_pairs(&Timeline::unbroken(8), 2),
            Err(Error::NoDatasetSplit)
        );
    }
}

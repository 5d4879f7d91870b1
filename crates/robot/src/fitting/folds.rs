//! Parts of a map that are left out in turn, to measure how views are located that are not mapped.

use seese3_core::room::FrameId;

/// Blocks that a map is cut into for the folds that leave out a fifth.
const BLOCKS: usize = 10;

/// The rule that leaves out every second frame.
const INTERLEAVED: usize = 0;

/// A map without some of its frames, and these frames.
pub struct Fold {
    /// The frames that stay.
    pub mapped: Vec<FrameId>,
    /// The frames that are left out, to be located.
    pub left_out: Vec<FrameId>,
    /// Whether each of them has mapped frames right before and after it.
    pub is_interleaved: bool,
}

/// The folds of a map: every second frame, two fifths in blocks, and a quarter in one piece are
/// left out, so that there are views at all distances from what is mapped.
pub fn folds(mapped: &[FrameId]) -> Vec<Fold> {
    let count = mapped.len();
    let block = |at: usize| at * BLOCKS / count.max(1) % 5;
    let rules: [&dyn Fn(usize) -> bool; 4] = [
        &|at| at % 2 == 1,
        &|at| block(at) == 1,
        &|at| block(at) == 3,
        &|at| (count / 4..count / 2).contains(&at),
    ];

    let fold = |(rule, is_left_out): (usize, &dyn Fn(usize) -> bool)| {
        let chosen = |wanted: bool| {
            let frames = mapped.iter().enumerate();
            frames
                .filter(|(at, _)| is_left_out(*at) == wanted)
                .map(|(_, frame)| *frame)
                .collect()
        };

        Fold {
            mapped: chosen(false),
            left_out: chosen(true),
            is_interleaved: rule == INTERLEAVED,
        }
    };

    rules.into_iter().enumerate().map(fold).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand, of 40 frames: 20, 8, 8 and 10 are left out; none is both.
    #[test]
    fn what_is_left_out_is_not_mapped() {
        let mapped: Vec<FrameId> = (0..80).step_by(2).map(FrameId).collect();
        let folds = folds(&mapped);

        let counts: Vec<usize> = folds.iter().map(|fold| fold.left_out.len()).collect();
        assert_eq!(counts, [20, 8, 8, 10]);
        for fold in folds {
            assert_eq!(fold.mapped.len() + fold.left_out.len(), 40);
            assert!(
                fold.left_out
                    .iter()
                    .all(|frame| !fold.mapped.contains(frame))
            );
        }
    }
}

//! Cross-validation folds of a map's frames.

use seese3_core::room::FrameId;

/// Number of blocks of a map in the folds that leave out a fifth.
const BLOCKS: usize = 10;

/// Index of the rule that leaves out every second frame.
const INTERLEAVED: usize = 0;

/// One split of a map into training and held-out frames.
pub struct Fold {
    /// Frames that stay in the map.
    pub mapped: Vec<FrameId>,
    /// Held-out frames.
    pub left_out: Vec<FrameId>,
    /// Whether each held-out frame lies directly between two frames of `mapped`.
    pub is_interleaved: bool,
}

/// The four folds of a map. One leaves out every second frame, two leave out a fifth in two blocks,
/// one leaves out a contiguous quarter. Held-out frames thus occur at all distances from the map.
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

    /// Oracle: by hand: of 40 frames the folds leave out 20, 8, 8 and 10; the parts are disjoint.
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

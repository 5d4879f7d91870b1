//! Usability of a view: clear, blank, or frozen.

/// Largest distance between identical images, in standard deviations of frame noise. The noise of a
/// camera at rest is some tenths.
pub(super) const UNCHANGED_DISTANCE: f64 = 0.01;

/// Number of repetitions of an image after which a camera counts as frozen. Fewer occur in
/// recordings in which a dropped frame was replaced by a copy.
const FROZEN_FRAMES: u32 = 5;

/// Usability of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sight {
    /// Usable.
    Clear,
    /// The image is blank.
    Nothing,
    /// The camera is frozen: identical images, which the noise of a real camera rules out.
    Unchanged,
}

impl Sight {
    /// Classifies a view that is identical to the `unchanged_frames` views before it.
    pub(super) fn of(is_blank: bool, unchanged_frames: u32) -> Self {
        if is_blank {
            Self::Nothing
        } else if unchanged_frames >= FROZEN_FRAMES {
            Self::Unchanged
        } else {
            Self::Clear
        }
    }
}

/// Euclidean distance between two whitened latents.
pub(super) fn distance(a: &[f64], b: &[f64]) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b));
    squares.sum::<f64>().sqrt()
}

//! What a frame shows: something, nothing, or exactly what the frame before it showed.

/// Views this near to one another, in deviations of frame noise, are the same image: the noise of a
/// camera that stands still is some tenths.
pub(super) const UNCHANGED_DISTANCE: f64 = 0.01;

/// After so many frames that are the same image a camera is taken to be frozen. Recordings hold
/// pairs of the same image where a frame was dropped.
const FROZEN_FRAMES: u32 = 5;

/// What a frame shows of the world.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sight {
    /// Something.
    Clear,
    /// Nothing: the image is blank.
    Nothing,
    /// Exactly what the frames before it showed, which the noise of a real camera rules out: it is
    /// frozen.
    Unchanged,
}

impl Sight {
    /// Of a view that showed exactly what the `unchanged_frames` before it did.
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

/// The Euclidean distance of two whitened latents.
pub(super) fn distance(a: &[f64], b: &[f64]) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b));
    squares.sum::<f64>().sqrt()
}

//! A room as an adapter embeds it.

use ndarray::Array2;

use seese3_core::geometry::Pose;

/// A room as the adapter sees it.
pub struct EmbeddedRoom<'a> {
    /// `world_from_camera`, row by frame.
    pub poses: &'a [Pose],
    /// Latents, row by frame, shape (n, k).
    pub latents: Array2<f64>,
    /// The columns of the latents that distances are taken of, shape (n, c).
    pub coordinates: Array2<f64>,
}

//! A room's poses and latents.

use ndarray::Array2;

use seese3_core::geometry::Pose;

/// Poses and latents of one room.
pub struct EmbeddedRoom<'a> {
    /// `world_from_camera`, one per frame.
    pub poses: &'a [Pose],
    /// Columns of the latents that distances use, one row per frame, shape (n, c).
    pub coordinates: Array2<f64>,
}

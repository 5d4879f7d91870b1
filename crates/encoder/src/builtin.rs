//! The built-in encoder without weights: histograms of gradient orientations, and coarse color.
//!
//! It replaces a real encoder in demonstrations without a model. The image is divided into 8×6
//! cells; each cell gives a histogram of 8 gradient orientations and its mean color. A pixel's vote
//! is interpolated between neighboring cells and orientations, so that features change smoothly as
//! the camera moves.

use std::f32::consts::TAU;

use super::{Pooling, Preparation, Resize};
use seese3_core::features::FeatureSource;
use seese3_core::image::RgbImage;

const COLUMNS: usize = 8;
const ROWS: usize = 6;
const ORIENTATIONS: usize = 8;
const CELL_DIM: usize = ORIENTATIONS + 3;

/// The number of columns of a feature.
pub const BUILTIN_DIM: usize = COLUMNS * ROWS * CELL_DIM;

pub(super) const POOLING: Pooling = Pooling::Grid {
    columns: COLUMNS,
    rows: ROWS,
    skip: 0,
};

/// The encoder is meant for small images, so each one is resized to 64×48 pixels.
pub(super) fn preparation() -> Preparation {
    Preparation {
        resize: Resize::Whole {
            width: 64,
            height: 48,
        },
        ..Preparation::default()
    }
}

/// The source of the features that [`encode_builtin`] computes from images of 64×48 pixels.
pub fn builtin_source(name: &str) -> FeatureSource {
    FeatureSource {
        name: name.to_owned(),
        encoder: "builtin-orientations-v1".to_owned(),
        layer: "none".to_owned(),
        base: "name".to_owned(),
        norm: "none".to_owned(),
        pooling: POOLING.to_string(),
        preprocess: preparation().describe(1),
        dim: BUILTIN_DIM,
        parts: Vec::new(),
    }
}

/// The feature of an image, shape ([`BUILTIN_DIM`],). A gradient needs at least 3×3 pixels: the
/// histograms of a smaller image are zero.
pub fn encode_builtin(image: &RgbImage) -> Vec<f32> {
    let width = image.width;
    let height = image.height;
    let grey: Vec<f32> = image.bytes.chunks_exact(3).map(luminance).collect();
    let mut feature = vec![0.0; BUILTIN_DIM];

    // The sum of the shares of all pixels in a cell, which is the cell's area in pixels.
    let mut weight = [0.0; COLUMNS * ROWS];
    for y in 0..height {
        for x in 0..width {
            let cells = cells_of(x, y, width, height);
            let pixel = image.pixel(x, y);
            for &(cell, share) in &cells {
                weight[cell] += share;

                for (channel, &value) in pixel.iter().enumerate() {
                    feature[cell * CELL_DIM + ORIENTATIONS + channel] +=
                        share * f32::from(value) / 255.0;
                }
            }

            // A central difference needs a neighbor on every side, so border pixels contribute only
            // their color.
            if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
                continue;
            }

            let at = |x: usize, y: usize| grey[y * width + x];
            let dx = at(x + 1, y) - at(x - 1, y);
            let dy = at(x, y + 1) - at(x, y - 1);
            let strength = dx.hypot(dy);

            // The angle of the gradient in units of orientation bins, 0 to 8. Bins are
            // circular: both `%` catch an angle that was rounded up to the full turn.
            let place =
                (dy.atan2(dx).rem_euclid(TAU) / TAU * ORIENTATIONS as f32) % ORIENTATIONS as f32;
            let low = place.floor() as usize % ORIENTATIONS;
            let part = place.fract();

            // The vote is split between the two nearest orientations, so that it does not jump.
            for &(cell, share) in &cells {
                feature[cell * CELL_DIM + low] += strength * share * (1.0 - part);
                feature[cell * CELL_DIM + (low + 1) % ORIENTATIONS] += strength * share * part;
            }
        }
    }

    // Sums become means over the cell, so that features do not depend on the number of pixels. The
    // square root reduces the dominance of strong edges.
    for (cell, values) in feature.chunks_exact_mut(CELL_DIM).enumerate() {
        let (histogram, color) = values.split_at_mut(ORIENTATIONS);
        let area = weight[cell].max(1e-6);
        histogram
            .iter_mut()
            .for_each(|value| *value = (8.0 * *value / area).sqrt());

        color.iter_mut().for_each(|value| *value /= area);
    }

    feature
}

/// The four cells around a pixel, each with the pixel's share in it. Shares are the weights of
/// bilinear interpolation between the centers of the cells, and add up to 1.
fn cells_of(x: usize, y: usize, width: usize, height: usize) -> [(usize, f32); 4] {
    let place = |pixel: usize, pixels: usize, cells: usize| {
        // The pixel's center in units of cells, relative to the center of the first cell. It is
        // clamped, so that a pixel beyond the outermost centers counts only for the outermost cell.
        let at = ((pixel as f32 + 0.5) * cells as f32 / pixels as f32 - 0.5)
            .clamp(0.0, cells as f32 - 1.0);
        let low = (at.floor() as usize).min(cells - 1);
        (low, (low + 1).min(cells - 1), at - low as f32)
    };
    let (left, right, s) = place(x, width, COLUMNS);

    let (top, bottom, t) = place(y, height, ROWS);
    [
        (top * COLUMNS + left, (1.0 - s) * (1.0 - t)),
        (top * COLUMNS + right, s * (1.0 - t)),
        (bottom * COLUMNS + left, (1.0 - s) * t),
        (bottom * COLUMNS + right, s * t),
    ]
}

fn luminance(pixel: &[u8]) -> f32 {
    (0.299 * f32::from(pixel[0]) + 0.587 * f32::from(pixel[1]) + 0.114 * f32::from(pixel[2]))
        / 255.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Brightness that grows to the right has its gradient at angle 0, the first
    /// orientation, in every cell; all other orientations are empty.
    #[test]
    fn a_ramp_votes_for_one_orientation() {
        let width = 64;
        let height = 48;
        let bytes = (0..width * height)
            .flat_map(|i| [(2 * (i % width)) as u8; 3])
            .collect();
        let feature = encode_builtin(&RgbImage {
            width,
            height,
            bytes,
        });

        for cell in feature.chunks_exact(CELL_DIM) {
            assert!(
                cell[0] > 0.1 && cell[1..ORIENTATIONS].iter().all(|&x| x < 1e-3),
                "{cell:?}"
            );
        }
    }

    /// Oracle: by hand. A uniform image has no gradient, and its own color in every cell.
    #[test]
    fn a_uniform_image_is_its_color() {
        let image = RgbImage {
            width: 10,
            height: 7,
            bytes: [51, 102, 255].repeat(70),
        };

        for cell in encode_builtin(&image).chunks_exact(CELL_DIM) {
            assert!(cell[..ORIENTATIONS].iter().all(|&x| x == 0.0));
            for (value, expected) in cell[ORIENTATIONS..].iter().zip([0.2, 0.4, 1.0]) {
                assert!((value - expected).abs() < 1e-4);
            }
        }
    }
}

//! 8-bit RGB images in memory, row by row from the top left.

/// Columns and rows of the grid cells for the blank check.
const BLANK_GRID: (usize, usize) = (16, 12);
/// An image is blank if the standard deviation of the cell means is below this, on the scale 0 to
/// 255.
const BLANK_DEVIATION: f64 = 2.0;

/// An image of `width` × `height` pixels, three bytes per pixel: red, green, blue.
#[derive(Debug, Clone, PartialEq)]
pub struct RgbImage {
    /// Number of pixel columns.
    pub width: usize,
    /// Number of pixel rows.
    pub height: usize,
    /// `width * height * 3` bytes.
    pub bytes: Vec<u8>,
}

impl RgbImage {
    /// The color at column `x` and row `y`, which must be inside the image.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = (y * self.width + x) * 3;
        [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2]]
    }

    /// Whether the image is blank, for instance from a covered lens, a saturated sensor or a wall
    /// without texture: the cells of a 16 × 12 grid have nearly equal mean brightness. Pixel noise
    /// is averaged out.
    pub fn is_blank(&self) -> bool {
        let mut parts = [(0_u64, 0_u64); BLANK_GRID.0 * BLANK_GRID.1];
        // Byte of a row at which a column of the grid begins: x · columns / width rounds down.
        let begins = |column: usize| 3 * (column * self.width).div_ceil(BLANK_GRID.0);
        for (y, row) in self.bytes.chunks_exact(3 * self.width.max(1)).enumerate() {
            let of_row = y * BLANK_GRID.1 / self.height * BLANK_GRID.0;
            for (column, (sum, count)) in parts[of_row..][..BLANK_GRID.0].iter_mut().enumerate() {
                let cell = &row[begins(column)..begins(column + 1)];
                let in_row: u32 = cell.iter().map(|&value| u32::from(value)).sum();
                *sum += u64::from(in_row);
                *count += cell.len() as u64;
            }
        }

        // In an image smaller than the grid, some cells have no pixel.
        let known = parts.iter().filter(|(_, count)| *count > 0);
        let means: Vec<f64> = known
            .map(|(sum, count)| *sum as f64 / *count as f64)
            .collect();
        let mean = means.iter().sum::<f64>() / means.len() as f64;
        let variance = means.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / means.len() as f64;
        variance.sqrt() < BLANK_DEVIATION
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(color: impl Fn(usize, usize) -> u8) -> RgbImage {
        let (width, height) = (64, 48);
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let bytes = pixels.flat_map(|(x, y)| [color(x, y); 3]).collect();
        RgbImage {
            width,
            height,
            bytes,
        }
    }

    /// Oracle: by hand: a constant, with or without noise, is blank; a step and a gradient are not.
    #[test]
    fn blank_images_show_nothing() {
        // A fixed noise pattern that averages out in every cell.
        let noise = |x: usize, y: usize| 5 + ((x * 7 + y * 13) % 8) as u8;
        assert!(image(|_, _| 0).is_blank());
        assert!(image(|_, _| 255).is_blank());
        assert!(image(noise).is_blank());

        assert!(!image(|x, _| if x < 32 { 100 } else { 110 }).is_blank());
        assert!(!image(|_, y| y as u8).is_blank());

        let tiny = RgbImage {
            width: 2,
            height: 1,
            bytes: vec![0, 0, 0, 200, 200, 200],
        };
        assert!(!tiny.is_blank());
    }
}

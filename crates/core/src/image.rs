//! 8-bit RGB images in memory, row by row from the top left.

/// The columns and rows of parts whose brightness is compared.
const BLANK_GRID: (usize, usize) = (16, 12);
/// Parts whose means deviate by less than this, of 255, are equally bright.
const BLANK_DEVIATION: f64 = 2.0;

/// An image of `width` × `height` pixels, three bytes each: red, green, blue.
#[derive(Debug, Clone, PartialEq)]
pub struct RgbImage {
    /// Pixels from left to right.
    pub width: usize,
    /// Pixels from top to bottom.
    pub height: usize,
    /// `width * height * 3` bytes.
    pub bytes: Vec<u8>,
}

impl RgbImage {
    /// The colour at column `x` and row `y`, which must lie inside the image.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = (y * self.width + x) * 3;
        [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2]]
    }

    /// Whether the image shows nothing: its parts, 16 × 12 of them, are all about equally bright, as
    /// those of a covered lens, a blinded sensor or a wall without any texture are. Noise does not
    /// count.
    pub fn is_blank(&self) -> bool {
        let mut parts = [(0_u64, 0_u64); BLANK_GRID.0 * BLANK_GRID.1];
        for y in 0..self.height {
            let row = y * BLANK_GRID.1 / self.height;
            for x in 0..self.width {
                let column = x * BLANK_GRID.0 / self.width;
                let (sum, count) = &mut parts[row * BLANK_GRID.0 + column];
                *sum += self.pixel(x, y).map(u64::from).iter().sum::<u64>();
                *count += 3;
            }
        }

        // An image smaller than the grid leaves some parts without a pixel.
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

    fn image(colour: impl Fn(usize, usize) -> u8) -> RgbImage {
        let (width, height) = (64, 48);
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let bytes = pixels.flat_map(|(x, y)| [colour(x, y); 3]).collect();
        RgbImage {
            width,
            height,
            bytes,
        }
    }

    /// Oracle: by hand: constants and noise around one show nothing, a step and a gradient do.
    #[test]
    fn blank_images_show_nothing() {
        // A fixed pattern of one pixel each way averages out in every part.
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

//! 8-bit RGB images in memory, row by row from the top left.

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
}

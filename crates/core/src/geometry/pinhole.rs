//! The pinhole camera: which direction a point of an image is seen in.

use nalgebra::Vector2;

/// Why a camera is refused.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum PinholeError {
    #[error(
        "the focal length is {0} image widths; it must be between 0.1 and 10: divide the focal \
         length in pixels by the width of the image"
    )]
    Focal(f64),
    #[error(
        "the principal point is ({0}, {1}) image widths from the top left corner; it must lie \
         inside the image"
    )]
    Centre(f64, f64),
}

/// A pinhole camera with square pixels. Lengths are in image widths, so that they stay when the
/// image is resized.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    focal: f64,
    centre: Vector2<f64>,
}

impl Pinhole {
    /// A camera of this focal length and principal point, counted from the image's top left corner.
    ///
    /// # Errors
    /// [`PinholeError`] for what no camera of a robot has.
    pub fn new(focal: f64, centre: Vector2<f64>) -> Result<Self, PinholeError> {
        if !(0.1..=10.0).contains(&focal) {
            return Err(PinholeError::Focal(focal));
        }

        let inside = |part: f64, size: f64| (0.0..=size).contains(&part);
        if !inside(centre.x, 1.0) || !inside(centre.y, 4.0) {
            return Err(PinholeError::Centre(centre.x, centre.y));
        }

        Ok(Self { focal, centre })
    }

    /// A camera that looks through the middle of an image of `height` image widths.
    ///
    /// # Errors
    /// As [`Pinhole::new`].
    pub fn centred(focal: f64, height: f64) -> Result<Self, PinholeError> {
        Self::new(focal, Vector2::new(0.5, height / 2.0))
    }

    /// The focal length, image widths.
    pub fn focal(&self) -> f64 {
        self.focal
    }

    /// The principal point, image widths from the top left corner.
    pub fn centre(&self) -> Vector2<f64> {
        self.centre
    }

    /// Where a point of the image, image widths from its top left corner, lies on the plane at
    /// distance 1 before the camera.
    pub fn plane(&self, point: Vector2<f64>) -> Vector2<f64> {
        (point - self.centre) / self.focal
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. A camera that sees 90° across has a focal length of half a width: the edge
    /// of its image is 45° from the middle.
    #[test]
    fn the_edge_of_a_right_angle_is_one_away_on_the_plane() {
        let camera = Pinhole::centred(0.5, 0.75).unwrap();
        assert_eq!(
            camera.plane(Vector2::new(1.0, 0.375)),
            Vector2::new(1.0, 0.0)
        );
    }

    /// Oracle: a focal length in pixels, or none, is a mistake of the caller.
    #[test]
    fn what_no_camera_has_is_refused() {
        for focal in [585.0, 0.0, -1.0, f64::NAN] {
            assert!(matches!(
                Pinhole::centred(focal, 0.75),
                Err(PinholeError::Focal(_))
            ));
        }
        assert!(Pinhole::new(1.0, Vector2::new(320.0, 240.0)).is_err());
    }
}

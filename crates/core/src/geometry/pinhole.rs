//! The pinhole camera: which direction a point of an image is seen in.

use nalgebra::Vector2;

/// Why a camera is refused.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum PinholeError {
    #[error(
        "images are {width} by {height} pixels; both must be above 0, and neither ten times the other"
    )]
    Size { width: f64, height: f64 },
    #[error(
        "the focal length is {focal} pixels in images {width} wide; it must be a tenth of that to ten times that"
    )]
    Focal { focal: f64, width: f64 },
    #[error("the principal point ({x}, {y}) lies outside images of {width} by {height} pixels")]
    Centre {
        x: f64,
        y: f64,
        width: f64,
        height: f64,
    },
}

/// By what share the fields of view of two cameras may differ that count as alike.
const OTHER_VIEW: f64 = 0.1;

/// A pinhole camera as its calibration states it, in pixels of its images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelCamera {
    /// The size of the images.
    pub width: f64,
    /// The size of the images.
    pub height: f64,
    /// The focal length, the same along both axes.
    pub focal: f64,
    /// The principal point from the image's top left corner; the middle if `None`.
    pub centre: Option<Vector2<f64>>,
}

/// A pinhole camera with square pixels. Lengths are in image widths, so that they stay when the
/// image is resized.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    focal: f64,
    height: f64,
    centre: Vector2<f64>,
}

impl Pinhole {
    /// Checks a camera.
    ///
    /// # Errors
    /// [`PinholeError`] if a number is out of its range.
    pub fn new(camera: PixelCamera) -> Result<Self, PinholeError> {
        let PixelCamera {
            width,
            height,
            focal,
            centre,
        } = camera;

        // Not a number is outside every range.
        if !(width.is_finite() && width > 0.0 && (0.1..=10.0).contains(&(height / width))) {
            return Err(PinholeError::Size { width, height });
        }
        if !(0.1..=10.0).contains(&(focal / width)) {
            return Err(PinholeError::Focal { focal, width });
        }

        let centre = centre.unwrap_or(Vector2::new(width, height) / 2.0);
        let [x, y] = [centre.x, centre.y];
        if !(0.0..=width).contains(&x) || !(0.0..=height).contains(&y) {
            return Err(PinholeError::Centre {
                x,
                y,
                width,
                height,
            });
        }

        Ok(Self {
            focal: focal / width,
            height: height / width,
            centre: centre / width,
        })
    }

    /// The focal length, image widths.
    pub fn focal(&self) -> f64 {
        self.focal
    }

    /// The height of the images, image widths.
    pub fn height(&self) -> f64 {
        self.height
    }

    /// The principal point from the top left corner, image widths.
    pub fn centre(&self) -> Vector2<f64> {
        self.centre
    }

    /// In what another camera sees so much more or less that places look different through it, in
    /// words; none if it does not.
    pub fn difference(&self, other: &Self) -> Option<String> {
        [
            ("across", self.degrees_across(), other.degrees_across()),
            ("down", self.degrees_down(), other.degrees_down()),
        ]
        .into_iter()
        .find(|(_, ours, theirs)| (theirs / ours - 1.0).abs() > OTHER_VIEW)
        .map(|(side, ours, theirs)| {
            format!("sees {theirs:.1} degrees {side}, and the one that mapped the room {ours:.1}")
        })
    }

    /// How far it sees from left to right, degrees.
    pub fn degrees_across(&self) -> f64 {
        self.degrees(self.centre.x, 1.0)
    }

    /// How far it sees from top to bottom, degrees.
    pub fn degrees_down(&self) -> f64 {
        self.degrees(self.centre.y, self.height)
    }

    /// The angle between the two edges of an image whose length is given, with the principal point
    /// somewhere between them.
    fn degrees(&self, centre: f64, length: f64) -> f64 {
        let to_one = (centre / self.focal).atan();
        let to_other = ((length - centre) / self.focal).atan();
        (to_one + to_other).to_degrees()
    }

    /// Where a point of the image, image widths from its top left corner, lies on the plane at
    /// distance 1 before the camera.
    pub fn to_image_plane(&self, point: Vector2<f64>) -> Vector2<f64> {
        (point - self.centre) / self.focal
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KITCHEN: PixelCamera = PixelCamera {
        width: 640.0,
        height: 480.0,
        focal: 585.0,
        centre: None,
    };

    /// Oracle: by hand. A camera that sees 90° across has a focal length of half a width: the edge
    /// of its image is 45° from the middle.
    #[test]
    fn the_edge_of_a_right_angle_is_one_away_on_the_plane() {
        let camera = Pinhole::new(PixelCamera {
            focal: 320.0,
            ..KITCHEN
        })
        .unwrap();
        assert_eq!(
            camera.to_image_plane(Vector2::new(1.0, 0.375)),
            Vector2::new(1.0, 0.0)
        );
    }

    /// Oracle: by hand. 320 pixels before the middle of 640 are 45° to each side; an edge that lies
    /// at the principal point itself adds nothing.
    #[test]
    fn the_field_of_view_is_the_angle_between_the_edges() {
        let half = PixelCamera {
            focal: 320.0,
            ..KITCHEN
        };
        let camera = Pinhole::new(half).unwrap();
        assert!((camera.degrees_across() - 90.0).abs() < 1e-12);
        let down = 2.0 * (240.0_f64 / 320.0).atan().to_degrees();
        assert!((camera.degrees_down() - down).abs() < 1e-12);

        let from_the_corner = PixelCamera {
            centre: Some(Vector2::new(0.0, 240.0)),
            focal: 640.0,
            ..KITCHEN
        };
        let camera = Pinhole::new(from_the_corner).unwrap();
        assert!((camera.degrees_across() - 45.0).abs() < 1e-12);
    }

    /// Oracle: a focal length in image widths, none, or a principal point of other images is a
    /// mistake of the caller.
    #[test]
    fn what_no_camera_has_is_refused() {
        for focal in [0.9, 0.0, -585.0, f64::NAN, f64::INFINITY] {
            let camera = PixelCamera { focal, ..KITCHEN };
            assert!(matches!(
                Pinhole::new(camera),
                Err(PinholeError::Focal { .. })
            ));
        }

        let outside = PixelCamera {
            centre: Some(Vector2::new(960.0, 540.0)),
            ..KITCHEN
        };
        assert!(matches!(
            Pinhole::new(outside),
            Err(PinholeError::Centre { .. })
        ));

        for width in [0.0, -640.0, f64::NAN] {
            let camera = PixelCamera { width, ..KITCHEN };
            assert!(matches!(
                Pinhole::new(camera),
                Err(PinholeError::Size { .. })
            ));
        }
    }
}

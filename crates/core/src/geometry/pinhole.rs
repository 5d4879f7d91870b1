//! The pinhole camera model.

use nalgebra::Vector2;

/// Why a camera is refused.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum PinholeError {
    #[error(
        "images are {width} by {height} pixels; both must be above 0, and the aspect ratio at most 10"
    )]
    Size { width: f64, height: f64 },
    #[error(
        "the focal length is {focal} pixels; for images {width} pixels wide it must be 0.1 to 10 times the width"
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

/// Maximum relative difference between the fields of view of compatible cameras.
const OTHER_VIEW: f64 = 0.1;

/// A pinhole camera in pixels, as in its calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelCamera {
    /// Width of the images.
    pub width: f64,
    /// Height of the images.
    pub height: f64,
    /// Focal length, equal along both axes.
    pub focal: f64,
    /// Principal point from the top left corner; `None` is the image center.
    pub centre: Option<Vector2<f64>>,
}

/// A pinhole camera with square pixels. Lengths are in image widths, independent of the image size.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(try_from = "PinholeFields", into = "PinholeFields")
)]
pub struct Pinhole {
    focal: f64,
    height: f64,
    centre: Vector2<f64>,
}

/// The serialized form of a [`Pinhole`]. Unit: image widths.
#[cfg(feature = "serde")]
#[derive(serde::Serialize, serde::Deserialize)]
struct PinholeFields {
    focal: f64,
    height: f64,
    centre: [f64; 2],
}

#[cfg(feature = "serde")]
impl TryFrom<PinholeFields> for Pinhole {
    type Error = PinholeError;

    fn try_from(fields: PinholeFields) -> Result<Self, PinholeError> {
        Self::new(PixelCamera {
            width: 1.0,
            height: fields.height,
            focal: fields.focal,
            centre: Some(fields.centre.into()),
        })
    }
}

#[cfg(feature = "serde")]
impl From<Pinhole> for PinholeFields {
    fn from(camera: Pinhole) -> Self {
        Self {
            focal: camera.focal,
            height: camera.height,
            centre: camera.centre.into(),
        }
    }
}

impl Pinhole {
    /// Validates a camera.
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

        // NaN is outside every range.
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

    /// Focal length, image widths.
    pub fn focal(&self) -> f64 {
        self.focal
    }

    /// Height of the images, image widths.
    pub fn height(&self) -> f64 {
        self.height
    }

    /// Principal point from the top left corner, image widths.
    pub fn centre(&self) -> Vector2<f64> {
        self.centre
    }

    /// A description of the first field of view of `other` that differs by more than 10 % from this
    /// camera's; `None` if the cameras are compatible.
    pub fn difference(&self, other: &Self) -> Option<String> {
        [
            ("across", self.degrees_across(), other.degrees_across()),
            ("down", self.degrees_down(), other.degrees_down()),
        ]
        .into_iter()
        .find(|(_, ours, theirs)| (theirs / ours - 1.0).abs() > OTHER_VIEW)
        .map(|(side, ours, theirs)| {
            format!("sees {theirs:.1} degrees {side}, but the camera of the room {ours:.1}")
        })
    }

    /// Horizontal field of view, degrees.
    pub fn degrees_across(&self) -> f64 {
        self.degrees(self.centre.x, 1.0)
    }

    /// Vertical field of view, degrees.
    pub fn degrees_down(&self) -> f64 {
        self.degrees(self.centre.y, self.height)
    }

    /// Angle between the two edges of an image along one axis; `centre` is the principal point on
    /// it.
    fn degrees(&self, centre: f64, length: f64) -> f64 {
        let to_one = (centre / self.focal).atan();
        let to_other = ((length - centre) / self.focal).atan();
        (to_one + to_other).to_degrees()
    }

    /// Projection onto the plane at depth 1 of an image point, given in image widths from the top
    /// left corner.
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

    /// Oracle: by hand. A horizontal field of view of 90° has a focal length of half a width: the
    /// edge of the image is 45° from the center.
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

    /// Oracle: by hand. A focal length of 320 pixels at a width of 640 gives 45° to each side; an
    /// edge at the principal point adds 0°.
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

    /// Oracle: the definition. A focal length in image widths, a missing one, or a principal point
    /// for another image size is invalid.
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

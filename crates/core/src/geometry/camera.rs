//! Camera models: pinhole, Brown–Conrady and Kannala–Brandt.

use nalgebra::{Matrix2, Vector2, Vector3};

/// Why a camera is refused.
#[derive(Debug, thiserror::Error, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum CameraError {
    #[error(
        "images are {width} by {height} pixels; both must be above 0, and the aspect ratio at most 10"
    )]
    Size { width: f64, height: f64 },
    #[error(
        "the focal length is {focal} pixels; for images {width} pixels wide it must be 0.1 to 10 times the width"
    )]
    Focal { focal: f64, width: f64 },
    #[error(
        "the focal lengths {fx} and {fy} pixels differ by more than a factor of 2; check that both are in pixels"
    )]
    PixelAspect { fx: f64, fy: f64 },
    #[error("the principal point ({x}, {y}) lies outside images of {width} by {height} pixels")]
    Center {
        x: f64,
        y: f64,
        width: f64,
        height: f64,
    },
    #[error(
        "distortion coefficient {index} is {value}; every coefficient must be finite and between -100 and 100"
    )]
    Coefficient { index: usize, value: f64 },
    #[error(
        "the distortion folds the image: two directions share one image point inside the image. \
         Check the coefficients and their order"
    )]
    Folded,
}

/// Maximum relative difference between the fields of view of compatible cameras.
const OTHER_VIEW: f64 = 0.1;
/// Largest absolute value of a distortion coefficient.
const MAX_COEFFICIENT: f64 = 100.0;
/// Largest ratio of the two focal lengths.
const MAX_PIXEL_ASPECT: f64 = 2.0;
/// Maximum number of Newton steps that undistort a point.
const MAX_STEPS: usize = 20;
/// Newton's method has converged when a step is shorter than this, on the plane at depth 1.
const CONVERGED: f64 = 1e-12;

/// Lens distortion. Coefficients are those of OpenCV, on the plane at depth 1.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(rename_all = "snake_case", tag = "model", content = "coefficients")
)]
pub enum Distortion {
    /// No distortion: an ideal pinhole.
    #[default]
    None,
    /// Brown–Conrady, OpenCV's order (k1, k2, p1, p2, k3): radial k, tangential p. ROS calls it
    /// `plumb_bob`, COLMAP `OPENCV`.
    BrownConrady([f64; 5]),
    /// Kannala–Brandt, (k1, k2, k3, k4) of the angle to the optical axis. ROS calls it
    /// `equidistant`, COLMAP and OpenCV fisheye.
    KannalaBrandt([f64; 4]),
}

impl Distortion {
    /// Brown–Conrady distortion, [`Self::None`] if all coefficients are 0.
    pub fn brown_conrady(coefficients: [f64; 5]) -> Self {
        if coefficients == [0.0; 5] {
            Self::None
        } else {
            Self::BrownConrady(coefficients)
        }
    }

    /// The coefficients in their order.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::None => &[],
            Self::BrownConrady(coefficients) => coefficients,
            Self::KannalaBrandt(coefficients) => coefficients,
        }
    }

    /// The distorted point, and its derivative, at a point of the plane at depth 1.
    fn distort(&self, point: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        match *self {
            Self::None => (point, Matrix2::identity()),
            Self::BrownConrady([k1, k2, p1, p2, k3]) => {
                let [x, y] = [point.x, point.y];
                let r2 = point.norm_squared();
                let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                // Derivative of `radial` by r².
                let slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);

                let tangential = Vector2::new(
                    2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                );
                let mixed = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
                let derivative = Matrix2::new(
                    radial + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
                    mixed,
                    mixed,
                    radial + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
                );
                (point * radial + tangential, derivative)
            }
            Self::KannalaBrandt([k1, k2, k3, k4]) => {
                let r = point.norm();
                if r < 1e-8 {
                    return (point, Matrix2::identity());
                }

                let angle = r.atan();
                let a2 = angle * angle;
                let bent = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
                let by_angle =
                    1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
                let by_radius = by_angle / (1.0 + r * r);

                let direction = point / r;
                let along = direction * direction.transpose();
                let derivative = along * by_radius + (Matrix2::identity() - along) * (bent / r);
                (direction * bent, derivative)
            }
        }
    }
}

/// A camera in pixels, as in its calibration.
///
/// The top left corner of the image is at (0, 0), and the center of the first pixel at (0.5, 0.5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelCamera {
    /// Width of the images.
    pub width: f64,
    /// Height of the images.
    pub height: f64,
    /// Focal lengths along x and y.
    pub focal: Vector2<f64>,
    /// Principal point; `None` is the image center.
    pub center: Option<Vector2<f64>>,
    /// Lens distortion.
    pub distortion: Distortion,
}

/// The intrinsic parameters of a camera. Lengths are in image widths, so that they do not depend on
/// the image size. Image points are measured from the top left corner.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Serialize, serde::Deserialize),
    serde(try_from = "CameraFields", into = "CameraFields")
)]
pub struct CameraIntrinsics {
    focal: Vector2<f64>,
    height: f64,
    center: Vector2<f64>,
    distortion: Distortion,
}

/// The serialized form of [`CameraIntrinsics`]. Unit: image widths.
#[cfg(feature = "serde")]
#[derive(serde::Serialize, serde::Deserialize)]
struct CameraFields {
    focal: [f64; 2],
    height: f64,
    center: [f64; 2],
    distortion: Distortion,
}

#[cfg(feature = "serde")]
impl TryFrom<CameraFields> for CameraIntrinsics {
    type Error = CameraError;

    fn try_from(fields: CameraFields) -> Result<Self, CameraError> {
        Self::new(PixelCamera {
            width: 1.0,
            height: fields.height,
            focal: fields.focal.into(),
            center: Some(fields.center.into()),
            distortion: fields.distortion,
        })
    }
}

#[cfg(feature = "serde")]
impl From<CameraIntrinsics> for CameraFields {
    fn from(camera: CameraIntrinsics) -> Self {
        Self {
            focal: camera.focal.into(),
            height: camera.height,
            center: camera.center.into(),
            distortion: camera.distortion,
        }
    }
}

impl CameraIntrinsics {
    /// Validates a camera.
    ///
    /// # Errors
    /// [`CameraError`] if a number is out of its range, or if the distortion is not invertible
    /// within the image.
    pub fn new(camera: PixelCamera) -> Result<Self, CameraError> {
        let PixelCamera {
            width,
            height,
            focal,
            center,
            distortion,
        } = camera;

        // NaN is outside every range.
        if !(width.is_finite() && width > 0.0 && (0.1..=10.0).contains(&(height / width))) {
            return Err(CameraError::Size { width, height });
        }
        if let Some(&focal) = focal
            .iter()
            .find(|&focal| !(0.1..=10.0).contains(&(focal / width)))
        {
            return Err(CameraError::Focal { focal, width });
        }

        let [fx, fy] = [focal.x, focal.y];
        if !(1.0 / MAX_PIXEL_ASPECT..=MAX_PIXEL_ASPECT).contains(&(fx / fy)) {
            return Err(CameraError::PixelAspect { fx, fy });
        }

        let center = center.unwrap_or(Vector2::new(width, height) / 2.0);
        let [x, y] = [center.x, center.y];
        if !(0.0..=width).contains(&x) || !(0.0..=height).contains(&y) {
            return Err(CameraError::Center {
                x,
                y,
                width,
                height,
            });
        }

        for (index, &value) in distortion.coefficients().iter().enumerate() {
            if !(-MAX_COEFFICIENT..=MAX_COEFFICIENT).contains(&value) {
                return Err(CameraError::Coefficient { index, value });
            }
        }

        let camera = Self {
            focal: focal / width,
            height: height / width,
            center: center / width,
            distortion,
        };
        if !camera.is_invertible() {
            return Err(CameraError::Folded);
        }

        Ok(camera)
    }

    /// Focal lengths along x and y, image widths.
    pub fn focal(&self) -> Vector2<f64> {
        self.focal
    }

    /// Height of the images, image widths.
    pub fn height(&self) -> f64 {
        self.height
    }

    /// Principal point, image widths.
    pub fn center(&self) -> Vector2<f64> {
        self.center
    }

    /// Lens distortion.
    pub fn distortion(&self) -> Distortion {
        self.distortion
    }

    /// The same camera with both focal lengths multiplied by `factor`.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn zoomed(&self, factor: f64) -> Result<Self, CameraError> {
        self.with(self.focal * factor, self.distortion)
    }

    /// The same image size and principal point with other focal lengths, in image widths, and
    /// another distortion.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with(&self, focal: Vector2<f64>, distortion: Distortion) -> Result<Self, CameraError> {
        Self::new(PixelCamera {
            width: 1.0,
            height: self.height,
            focal,
            center: Some(self.center),
            distortion,
        })
    }

    /// The camera in pixels of images of the given width.
    pub fn in_pixels(&self, width: f64) -> PixelCamera {
        PixelCamera {
            width,
            height: self.height * width,
            focal: self.focal * width,
            center: Some(self.center * width),
            distortion: self.distortion,
        }
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

    /// Horizontal field of view through the principal point, degrees.
    pub fn degrees_across(&self) -> f64 {
        let y = self.center.y;
        self.degrees_between(Vector2::new(0.0, y), Vector2::new(1.0, y))
    }

    /// Vertical field of view through the principal point, degrees.
    pub fn degrees_down(&self) -> f64 {
        let x = self.center.x;
        self.degrees_between(Vector2::new(x, 0.0), Vector2::new(x, self.height))
    }

    /// Angle between the rays of two image points, degrees.
    fn degrees_between(&self, a: Vector2<f64>, b: Vector2<f64>) -> f64 {
        let ray = |point| self.to_image_plane(point).push(1.0);
        ray(a).angle(&ray(b)).to_degrees()
    }

    /// The undistorted point on the plane at depth 1 of an image point, image widths.
    ///
    /// Outside the image, where the distortion may have no inverse, the result is the closest that
    /// Newton's method found.
    pub fn to_image_plane(&self, point: Vector2<f64>) -> Vector2<f64> {
        let distorted = (point - self.center).component_div(&self.focal);
        self.undistort(distorted).unwrap_or(distorted)
    }

    /// The image point, image widths, of a direction in the camera frame; `None` if it is not in
    /// front of the camera.
    pub fn project(&self, direction: Vector3<f64>) -> Option<Vector2<f64>> {
        (direction.z > 1e-9).then(|| {
            let (distorted, _) = self.distortion.distort(direction.xy() / direction.z);
            distorted.component_mul(&self.focal) + self.center
        })
    }

    /// Derivative of [`Self::to_image_plane`] by the image point, at a point of the plane; zero
    /// where the distortion has no inverse.
    pub(crate) fn plane_derivative(&self, plane: Vector2<f64>) -> Matrix2<f64> {
        let (_, derivative) = self.distortion.distort(plane);
        let by_plane = Matrix2::from_diagonal(&self.focal) * derivative;
        by_plane.try_inverse().unwrap_or_else(Matrix2::zeros)
    }

    /// The undistorted point of a distorted one, both on the plane at depth 1; `None` if Newton's
    /// method does not converge.
    fn undistort(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
        if self.distortion == Distortion::None {
            return Some(distorted);
        }

        // A fisheye image at radius θ shows the direction at tan θ.
        let mut point = match self.distortion {
            Distortion::KannalaBrandt(_) => {
                let angle = distorted.norm().min(1.5);
                distorted * (angle.tan() / angle.max(1e-9)).max(1.0)
            }
            _ => distorted,
        };
        for _ in 0..MAX_STEPS {
            let (bent, derivative) = self.distortion.distort(point);
            let step = derivative.try_inverse()? * (distorted - bent);

            // A long step of Newton's method can leave the invertible part.
            let length = step.norm();
            let most = 0.5 * (1.0 + point.norm());
            point += if length > most {
                step * (most / length)
            } else {
                step
            };
            if length < CONVERGED {
                return point.iter().all(|x| x.is_finite()).then_some(point);
            }
        }

        None
    }

    /// Whether the distortion preserves orientation along the lines from the principal point to the
    /// border of the image, and every border point has an undistorted point.
    fn is_invertible(&self) -> bool {
        if self.distortion == Distortion::None {
            return true;
        }

        const STEPS: usize = 16;
        let border = (0..STEPS).flat_map(|step| {
            let along = step as f64 / STEPS as f64;
            [
                Vector2::new(along, 0.0),
                Vector2::new(1.0 - along, self.height),
                Vector2::new(0.0, (1.0 - along) * self.height),
                Vector2::new(1.0, along * self.height),
            ]
        });

        border.into_iter().all(|point| {
            let distorted = (point - self.center).component_div(&self.focal);
            let Some(end) = self.undistort(distorted) else {
                return false;
            };
            (0..=STEPS).all(|step| {
                let (_, derivative) = self.distortion.distort(end * (step as f64 / STEPS as f64));
                derivative.determinant() > 0.0
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photographs() -> PixelCamera {
        PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: Vector2::new(525.0, 525.0),
            center: None,
            distortion: Distortion::None,
        }
    }

    /// Oracle: by hand. A horizontal field of view of 90° has a focal length of half a width: the
    /// edge of the image is 45° from the center.
    #[test]
    fn the_edge_of_a_right_angle_is_one_away_on_the_plane() {
        let camera = CameraIntrinsics::new(PixelCamera {
            focal: Vector2::new(320.0, 320.0),
            ..photographs()
        })
        .unwrap();
        assert_eq!(
            camera.to_image_plane(Vector2::new(1.0, 0.375)),
            Vector2::new(1.0, 0.0)
        );
        assert!((camera.degrees_across() - 90.0).abs() < 1e-9);
        let down = 2.0 * (240.0_f64 / 320.0).atan().to_degrees();
        assert!((camera.degrees_down() - down).abs() < 1e-9);
    }

    /// Oracle: OpenCV 5.0.0's `projectPoints` (Brown–Conrady) and `fisheye.projectPoints`
    /// (Kannala–Brandt), for the direction (0.3, -0.2, 1) and a focal length of one image width.
    #[test]
    fn distortion_is_opencvs() {
        let project = |distortion| {
            let camera = CameraIntrinsics::new(PixelCamera {
                width: 1.0,
                height: 0.75,
                focal: Vector2::new(1.0, 1.0),
                center: Some(Vector2::new(0.5, 0.375)),
                distortion,
            })
            .unwrap();
            camera.project(Vector3::new(0.3, -0.2, 1.0)).unwrap() - camera.center()
        };

        let brown = project(Distortion::BrownConrady([-0.1, 0.02, 0.001, -0.002, 0.003]));
        assert!(
            (brown - Vector2::new(0.295_463_38, -0.197_018_92)).norm() < 1e-6,
            "{brown}"
        );
        let fisheye = project(Distortion::KannalaBrandt([-0.03, 0.01, -0.002, 0.0005]));
        assert!(
            (fisheye - Vector2::new(0.286_934_41, -0.191_289_61)).norm() < 1e-6,
            "{fisheye}"
        );
    }

    /// Oracle: the definition of an inverse, over the whole image.
    #[test]
    fn undistorting_inverts_the_projection() {
        let lenses = [
            Distortion::None,
            Distortion::BrownConrady([-0.28, 0.07, 0.0002, -0.0001, 0.0]),
            Distortion::BrownConrady([0.1, -0.2, 0.01, 0.005, 0.1]),
            Distortion::KannalaBrandt([-0.03, 0.01, -0.002, 0.0005]),
        ];

        for distortion in lenses {
            let camera = CameraIntrinsics::new(PixelCamera {
                distortion,
                ..photographs()
            })
            .unwrap();
            for (x, y) in (0..=20).flat_map(|x| (0..=15).map(move |y| (x, y))) {
                let point = Vector2::new(f64::from(x), f64::from(y)) / 20.0;
                let ray = camera.to_image_plane(point).push(1.0);
                let back = camera.project(ray).unwrap();
                assert!((back - point).norm() < 1e-9, "{distortion:?} {point}");
            }
        }
    }

    /// Oracle: the definition. A focal length in image widths, a missing one, a principal point for
    /// another image size, or a distortion that folds the image is invalid.
    #[test]
    fn what_no_camera_has_is_refused() {
        for focal in [0.9, 0.0, -585.0, f64::NAN, f64::INFINITY] {
            let camera = PixelCamera {
                focal: Vector2::new(525.0, focal),
                ..photographs()
            };
            assert!(matches!(
                CameraIntrinsics::new(camera),
                Err(CameraError::Focal { .. })
            ));
        }

        let outside = PixelCamera {
            center: Some(Vector2::new(960.0, 540.0)),
            ..photographs()
        };
        assert!(matches!(
            CameraIntrinsics::new(outside),
            Err(CameraError::Center { .. })
        ));

        for width in [0.0, -640.0, f64::NAN] {
            let camera = PixelCamera {
                width,
                ..photographs()
            };
            assert!(matches!(
                CameraIntrinsics::new(camera),
                Err(CameraError::Size { .. })
            ));
        }

        let folded = PixelCamera {
            distortion: Distortion::BrownConrady([-2.0, 0.0, 0.0, 0.0, 0.0]),
            ..photographs()
        };
        assert_eq!(CameraIntrinsics::new(folded), Err(CameraError::Folded));
    }
}

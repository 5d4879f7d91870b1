//! Pose conventions and their conversion to `world_from_camera`.

use std::fmt;

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion};

use seese3_core::geometry::Pose;

/// Directions of a camera's axes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Axes {
    /// x right, y down, z forward: OpenCV, COLMAP, ROS optical frames, and this project.
    #[default]
    OpenCv,
    /// x right, y up, z backward: OpenGL, Blender, NeRF, ARKit.
    OpenGl,
    /// x forward, y left, z up: robot bodies in ROS.
    Ros,
}

/// Direction of the transform that a pose stores.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Direction {
    /// From camera to world coordinates; the translation is the camera's position.
    #[default]
    WorldFromCamera,
    /// From world to camera coordinates: the inverse, as in COLMAP.
    CameraFromWorld,
}

/// Order of a quaternion's components.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum QuaternionOrder {
    /// The order that the format defines.
    #[default]
    Stated,
    /// (w, x, y, z), although the format defines (x, y, z, w).
    ScalarFirst,
}

/// A convention for storing camera poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Convention {
    /// The camera's axes.
    pub axes: Axes,
    /// The direction of the transform.
    pub direction: Direction,
    /// Clockwise quarter turns of the images relative to the camera of the poses, 0 to 3.
    pub image_quarter_turns: u8,
    /// The order of quaternion components.
    pub quaternions: QuaternionOrder,
}

impl Convention {
    /// Converts a pose in this convention to `world_from_camera` with image axes x right, y down,
    /// z forward.
    pub fn to_world_from_camera(self, stated: &Pose) -> Pose {
        let mut pose = *stated;
        if self.quaternions == QuaternionOrder::ScalarFirst {
            // The numbers were read as (x, y, z, w), but are (w, x, y, z).
            let read = pose.rotation.quaternion();
            let meant = Quaternion::new(read.i, read.j, read.k, read.w);
            pose.rotation = UnitQuaternion::from_quaternion(meant);
        }
        if self.direction == Direction::CameraFromWorld {
            pose = pose.inverse();
        }

        pose * stated_from_optical(self.axes) * camera_from_turned_image(self.image_quarter_turns)
    }

    /// Every convention that the check tries: this project's first, common ones before rare ones.
    pub fn all() -> Vec<Self> {
        let mut all = Vec::new();
        for image_quarter_turns in 0..4 {
            for axes in [Axes::OpenCv, Axes::OpenGl, Axes::Ros] {
                for direction in [Direction::WorldFromCamera, Direction::CameraFromWorld] {
                    all.push(Self {
                        axes,
                        direction,
                        image_quarter_turns,
                        quaternions: QuaternionOrder::Stated,
                    });
                }
            }
        }

        for direction in [Direction::WorldFromCamera, Direction::CameraFromWorld] {
            all.push(Self {
                direction,
                quaternions: QuaternionOrder::ScalarFirst,
                ..Self::default()
            });
        }
        all
    }
}

/// The transform and its axes, such as `world_from_camera along x right, y down, z forward`.
impl fmt::Display for Convention {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.direction {
            Direction::WorldFromCamera => "world_from_camera",
            Direction::CameraFromWorld => "camera_from_world, the inverse,",
        })?;
        f.write_str(match self.axes {
            Axes::OpenCv => " along x right, y down, z forward",
            Axes::OpenGl => " along OpenGL's axes",
            Axes::Ros => " along the axes of a ROS body",
        })?;
        if self.quaternions == QuaternionOrder::ScalarFirst {
            f.write_str(", with the scalar of quaternions first")?;
        }
        if self.image_quarter_turns > 0 {
            let degrees = 90 * u16::from(self.image_quarter_turns);
            write!(f, ", of images turned clockwise by {degrees} degrees")?;
        }
        Ok(())
    }
}

fn rotation(rows: [[f64; 3]; 3]) -> UnitQuaternion<f64> {
    let matrix = Matrix3::from_fn(|row, column| rows[row][column]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix))
}

/// Rotation from x right, y down, z forward to the stated axes.
fn stated_from_optical(axes: Axes) -> UnitQuaternion<f64> {
    match axes {
        Axes::OpenCv => UnitQuaternion::identity(),
        Axes::OpenGl => rotation([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
        Axes::Ros => rotation([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    }
}

/// Rotation from the axes of a turned image to those of the unturned camera.
fn camera_from_turned_image(quarter_turns: u8) -> UnitQuaternion<f64> {
    // In an image turned clockwise by a quarter, right was up before.
    let angle = -std::f64::consts::FRAC_PI_2 * f64::from(quarter_turns);
    UnitQuaternion::from_axis_angle(&nalgebra::Vector3::z_axis(), angle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Translation3, Vector3};

    /// Oracle: by hand. A camera at (1, 2, 3) looks along the world's x axis, with the world's z
    /// axis up in its image: right in its image is −y, down is −z.
    #[test]
    fn each_convention_is_read() {
        let optical = rotation([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]);
        let pose = Pose::from_parts(Translation3::new(1.0, 2.0, 3.0), optical);
        let seen = pose * Point3::new(0.0, 0.0, 5.0);
        assert!((seen - Point3::new(6.0, 2.0, 3.0)).norm() < 1e-12);

        // A robot body that faces the world's x axis has the identity rotation.
        let body = Pose::from_parts(pose.translation, UnitQuaternion::identity());
        // In OpenGL's axes the camera looks along its −z, and its y is up: the world's z.
        let gl = rotation([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        let gl = Pose::from_parts(pose.translation, gl);

        let of = |axes, direction| Convention {
            axes,
            direction,
            ..Convention::default()
        };
        let cases = [
            (Axes::OpenCv, Direction::WorldFromCamera, pose),
            (Axes::OpenCv, Direction::CameraFromWorld, pose.inverse()),
            (Axes::Ros, Direction::WorldFromCamera, body),
            (Axes::OpenGl, Direction::WorldFromCamera, gl),
            (Axes::OpenGl, Direction::CameraFromWorld, gl.inverse()),
        ];
        for (axes, direction, stated) in cases {
            let found = of(axes, direction).to_world_from_camera(&stated);
            let off = (found.to_homogeneous() - pose.to_homogeneous()).norm();
            assert!(off < 1e-12, "{axes:?} {direction:?}");
        }

        // An image turned clockwise by a quarter: up, the world's z, becomes right.
        let turned = Convention {
            image_quarter_turns: 1,
            ..Convention::default()
        };
        let right = turned.to_world_from_camera(&pose).rotation * Vector3::x();
        assert!((right - Vector3::z()).norm() < 1e-12);

        // A file's (w, x, y, z) = (0.5, 0.5, −0.5, 0.5) read as (x, y, z, w).
        let mixed = Pose::from_parts(
            pose.translation,
            UnitQuaternion::from_quaternion(Quaternion::new(0.5, 0.5, 0.5, -0.5)),
        );
        let convention = Convention {
            quaternions: QuaternionOrder::ScalarFirst,
            ..Convention::default()
        };
        let found = convention.to_world_from_camera(&mixed).rotation;
        let meant = UnitQuaternion::from_quaternion(Quaternion::new(0.5, 0.5, -0.5, 0.5));
        assert!(found.angle_to(&meant) < 1e-12);
    }
}

//! Ways in which translations can be wrong while rotations are right.

use nalgebra::Vector3;

use seese3_core::geometry::Pose;

/// How translations were written down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Translations {
    /// The camera's position is made of these of its numbers, each with a sign: the stated x, y and z
    /// are 0, 1 and 2.
    Axes([(usize, f64); 3]),
    /// They are those of the inverse, `camera_from_world`, beside rotations of `world_from_camera`.
    OfTheInverse,
}

impl Translations {
    /// As they are stated.
    pub const STATED: Self = Self::Axes([(0, 1.0), (1, 1.0), (2, 1.0)]);

    /// Every way that a mistake may be, with the stated one first.
    pub(super) fn all() -> Vec<Self> {
        let orders = [
            [0, 1, 2],
            [0, 2, 1],
            [1, 0, 2],
            [1, 2, 0],
            [2, 0, 1],
            [2, 1, 0],
        ];

        let mut all = Vec::new();
        for order in orders {
            for signs in 0..8_u8 {
                let sign = |axis: usize| if signs >> axis & 1 == 0 { 1.0 } else { -1.0 };
                let axes = [0, 1, 2].map(|axis| (order[axis], sign(axis)));
                all.push(Self::Axes(axes));
            }
        }
        all.push(Self::OfTheInverse);
        all
    }

    /// The pose that is meant.
    pub(super) fn meant(self, world_from_camera: &Pose) -> Pose {
        let stated = world_from_camera.translation.vector;
        let rotation = world_from_camera.rotation;
        let position = match self {
            Self::Axes(axes) => Vector3::from(axes.map(|(axis, sign)| sign * stated[axis])),
            Self::OfTheInverse => -(rotation * stated),
        };

        Pose::from_parts(position.into(), rotation)
    }
}

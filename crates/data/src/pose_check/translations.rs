//! Variants of wrong translations with right rotations, as tried by the check.

use nalgebra::Vector3;

use seese3_core::geometry::Pose;

/// The relation of stated translations to camera positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Translations {
    /// Each coordinate of the camera's position is a stated coordinate (0, 1 or 2 for x, y, z)
    /// times a sign.
    Axes([(usize, f64); 3]),
    /// Translations of `camera_from_world`, combined with rotations of `world_from_camera`.
    OfTheInverse,
}

impl Translations {
    /// Positions as stated.
    pub const STATED: Self = Self::Axes([(0, 1.0), (1, 1.0), (2, 1.0)]);

    /// Every variant that the check tries, with the stated one first.
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

    /// The pose with its translation reinterpreted.
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

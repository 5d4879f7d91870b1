//! Boxes and their ray intersections.

use nalgebra::{Point3, Vector3};

use super::texture::{Color, Material};

/// A box, rotated about the vertical axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Solid {
    pub center: Point3<f64>,
    /// Half of the length of each side, meters.
    pub half: Vector3<f64>,
    /// Cosine and sine of the rotation.
    pub cos: f64,
    pub sin: f64,
    pub material: Material,
    pub seed: u32,
}

/// A ray; its direction has length 1.
pub(super) struct Ray {
    pub origin: Point3<f64>,
    pub direction: Vector3<f64>,
}

/// The surface point at the end of a ray.
pub(super) struct Surface {
    /// Distance from the ray's origin, meters.
    pub distance: f64,
    pub normal: Vector3<f64>,
    pub color: Color,
    /// Emitted light, as a factor of the color; nonzero for windows and the lamp's panel.
    pub glow: f64,
    /// Coordinates on the surface, meters, and the seed of its texture.
    pub place: Place,
}

/// A place on a surface: coordinates in meters, and the seed of the surface's texture.
pub(super) struct Place {
    pub u: f64,
    pub v: f64,
    pub seed: u32,
}

impl Solid {
    /// Rotates a vector from room axes to the box's axes.
    pub fn turned_back(&self, v: Vector3<f64>) -> Vector3<f64> {
        Vector3::new(
            self.cos * v.x + self.sin * v.y,
            self.cos * v.y - self.sin * v.x,
            v.z,
        )
    }

    /// The point where a ray enters the box, if within `limit`, meters.
    pub fn touch(&self, ray: &Ray, limit: f64) -> Option<Touch<'_>> {
        let origin = self.turned_back(ray.origin - self.center);
        let direction = self.turned_back(ray.direction);
        let mut enter = f64::NEG_INFINITY;
        let mut leave = f64::INFINITY;

        let mut axis = 0;

        // Slab method: the ray is inside the box between the last of the three front planes and the
        // first of the three back planes.
        for candidate in 0..3 {
            let inverse = direction[candidate].recip();
            let a = (-self.half[candidate] - origin[candidate]) * inverse;
            let b = (self.half[candidate] - origin[candidate]) * inverse;
            if a.min(b) > enter {
                enter = a.min(b);
                axis = candidate;
            }

            leave = leave.min(a.max(b));
        }

        // A ray that starts inside the box or on its surface does not hit it.
        if !(enter > 1e-6 && enter < leave && enter < limit) {
            return None;
        }

        Some(Touch {
            solid: self,
            distance: enter,
            axis,
            origin,
            direction,
        })
    }
}

/// The point where a ray enters a box; origin and direction are in box coordinates.
pub(super) struct Touch<'a> {
    solid: &'a Solid,
    /// Distance from the ray's origin, meters.
    pub distance: f64,
    axis: usize,
    origin: Vector3<f64>,
    direction: Vector3<f64>,
}

impl Touch<'_> {
    /// The surface at this point.
    pub fn surface(&self) -> Surface {
        let &Touch {
            solid,
            distance,
            axis,
            origin,
            direction,
        } = self;

        let at = origin + direction * distance;
        let mut normal = Vector3::zeros();
        normal[axis] = -direction[axis].signum();
        let front = axis == 1 && normal.y > 0.0;

        let (u, v) = match axis {
            0 => (at.y, at.z),
            1 => (at.x, at.z),
            _ => (at.x, at.y),
        };

        // Heights start at the bottom of the box, so that rows of books and boards align.
        let v = if axis == 2 { v } else { v + solid.half.z };
        let color = solid.material.color(u, v, front, solid.seed);

        // Rotate the normal back to world coordinates.
        let normal = Vector3::new(
            solid.cos * normal.x - solid.sin * normal.y,
            solid.sin * normal.x + solid.cos * normal.y,
            normal.z,
        );

        Surface {
            distance,
            normal,
            color,
            glow: 0.0,
            place: Place {
                u,
                v,
                seed: solid.seed,
            },
        }
    }
}

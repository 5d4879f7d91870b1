//! Shading: the nearest surface along a ray, lit by a lamp with shadows, a window and ambient
//! light.

use nalgebra::{Point3, Vector3};

use super::Scene;
use super::solid::{Place, Ray, Solid, Surface};
use super::texture::{Color, detail};

/// Offset of a shadow ray's origin from its surface, meters, which prevents self-shadowing.
pub(super) const LIFT_M: f64 = 1e-3;

/// The light and distance at the end of a ray.
#[derive(Debug, Clone, Copy)]
pub(super) struct LitPoint {
    pub light: [f64; 3],
    /// Distance from the ray's origin, meters.
    pub distance: f64,
}

impl Scene {
    /// Traces a ray through the room and `candidates`, the boxes that it may hit.
    ///
    /// `spread` is the size of a pixel at distance 1; finer detail is not rendered.
    pub(super) fn seen<'a>(
        &'a self,
        ray: &Ray,
        candidates: impl Iterator<Item = &'a Solid>,
        spread: f64,
    ) -> LitPoint {
        // Every ray ends at the shell. This distance limits the search for nearer boxes, and every
        // hit tightens the limit.
        let (mut limit, axis) = self.shell_reach(ray);
        let mut nearest = None;
        for solid in candidates {
            if let Some(nearer) = solid.touch(ray, limit) {
                limit = nearer.distance;
                nearest = Some(nearer);
            }
        }

        let mut surface = match nearest {
            Some(touch) => touch.surface(),
            None => self.shell_surface(ray, limit, axis),
        };

        if self.detail > 0.0 && surface.glow == 0.0 {
            let Place { u, v, seed } = surface.place;
            let finest = surface.distance * spread;
            surface.color = surface
                .color
                .scaled(detail(u, v, finest, self.detail, seed));
        }

        LitPoint {
            light: self.lit(&surface, ray),
            distance: surface.distance,
        }
    }

    fn lit(&self, surface: &Surface, ray: &Ray) -> [f64; 3] {
        // Lambertian light: the cosine of the angle to the lamp, with a distance falloff softened
        // near the lamp.
        let at = ray.origin + ray.direction * surface.distance;
        let normal = surface.normal;
        let light = &self.light;

        let to_lamp = self.lamp - at;
        let distance = to_lamp.norm();
        let facing = normal.dot(&to_lamp).max(0.0) / distance;
        let dark = facing <= 0.0
            || light.lamp <= 0.0
            || self.blocked(at + normal * LIFT_M, to_lamp / distance, distance - 0.05);

        let lamp = if dark {
            0.0
        } else {
            light.lamp * facing / (0.7 + 0.35 * distance * distance)
        };

        // A window is large and its shadows are soft, so they are omitted.
        let window = light.window.map_or(0.0, |(from, brightness)| {
            let to_window = from - at;
            let distance = to_window.norm();
            let facing = normal.dot(&to_window).max(0.0) / distance.max(1e-6);

            brightness * (0.15 + facing) / (1.0 + 0.3 * distance * distance)
        });

        // Ambient light is stronger on surfaces that face up. Within about 20 cm of floor, walls
        // and ceiling it is weaker, an approximation of ambient occlusion.
        let sky = light.sky + 0.12 * normal.z;

        let edge = [
            at.x,
            self.size.x - at.x,
            at.y,
            self.size.y - at.y,
            at.z,
            self.size.z - at.z,
        ];

        let corner: f64 = edge
            .iter()
            .map(|d| 1.0 - 0.35 * (-d.max(0.0) / 0.22).exp())
            .product();

        // A shell surface lies on one of these planes, which darkens it by 0.65: undo that factor.
        // The limit of 1 is for furniture, which lies on none of the planes.
        let ambient = sky * (corner / 0.65).min(1.0);

        std::array::from_fn(|c| {
            surface.color.0[c] * (ambient + lamp * light.lamp_tint[c] + window + surface.glow)
        })
    }

    fn blocked(&self, origin: Point3<f64>, direction: Vector3<f64>, distance: f64) -> bool {
        let ray = Ray { origin, direction };
        self.shade.towards(-direction).iter().any(|&solid| {
            self.solids[usize::from(solid)]
                .touch(&ray, distance)
                .is_some()
        })
    }

    /// Distance from the ray's origin, inside the room, to the plane (floor, ceiling or wall) where
    /// it leaves the room, and the axis of that plane.
    pub(super) fn shell_reach(&self, ray: &Ray) -> (f64, usize) {
        let mut distance = f64::INFINITY;
        let mut axis = 0;
        for candidate in 0..3 {
            let speed = ray.direction[candidate];
            let edge = if speed > 0.0 {
                self.size[candidate]
            } else {
                0.0
            };
            let reach = (edge - ray.origin[candidate]) / speed;

            // A ray parallel to a plane has an infinite or NaN reach, which is never the smallest
            // positive reach.
            if reach > 0.0 && reach < distance {
                distance = reach;
                axis = candidate;
            }
        }

        (distance, axis)
    }

    pub(super) fn shell_surface(&self, ray: &Ray, distance: f64, axis: usize) -> Surface {
        let at = ray.origin + ray.direction * distance;
        let mut normal = Vector3::zeros();
        normal[axis] = -ray.direction[axis].signum();

        // Axis and direction identify the plane. The coordinate along each wall runs
        // counterclockwise, seen from above, like the wall numbers.
        let on_wall = |wall: u32, along: f64| {
            let (color, glow) = self.wall_color(wall as usize, along, at.z);
            (color, glow, along, at.z, wall)
        };

        let (color, glow, u, v, plane): (Color, f64, f64, f64, u32) =
            match (axis, ray.direction[axis] > 0.0) {
                (2, false) => (self.floor_color(at.x, at.y), 0.0, at.x, at.y, 4),
                (2, true) => {
                    let (color, glow) = self.ceiling_color(at.x, at.y);
                    (color, glow, at.x, at.y, 5)
                }
                (1, false) => on_wall(0, at.x),
                (0, true) => on_wall(1, at.y),
                (1, true) => on_wall(2, self.size.x - at.x),
                (_, _) => on_wall(3, self.size.y - at.y),
            };

        Surface {
            distance,
            normal,
            color,
            glow,
            place: Place {
                u,
                v,
                seed: self.shell.seed ^ (plane << 8),
            },
        }
    }
}

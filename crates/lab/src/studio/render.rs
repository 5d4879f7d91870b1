//! Ray casting: what a camera in a scene sees, lit by a lamp that casts shadows and by ambient
//! light.

use nalgebra::{Point3, Vector3};

use super::texture::Colour;
use super::{Piece, Scene, Solid};
use seese3_core::geometry::Pose;
use seese3_core::image::RgbImage;

/// Rays along each side of a pixel: 2 × 2 in all.
const SUPERSAMPLING: usize = 2;
/// The largest difference of light between a pixel's corners that needs no rays inside the pixel.
const CALM: f64 = 0.04;

/// Which rays make a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sampling {
    /// Four rays inside every pixel.
    Full,
    /// Four rays at the corners, shared with the neighbouring pixels; where these differ, four rays
    /// inside the pixel instead.
    Adaptive,
}

/// A pinhole camera with square pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Angle of view across the width, radians.
    pub field_of_view_rad: f64,
    /// Which rays make a pixel.
    pub sampling: Sampling,
}

impl Camera {
    /// A camera of 64×48 pixels that sees 75° across.
    pub fn small() -> Self {
        Self {
            width: 64,
            height: 48,
            field_of_view_rad: 75f64.to_radians(),
            sampling: Sampling::Full,
        }
    }

    /// A camera of this size that sees 75° across, with adaptive sampling.
    pub fn sized(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            field_of_view_rad: 75f64.to_radians(),
            sampling: Sampling::Adaptive,
        }
    }

    /// The side of a pixel on the image plane at distance 1.
    fn pixel(&self) -> f64 {
        2.0 * (self.field_of_view_rad / 2.0).tan() / self.width as f64
    }

    /// The ray through a point of the image, in pixels from the top left corner; `scale` is
    /// [`Camera::pixel`].
    fn ray(&self, scale: f64, world_from_camera: &Pose, column: f64, row: f64) -> Ray {
        let x = (column - self.width as f64 / 2.0) * scale;
        let y = (row - self.height as f64 / 2.0) * scale;
        let direction = world_from_camera * Vector3::new(x, y, 1.0).normalize();

        Ray {
            origin: world_from_camera.translation.vector.into(),
            direction,
        }
    }
}

struct Ray {
    origin: Point3<f64>,
    direction: Vector3<f64>,
}

struct Surface {
    distance: f64,
    normal: Vector3<f64>,
    colour: Colour,
    /// Emitted light, as a factor of the colour: windows, and the lamp's panel on the ceiling.
    glow: f64,
}

/// The image that `camera` takes at `world_from_camera`, which must lie inside the room.
pub fn render(scene: &Scene, camera: Camera, world_from_camera: &Pose) -> RgbImage {
    let Camera { width, height, .. } = camera;
    let scale = camera.pixel();
    let seen = |column: f64, row: f64| {
        scene
            .seen(&camera.ray(scale, world_from_camera, column, row))
            .0
    };

    // The mean light of a regular grid of rays inside the pixel.
    let inner = |column: usize, row: usize| {
        let mut light = [0.0; 3];
        for sample in 0..SUPERSAMPLING * SUPERSAMPLING {
            let shift = |part: usize| (part as f64 + 0.5) / SUPERSAMPLING as f64;
            let ray = seen(
                column as f64 + shift(sample % SUPERSAMPLING),
                row as f64 + shift(sample / SUPERSAMPLING),
            );
            (0..3).for_each(|c| light[c] += ray[c]);
        }

        light.map(|channel| channel / (SUPERSAMPLING * SUPERSAMPLING) as f64)
    };

    let corners = |row: usize| -> Vec<[f64; 3]> {
        (0..=width)
            .map(|column| seen(column as f64, row as f64))
            .collect()
    };

    let mut bytes = Vec::with_capacity(width * height * 3);

    // Adaptive sampling shares the rays through corners: of every row only the lower corners are
    // new.
    let mut above = if camera.sampling == Sampling::Adaptive {
        corners(0)
    } else {
        Vec::new()
    };

    for row in 0..height {
        let below = if camera.sampling == Sampling::Adaptive {
            corners(row + 1)
        } else {
            Vec::new()
        };

        for column in 0..width {
            let light = match camera.sampling {
                Sampling::Full => inner(column, row),
                Sampling::Adaptive => {
                    let around = [
                        above[column],
                        above[column + 1],
                        below[column],
                        below[column + 1],
                    ];
                    calm(&around).unwrap_or_else(|| inner(column, row))
                }
            };

            bytes.extend(light.map(to_srgb));
        }

        above = below;
    }

    RgbImage {
        width,
        height,
        bytes,
    }
}

/// The mean light of a pixel's corners, if they differ by no more than [`CALM`].
fn calm(corners: &[[f64; 3]; 4]) -> Option<[f64; 3]> {
    let mut mean = [0.0; 3];
    for (c, value) in mean.iter_mut().enumerate() {
        // The image clips light at 1, so that differences above it do not show.
        let of = corners.map(|corner| corner[c].min(1.0));
        let low = of.into_iter().fold(f64::INFINITY, f64::min);
        let high = of.into_iter().fold(0.0, f64::max);
        if high - low > CALM {
            return None;
        }

        *value = of.iter().sum::<f64>() / 4.0;
    }

    Some(mean)
}

fn to_srgb(light: f64) -> u8 {
    (255.0 * light.clamp(0.0, 1.0).powf(1.0 / 2.2)).round() as u8
}

impl Scene {
    fn seen(&self, ray: &Ray) -> Colour {
        // A ray always ends at the shell. That distance limits the search for nearer furniture,
        // and every hit limits it further.
        let (mut limit, axis) = self.shell_reach(ray);
        let mut nearest = None;
        for piece in &self.pieces {
            if let Some(nearer) = piece.touch(ray, limit) {
                limit = nearer.distance;
                nearest = Some(nearer);
            }
        }

        let surface = match nearest {
            Some(touch) => touch.surface(),
            None => self.shell_surface(ray, limit, axis),
        };

        self.lit(&surface, ray)
    }

    fn lit(&self, surface: &Surface, ray: &Ray) -> Colour {
        // Diffuse (Lambertian) light: the cosine of the angle to the lamp, and a falloff with
        // distance that is softened near the lamp. The shadow ray begins 1 mm off the surface,
        // which would otherwise shadow itself.
        let at = ray.origin + ray.direction * surface.distance;
        let normal = surface.normal;
        let to_lamp = self.lamp - at;
        let distance = to_lamp.norm();
        let facing = normal.dot(&to_lamp).max(0.0) / distance;
        let shadowed =
            facing > 0.0 && self.blocked(at + normal * 1e-3, to_lamp / distance, distance - 0.05);

        let light = &self.light;
        let lamp = if shadowed {
            0.0
        } else {
            light.lamp * facing / (0.7 + 0.35 * distance * distance)
        };

        // Ambient light is stronger on surfaces that face up, and weaker within some 20 cm of
        // floor, walls and ceiling, as an approximation of ambient occlusion.
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

        // A surface of the shell lies on one of these planes itself, which has darkened it by 0.65:
        // that factor is taken back. The limit of 1 is for furniture, which lies on none of them.
        let ambient = sky * (corner / 0.65).min(1.0);
        let lit =
            |c: usize| surface.colour.0[c] * (ambient + lamp * light.lamp_tint[c] + surface.glow);

        Colour(std::array::from_fn(lit))
    }

    fn blocked(&self, origin: Point3<f64>, direction: Vector3<f64>, distance: f64) -> bool {
        let ray = Ray { origin, direction };
        self.pieces.iter().any(|piece| piece.is_met(&ray, distance))
    }

    /// Distance from inside the room to the first plane (floor, ceiling or wall) through which the
    /// ray leaves, and the axis of that plane.
    fn shell_reach(&self, ray: &Ray) -> (f64, usize) {
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

            // A ray parallel to a plane has an infinite or undefined reach, which is never the
            // smallest positive one.
            if reach > 0.0 && reach < distance {
                distance = reach;
                axis = candidate;
            }
        }

        (distance, axis)
    }

    fn shell_surface(&self, ray: &Ray, distance: f64, axis: usize) -> Surface {
        let at = ray.origin + ray.direction * distance;
        let mut normal = Vector3::zeros();
        normal[axis] = -ray.direction[axis].signum();

        // Axis and direction name the plane. Along each wall the coordinate runs
        // counterclockwise, seen from above, as the walls are numbered.
        let (colour, glow) = match (axis, ray.direction[axis] > 0.0) {
            (2, false) => (self.floor_colour(at.x, at.y), 0.0),
            (2, true) => self.ceiling_colour(at.x, at.y),
            (1, false) => self.wall_colour(0, at.x, at.z),
            (0, true) => self.wall_colour(1, at.y, at.z),
            (1, true) => self.wall_colour(2, self.size.x - at.x, at.z),
            (_, _) => self.wall_colour(3, self.size.y - at.y, at.z),
        };

        Surface {
            distance,
            normal,
            colour,
            glow,
        }
    }
}

impl Piece {
    /// Whether a ray may meet the piece within `limit`, metres: whether it crosses the bounding
    /// sphere.
    fn is_near(&self, ray: &Ray, limit: f64) -> bool {
        let to_centre = self.centre - ray.origin;
        let along = to_centre.dot(&ray.direction);

        // `off` is the squared distance of the centre from the ray's line.
        let off = to_centre.norm_squared() - along * along;
        !(off > self.radius * self.radius || along < -self.radius || along - self.radius > limit)
    }

    /// Whether a ray meets any box of the piece within `limit`, metres.
    fn is_met(&self, ray: &Ray, limit: f64) -> bool {
        self.is_near(ray, limit)
            && self
                .solids
                .iter()
                .any(|solid| solid.touch(ray, limit).is_some())
    }

    /// Where a ray first enters a box of the piece, if within `limit`, metres.
    fn touch(&self, ray: &Ray, limit: f64) -> Option<Touch<'_>> {
        if !self.is_near(ray, limit) {
            return None;
        }

        let mut nearest: Option<Touch<'_>> = None;
        for solid in &self.solids {
            let limit = nearest.as_ref().map_or(limit, |touch| touch.distance);
            nearest = solid.touch(ray, limit).or(nearest);
        }

        nearest
    }
}

impl Solid {
    /// Where a ray enters the box, if within `limit`, metres.
    fn touch(&self, ray: &Ray, limit: f64) -> Option<Touch<'_>> {
        // The inverse of the box's rotation about the vertical axis.
        let turn_back = |v: Vector3<f64>| {
            Vector3::new(
                self.cos * v.x + self.sin * v.y,
                self.cos * v.y - self.sin * v.x,
                v.z,
            )
        };

        let origin = turn_back(ray.origin - self.centre);
        let direction = turn_back(ray.direction);
        let mut enter = f64::NEG_INFINITY;
        let mut leave = f64::INFINITY;

        let mut axis = 0;

        // The slab method: the ray is inside the box from the last of the three front planes that
        // it passes to the first of the three back planes.
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

        // A ray that begins inside the box or on its surface does not count as entering it.
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

/// Where a ray enters a box; origin and direction are in the box's own coordinates.
struct Touch<'a> {
    solid: &'a Solid,
    distance: f64,
    axis: usize,
    origin: Vector3<f64>,
    direction: Vector3<f64>,
}

impl Touch<'_> {
    fn surface(&self) -> Surface {
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

        // Heights are counted from the bottom of the box, so that rows of books and boards line up.
        let v = if axis == 2 { v } else { v + solid.half.z };
        let colour = solid.material.colour(u, v, front, solid.seed);

        // Back into world coordinates, by the box's rotation about the vertical axis.
        let normal = Vector3::new(
            solid.cos * normal.x - solid.sin * normal.y,
            solid.sin * normal.x + solid.cos * normal.y,
            normal.z,
        );

        Surface {
            distance,
            normal,
            colour,
            glow: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: geometry by hand. A camera in the middle that looks along x meets the wall at half
    /// the room's width.
    #[test]
    fn the_far_wall_is_half_a_room_away() {
        let mut scene = Scene::new(3);
        scene.pieces.clear();
        let origin = Point3::from(scene.size() / 2.0);
        let ray = Ray {
            origin,
            direction: Vector3::x(),
        };

        let (reach, axis) = scene.shell_reach(&ray);
        let surface = scene.shell_surface(&ray, reach, axis);
        assert!((surface.distance - scene.size().x / 2.0).abs() < 1e-12);
        assert_eq!(surface.normal, -Vector3::x());
    }

    /// Oracle: the definition of deterministic, and that another seed is another room.
    #[test]
    fn a_seed_gives_one_image_and_another_seed_another() {
        let camera = Camera {
            width: 16,
            height: 12,
            field_of_view_rad: 1.3,
            sampling: Sampling::Full,
        };

        let image = |seed| {
            let scene = Scene::new(seed);
            render(
                &scene,
                camera,
                &super::super::camera_path(&scene, 1, seed)[0],
            )
        };

        assert_eq!(image(5), image(5));
        assert_ne!(image(5), image(6));
    }

    /// Oracle: four rays in every pixel. Where corners agree nothing is missed but what is smaller
    /// than a pixel, so the two pictures differ by little on the whole.
    #[test]
    fn adaptive_sampling_sees_what_full_sampling_sees() {
        let scene = Scene::new(4);
        let pose = super::super::camera_path(&scene, 1, 4)[0];
        let adaptive = Camera::sized(160, 120);
        let full = Camera {
            sampling: Sampling::Full,
            ..adaptive
        };

        let a = render(&scene, adaptive, &pose);
        let b = render(&scene, full, &pose);

        let mean = a
            .bytes
            .iter()
            .zip(&b.bytes)
            .map(|(a, b)| f64::from(a.abs_diff(*b)))
            .sum::<f64>()
            / a.bytes.len() as f64;

        assert!(mean < 1.5, "mean difference {mean} levels");
    }
}

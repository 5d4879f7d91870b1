//! Ray casting: what a camera in a scene sees, with a lamp, its shadows and daylight.

use nalgebra::{Point3, Vector3};

use super::texture::{Colour, fractal, hash2, noise, picture, wood};
use super::{Floor, Panel, PanelKind, Piece, Scene, Solid};
use crate::geometry::Pose;
use crate::image::RgbImage;

/// Rays a side of a pixel.
const SUPERSAMPLING: usize = 2;

/// A pinhole camera with square pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Across the width, radians.
    pub field_of_view_rad: f64,
}

impl Camera {
    /// A camera of 64×48 pixels that sees 75° across.
    pub fn small() -> Self {
        Self { width: 64, height: 48, field_of_view_rad: 75f64.to_radians() }
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
    /// Share of its own light: windows and screens.
    glow: f64,
}

/// The image that `camera` takes at `world_from_camera`, which must lie inside the room.
pub fn render(scene: &Scene, camera: Camera, world_from_camera: &Pose) -> RgbImage {
    let Camera { width, height, field_of_view_rad } = camera;
    let scale = 2.0 * (field_of_view_rad / 2.0).tan() / width as f64;
    let mut bytes = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        for column in 0..width {
            let mut light = [0.0; 3];
            for sample in 0..SUPERSAMPLING * SUPERSAMPLING {
                let shift = |part: usize| (part as f64 + 0.5) / SUPERSAMPLING as f64;
                let x = (column as f64 + shift(sample % SUPERSAMPLING) - width as f64 / 2.0) * scale;
                let y = (row as f64 + shift(sample / SUPERSAMPLING) - height as f64 / 2.0) * scale;
                let direction = world_from_camera * Vector3::new(x, y, 1.0).normalize();
                let ray = Ray { origin: world_from_camera.translation.vector.into(), direction };
                let seen = scene.seen(&ray);
                (0..3).for_each(|c| light[c] += seen.0[c]);
            }
            let samples = (SUPERSAMPLING * SUPERSAMPLING) as f64;
            bytes.extend(light.map(|channel| to_srgb(channel / samples)));
        }
    }
    RgbImage { width, height, bytes }
}

fn to_srgb(light: f64) -> u8 {
    (255.0 * light.clamp(0.0, 1.0).powf(1.0 / 2.2)).round() as u8
}

impl Scene {
    fn seen(&self, ray: &Ray) -> Colour {
        let mut surface = self.shell_surface(ray);
        for piece in &self.pieces {
            if let Some(nearer) = piece.surface(ray, surface.distance) {
                surface = nearer;
            }
        }
        self.lit(&surface, ray)
    }

    fn lit(&self, surface: &Surface, ray: &Ray) -> Colour {
        let at = ray.origin + ray.direction * surface.distance;
        let normal = surface.normal;
        let to_lamp = self.lamp - at;
        let distance = to_lamp.norm();
        let facing = normal.dot(&to_lamp).max(0.0) / distance;
        let shadowed = facing > 0.0 && self.blocked(at + normal * 1e-3, to_lamp / distance, distance - 0.05);
        let lamp = if shadowed { 0.0 } else { 1.9 * facing / (0.7 + 0.35 * distance * distance) };
        let sky = 0.30 + 0.12 * normal.z;
        let edge = [at.x, self.size.x - at.x, at.y, self.size.y - at.y, at.z, self.size.z - at.z];
        let corner: f64 = edge.iter().map(|d| 1.0 - 0.35 * (-d.max(0.0) / 0.22).exp()).product();
        // A surface lies on one edge plane itself: take that one's darkening back.
        let ambient = sky * (corner / 0.65).min(1.0);
        surface.colour.scaled(ambient + lamp + surface.glow)
    }

    fn blocked(&self, origin: Point3<f64>, direction: Vector3<f64>, distance: f64) -> bool {
        let ray = Ray { origin, direction };
        self.pieces.iter().any(|piece| piece.surface(&ray, distance).is_some())
    }

    /// Floor, ceiling or wall: the first plane that a ray from inside leaves through.
    fn shell_surface(&self, ray: &Ray) -> Surface {
        let (mut distance, mut axis) = (f64::INFINITY, 0);
        for candidate in 0..3 {
            let speed = ray.direction[candidate];
            let edge = if speed > 0.0 { self.size[candidate] } else { 0.0 };
            let reach = (edge - ray.origin[candidate]) / speed;
            // A ray along a plane never meets it: its reach is infinite or, of either sign, meaningless.
            if reach > 0.0 && reach < distance {
                (distance, axis) = (reach, candidate);
            }
        }
        let at = ray.origin + ray.direction * distance;
        let mut normal = Vector3::zeros();
        normal[axis] = -ray.direction[axis].signum();
        let (colour, glow) = match (axis, ray.direction[axis] > 0.0) {
            (2, false) => (self.floor_colour(at.x, at.y), 0.0),
            (2, true) => self.ceiling_colour(at.x, at.y),
            (1, false) => self.wall_colour(0, at.x, at.z),
            (0, true) => self.wall_colour(1, at.y, at.z),
            (1, true) => self.wall_colour(2, self.size.x - at.x, at.z),
            (_, _) => self.wall_colour(3, self.size.y - at.y, at.z),
        };
        Surface { distance, normal, colour, glow }
    }

    fn floor_colour(&self, x: f64, y: f64) -> Colour {
        let (shell, rug) = (&self.shell, &self.shell.rug);
        if inside([x, y], rug.low, rug.high) {
            let border = !inside([x, y], rug.low.map(|v| v + 0.12), rug.high.map(|v| v - 0.12));
            let diamond = ((x * 4.0).rem_euclid(1.0) - 0.5).abs() + ((y * 4.0).rem_euclid(1.0) - 0.5).abs() < 0.32;
            let colour = rug.colours[usize::from(border || diamond)];
            return colour.scaled(0.8 + 0.2 * noise(x * 50.0, y * 50.0, shell.seed));
        }
        match shell.floor {
            Floor::Planks(colour) => {
                let plank = (y / 0.14).floor();
                let along = x + 0.9 * hash2(plank as i64, 1, shell.seed);
                let tone = 0.75 + 0.45 * hash2(plank as i64, (along / 1.1).floor() as i64, shell.seed);
                let seam = (y / 0.14).rem_euclid(1.0) < 0.05 || (along / 1.1).rem_euclid(1.0) < 0.008;
                wood(colour, along, y, shell.seed).scaled(if seam { 0.4 } else { tone })
            }
            Floor::Tiles(colour) => {
                let (i, j) = ((x / 0.4).floor(), (y / 0.4).floor());
                let grout = (x / 0.4).rem_euclid(1.0) < 0.03 || (y / 0.4).rem_euclid(1.0) < 0.03;
                let tone = 0.7 + 0.3 * hash2(i as i64, j as i64, shell.seed);
                let cloud = 0.85 + 0.3 * fractal(x * 3.0, y * 3.0, shell.seed);
                if grout { Colour([0.25, 0.25, 0.25]) } else { colour.scaled(tone * cloud) }
            }
        }
    }

    fn ceiling_colour(&self, x: f64, y: f64) -> (Colour, f64) {
        let lamp = inside([x, y], [self.lamp.x - 0.3, self.lamp.y - 0.3], [self.lamp.x + 0.3, self.lamp.y + 0.3]);
        let beam = (x / 1.3).rem_euclid(1.0) < 0.07;
        let colour = Colour::WHITE.scaled(if beam { 0.7 } else { 0.95 });
        (colour, if lamp { 1.0 } else { 0.0 })
    }

    fn wall_colour(&self, wall: usize, along: f64, up: f64) -> (Colour, f64) {
        let shell = &self.shell;
        let on = |panel: &&Panel| inside([along, up], panel.low, panel.high);
        if let Some(panel) = shell.panels[wall].iter().find(on) {
            return panel_colour(panel, along, up);
        }
        if up < 0.1 {
            return (Colour::WHITE.scaled(0.8), 0.0);
        }
        let plaster = 0.9 + 0.14 * fractal(along * 2.5, up * 2.5, shell.seed ^ wall as u32);
        (shell.wall_colours[wall].scaled(plaster), 0.0)
    }
}

fn panel_colour(panel: &Panel, along: f64, up: f64) -> (Colour, f64) {
    let (u, v) = (along - panel.low[0], up - panel.low[1]);
    let frame = if panel.kind == PanelKind::Door { 0.07 } else { 0.04 };
    let framed = !inside([along, up], panel.low.map(|x| x + frame), panel.high.map(|x| x - frame));
    match panel.kind {
        PanelKind::Picture if framed => (Colour([0.12, 0.09, 0.06]), 0.0),
        PanelKind::Picture => (picture(u, v, panel.seed), 0.0),
        PanelKind::Window => {
            let middle = (panel.high[0] - panel.low[0]) / 2.0;
            if framed || (u - middle).abs() < 0.03 {
                return (Colour::WHITE, 0.2);
            }
            let height = v / (panel.high[1] - panel.low[1]);
            let hills = 0.35 + 0.2 * fractal(u * 2.0, 0.0, panel.seed);
            if height < hills {
                (Colour([0.2, 0.38, 0.15]).scaled(0.6 + 0.8 * noise(u * 9.0, v * 9.0, panel.seed)), 0.6)
            } else {
                (Colour([0.55, 0.7, 0.9]).mixed(Colour([0.9, 0.93, 0.95]), 1.0 - height), 0.9)
            }
        }
        PanelKind::Door if framed => (Colour::WHITE.scaled(0.75), 0.0),
        PanelKind::Door => {
            let handle = (u - 0.75).abs() < 0.05 && (v - 1.0).abs() < 0.03;
            let fill = (0.2..0.7).contains(&u) && ((0.25..0.9).contains(&v) || (1.1..1.8).contains(&v));
            let timber = Colour::of_hue(0.07, 0.5, if fill { 0.38 } else { 0.5 });
            (if handle { Colour([0.7, 0.65, 0.4]) } else { wood(timber, v, u, panel.seed) }, 0.0)
        }
    }
}

impl Piece {
    /// The nearest box of the piece that a ray meets within `limit`, metres.
    fn surface(&self, ray: &Ray, limit: f64) -> Option<Surface> {
        let to_centre = self.centre - ray.origin;
        let along = to_centre.dot(&ray.direction);
        let off = to_centre.norm_squared() - along * along;
        if off > self.radius * self.radius || along < -self.radius || along - self.radius > limit {
            return None;
        }
        let mut nearest: Option<Surface> = None;
        for solid in &self.solids {
            let limit = nearest.as_ref().map_or(limit, |surface| surface.distance);
            nearest = solid.surface(ray, limit).or(nearest);
        }
        nearest
    }
}

impl Solid {
    /// Where a ray enters the box, if within `limit`, metres.
    fn surface(&self, ray: &Ray, limit: f64) -> Option<Surface> {
        let turn_back =
            |v: Vector3<f64>| Vector3::new(self.cos * v.x + self.sin * v.y, self.cos * v.y - self.sin * v.x, v.z);
        let (origin, direction) = (turn_back(ray.origin - self.centre), turn_back(ray.direction));
        let (mut enter, mut leave, mut axis) = (f64::NEG_INFINITY, f64::INFINITY, 0);
        for candidate in 0..3 {
            let inverse = direction[candidate].recip();
            let (a, b) = (
                (-self.half[candidate] - origin[candidate]) * inverse,
                (self.half[candidate] - origin[candidate]) * inverse,
            );
            if a.min(b) > enter {
                (enter, axis) = (a.min(b), candidate);
            }
            leave = leave.min(a.max(b));
        }
        if !(enter > 1e-6 && enter < leave && enter < limit) {
            return None;
        }
        let at = origin + direction * enter;
        let mut normal = Vector3::zeros();
        normal[axis] = -direction[axis].signum();
        let front = axis == 1 && normal.y > 0.0;
        let (u, v) = match axis {
            0 => (at.y, at.z),
            1 => (at.x, at.z),
            _ => (at.x, at.y),
        };
        // Heights are counted from the floor of the piece, so that shelves and boards line up.
        let v = if axis == 2 { v } else { v + self.half.z };
        let colour = self.material.colour(u, v, front, self.seed);
        let normal = Vector3::new(
            self.cos * normal.x - self.sin * normal.y,
            self.sin * normal.x + self.cos * normal.y,
            normal.z,
        );
        Some(Surface { distance: enter, normal, colour, glow: 0.0 })
    }
}

fn inside(point: [f64; 2], low: [f64; 2], high: [f64; 2]) -> bool {
    (0..2).all(|c| point[c] >= low[c] && point[c] <= high[c])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: geometry by hand. A camera in the middle that looks along x meets the wall at half the room's width.
    #[test]
    fn the_far_wall_is_half_a_room_away() {
        let mut scene = Scene::new(3);
        scene.pieces.clear();
        let origin = Point3::from(scene.size() / 2.0);
        let surface = scene.shell_surface(&Ray { origin, direction: Vector3::x() });
        assert!((surface.distance - scene.size().x / 2.0).abs() < 1e-12);
        assert_eq!(surface.normal, -Vector3::x());
    }

    /// Oracle: the definition of deterministic, and that another seed is another room.
    #[test]
    fn a_seed_gives_one_image_and_another_seed_another() {
        let camera = Camera { width: 16, height: 12, field_of_view_rad: 1.3 };
        let image = |seed| {
            let scene = Scene::new(seed);
            render(&scene, camera, &super::super::camera_path(&scene, 1, seed)[0])
        };
        assert_eq!(image(5), image(5));
        assert_ne!(image(5), image(6));
    }
}

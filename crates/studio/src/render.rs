//! Ray casting: renders the image of a camera in a scene.

use nalgebra::{Point3, Vector3};

use super::Scene;
use super::candidates::Spheres;
use super::light::LitPoint;
use super::solid::{Ray, Solid};
use seese3_core::geometry::Pose;
use seese3_core::image::RgbImage;

/// Rays along each side of a pixel: 2 × 2 in total.
const SUPERSAMPLING: usize = 2;

/// Maximum difference of light between a pixel's corners without additional rays inside the pixel.
const CALM: f64 = 0.04;

/// Sampling pattern of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sampling {
    /// Four rays inside every pixel.
    Full,
    /// Four rays at the corners, shared with neighboring pixels. If these differ, four rays inside
    /// the pixel replace them.
    Adaptive,
    /// Four rays at the corners, shared with neighboring pixels. If these differ, a ray in the
    /// middle is added with half of the total weight. Images are softer and need about half the
    /// rays.
    Quincunx,
}

/// A pinhole camera with square pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Horizontal field of view, radians.
    pub field_of_view_rad: f64,
    /// Sampling pattern of a pixel.
    pub sampling: Sampling,
}

impl Camera {
    /// A camera of 64 × 48 pixels with a horizontal field of view of 75°.
    pub fn small() -> Self {
        Self {
            width: 64,
            height: 48,
            field_of_view_rad: 75f64.to_radians(),
            sampling: Sampling::Full,
        }
    }

    /// A camera of this size with a horizontal field of view of 75° and adaptive sampling.
    pub fn sized(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            field_of_view_rad: 75f64.to_radians(),
            sampling: Sampling::Adaptive,
        }
    }

    /// The side of a pixel on the image plane at distance 1.
    pub(super) fn pixel(&self) -> f64 {
        2.0 * (self.field_of_view_rad / 2.0).tan() / self.width as f64
    }

    /// The ray through a point of the image, in pixels from the top left corner; `scale` is
    /// [`Camera::pixel`].
    pub(super) fn ray(&self, scale: f64, world_from_camera: &Pose, column: f64, row: f64) -> Ray {
        let x = (column - self.width as f64 / 2.0) * scale;
        let y = (row - self.height as f64 / 2.0) * scale;
        let direction = world_from_camera * Vector3::new(x, y, 1.0).normalize();

        Ray {
            origin: world_from_camera.translation.vector.into(),
            direction,
        }
    }
}

/// Linear light and surface distance of every pixel, before the camera model is applied.
#[derive(Debug, Clone)]
pub(super) struct Radiance {
    pub width: usize,
    pub height: usize,
    /// Linear light in red, green and blue, row by row; 1 is white in a plain image.
    pub light: Vec<[f64; 3]>,
    /// Distance from the camera's center, meters, row by row.
    pub distance: Vec<f32>,
}

/// Renders the image of `camera` at `world_from_camera`, which must be inside the room.
pub fn render(scene: &Scene, camera: Camera, world_from_camera: &Pose) -> RgbImage {
    let radiance = radiance(scene, &[], camera, world_from_camera, 1.0);

    RgbImage {
        width: radiance.width,
        height: radiance.height,
        bytes: radiance
            .light
            .iter()
            .flat_map(|light| light.map(to_srgb))
            .collect(),
    }
}

/// The light that reaches `camera` at `world_from_camera` from a room and from `others`, boxes that
/// cast no shadow.
///
/// Rays shared between pixels are clipped at brightness `ceiling`: 1 for an image that clips light
/// there, infinity for a camera that sets its exposure afterward.
pub(super) fn radiance(
    scene: &Scene,
    others: &[Solid],
    camera: Camera,
    world_from_camera: &Pose,
    ceiling: f64,
) -> Radiance {
    let Camera { width, height, .. } = camera;
    let view = View {
        scene,
        others,
        camera,
        scale: camera.pixel(),
        world_from_camera,
        ceiling,
        tiles: Tiles::new(&scene.solids, camera, world_from_camera),
    };

    let mut light = Vec::with_capacity(width * height);
    let mut distance = Vec::with_capacity(width * height);

    // Corner rays are shared: each row adds only its lower corners.
    let mut above = view.corners(0);
    for row in 0..height {
        let below = view.corners(row + 1);

        for column in 0..width {
            let pixel = if camera.sampling == Sampling::Full {
                view.inner(column, row)
            } else {
                let around = [
                    above[column],
                    above[column + 1],
                    below[column],
                    below[column + 1],
                ];
                view.shared(&around, column, row)
            };

            light.push(pixel.light);
            distance.push(pixel.distance as f32);
        }

        above = below;
    }

    Radiance {
        width,
        height,
        light,
        distance,
    }
}

/// A scene and the camera that it is rendered for.
struct View<'a> {
    scene: &'a Scene,
    others: &'a [Solid],
    camera: Camera,
    /// [`Camera::pixel`].
    scale: f64,
    world_from_camera: &'a Pose,
    /// Maximum brightness of a shared ray.
    ceiling: f64,
    tiles: Tiles,
}

impl View<'_> {
    /// Traces the ray through a point of the image, in pixels from the top left corner.
    fn seen(&self, column: f64, row: f64) -> LitPoint {
        let ray = self
            .camera
            .ray(self.scale, self.world_from_camera, column, row);
        let candidates = self
            .tiles
            .at(column, row)
            .iter()
            .map(|&solid| &self.scene.solids[usize::from(solid)])
            .chain(self.others);

        self.scene.seen(&ray, candidates, self.scale)
    }

    /// Traces the rays through the upper corners of a row; empty if pixels share no rays.
    fn corners(&self, row: usize) -> Vec<LitPoint> {
        if self.camera.sampling == Sampling::Full {
            return Vec::new();
        }

        (0..=self.camera.width)
            .map(|column| self.seen(column as f64, row as f64))
            .collect()
    }

    /// A pixel from its four corners, with rays inside it if the corners differ.
    fn shared(&self, around: &[LitPoint; 4], column: usize, row: usize) -> LitPoint {
        let around = &around.map(|corner| LitPoint {
            light: corner.light.map(|channel| channel.min(self.ceiling)),
            ..corner
        });
        if calm(around) {
            return mean(around);
        }
        if self.camera.sampling == Sampling::Adaptive {
            return self.inner(column, row);
        }

        let corners = mean(around);
        let middle = self.seen(column as f64 + 0.5, row as f64 + 0.5);

        LitPoint {
            light: std::array::from_fn(|c| (corners.light[c] + middle.light[c]) / 2.0),
            distance: corners.distance.min(middle.distance),
        }
    }

    /// A pixel from a regular grid of rays inside it.
    fn inner(&self, column: usize, row: usize) -> LitPoint {
        let mut light = [0.0; 3];
        let mut distance = f64::INFINITY;
        for sample in 0..SUPERSAMPLING * SUPERSAMPLING {
            let shift = |part: usize| (part as f64 + 0.5) / SUPERSAMPLING as f64;
            let ray = self.seen(
                column as f64 + shift(sample % SUPERSAMPLING),
                row as f64 + shift(sample / SUPERSAMPLING),
            );
            (0..3).for_each(|c| light[c] += ray.light[c]);
            distance = distance.min(ray.distance);
        }

        let light = light.map(|channel| channel / (SUPERSAMPLING * SUPERSAMPLING) as f64);
        LitPoint { light, distance }
    }
}

/// Candidate boxes for the rays of each tile of an image.
struct Tiles {
    across: usize,
    down: usize,
    solids: Vec<Vec<u16>>,
}

impl Tiles {
    /// Pixels along each side of a tile.
    const SIDE: usize = 16;

    fn new(solids: &[Solid], camera: Camera, world_from_camera: &Pose) -> Self {
        let across = camera.width.div_ceil(Self::SIDE);
        let down = camera.height.div_ceil(Self::SIDE);
        let scale = camera.pixel();
        let apex = Point3::from(world_from_camera.translation.vector);

        let spheres = Spheres::around(apex, solids, 0.0);
        let solids = (0..across * down)
            .map(|tile| {
                let left = (tile % across * Self::SIDE) as f64;
                let top = (tile / across * Self::SIDE) as f64;
                let side = Self::SIDE as f64;
                let towards = |right: f64, below: f64| {
                    camera
                        .ray(scale, world_from_camera, left + right, top + below)
                        .direction
                };
                let corners = [
                    towards(0.0, 0.0),
                    towards(side, 0.0),
                    towards(0.0, side),
                    towards(side, side),
                ];

                spheres.met(towards(side / 2.0, side / 2.0), &corners)
            })
            .collect();

        Self {
            across,
            down,
            solids,
        }
    }

    /// Candidate boxes for the ray through a point of the image, pixels from the top left corner.
    fn at(&self, column: f64, row: f64) -> &[u16] {
        // The image's right and lower edges belong to its last tiles.
        let across = (column as usize / Self::SIDE).min(self.across - 1);
        let down = (row as usize / Self::SIDE).min(self.down - 1);

        &self.solids[down * self.across + across]
    }
}

/// Whether the light at a pixel's corners differs by at most [`CALM`].
fn calm(corners: &[LitPoint; 4]) -> bool {
    (0..3).all(|c| {
        let of = corners.map(|corner| corner.light[c]);
        let low = of.into_iter().fold(f64::INFINITY, f64::min);
        let high = of.into_iter().fold(0.0, f64::max);

        high - low <= CALM
    })
}

/// The mean light of a pixel's corners, and the distance of the nearest.
fn mean(corners: &[LitPoint; 4]) -> LitPoint {
    let light =
        std::array::from_fn(|c| corners.iter().map(|corner| corner.light[c]).sum::<f64>() / 4.0);
    let distance = corners
        .iter()
        .map(|corner| corner.distance)
        .fold(f64::INFINITY, f64::min);

    LitPoint { light, distance }
}

fn to_srgb(light: f64) -> u8 {
    (255.0 * light.clamp(0.0, 1.0).powf(1.0 / 2.2)).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: geometry by hand. From the center, a ray along x hits the wall at half the room's
    /// width.
    #[test]
    fn the_far_wall_is_half_a_room_away() {
        let mut scene = Scene::new(3);
        scene.solids.clear();
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

    /// Oracle: one seed always gives the same image, and two seeds give different images.
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

    /// Oracle: full sampling. If the corners agree, only detail smaller than a pixel is missed, so
    /// the mean difference of the two images is small.
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

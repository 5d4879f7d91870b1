//! The studio: procedural rooms, rendered by ray casting. They provide images with exact poses
//! without a data set.
//!
//! - World axes: x and y along the floor, z up, meters. The floor is z = 0, and one corner of the
//!   room is at (0, 0).
//! - Everything is deterministic for a seed. The camera is a pinhole with square pixels.
//!
//! ```
//! use seese3_studio::{Camera, Scene, camera_path, render};
//!
//! let scene = Scene::new(7);
//! let path = camera_path(&scene, 3, 7);
//! let image = render(&scene, Camera::small(), &path[0]);
//! assert_eq!(image.bytes.len(), image.width * image.height * 3);
//! ```

mod camera_path;
mod candidates;
mod texture;
mod hand_held;
mod solid;
mod surfaces;
mod furniture;
mod light;
mod render;
mod suite;
mod photograph;
mod film;
mod visits;
mod suites;

pub use camera_path::camera_path;
pub use film::{Film, Variation};
pub use render::{Camera, Sampling, render};
pub use suite::{SuiteRoom, Walk};
pub use suites::Suite;

use nalgebra::{Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use candidates::Shade;
use solid::Solid;
use texture::Color;

/// Frame rate of a recording, frames per second.
const FRAMES_PER_SECOND: f64 = 30.0;

/// A furnished room.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Width (x), depth (y) and height (z), meters.
    size: Vector3<f64>,
    shell: Shell,
    solids: Vec<Solid>,
    lamp: Point3<f64>,
    light: Light,
    /// Index of the boxes that may lie between the lamp and a point.
    shade: Shade,
    /// Strength of the fine detail of all surfaces, 0 to 1.
    detail: f64,
}

/// Lighting of a room.
#[derive(Debug, Clone, Copy)]
struct Light {
    /// Brightness of the lamp on a surface that faces it at about one meter.
    lamp: f64,
    /// Tint of the lamp: factors of red, green and blue.
    lamp_tint: [f64; 3],
    /// Ambient light, from all directions.
    sky: f64,
    /// Center of the window and brightness of its light; `None` without daylight or window.
    window: Option<(Point3<f64>, f64)>,
    /// Brightness factor of the lamp's panel on the ceiling.
    panel: f64,
    /// Brightness factor of the view through a window.
    daylight: f64,
}

impl Light {
    const PLAIN: Self = Self {
        lamp: 1.9,
        lamp_tint: [1.0; 3],
        sky: 0.30,
        window: None,
        panel: 1.0,
        daylight: 1.0,
    };
}

/// Surfaces of the floor, the walls and the ceiling.
#[derive(Debug, Clone)]
struct Shell {
    seed: u32,
    wall_colors: [Color; 4],
    wallpaper: Wallpaper,
    floor: Floor,
    /// Rectangles on each wall, in wall coordinates (along, up), meters.
    panels: [Vec<Panel>; 4],
    rug: Rug,
}

#[derive(Debug, Clone, Copy)]
enum Floor {
    Planks(Color),
    Tiles(Color),
    Carpet(Color),
}

/// Pattern of the walls; lengths in meters.
#[derive(Debug, Clone, Copy)]
enum Wallpaper {
    None,
    /// Vertical stripes with this period.
    Stripes(f64),
    /// Boards from the floor up to this height.
    Boards(f64),
    Bricks,
}

/// A rectangle on a wall.
#[derive(Debug, Clone, Copy)]
struct Panel {
    low: [f64; 2],
    high: [f64; 2],
    kind: PanelKind,
    seed: u32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum PanelKind {
    Picture,
    Window,
    Door,
    Note,
}

/// A rectangle on the floor.
#[derive(Debug, Clone, Copy)]
struct Rug {
    low: [f64; 2],
    high: [f64; 2],
    colors: [Color; 2],
}

impl Scene {
    /// The room of a seed, 4.4 to 6.4 m by 3.8 to 5.2 m. It has furniture along its walls and a
    /// table in the middle.
    pub fn new(seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let size = Vector3::new(
            random.random_range(4.4..6.4),
            random.random_range(3.8..5.2),
            random.random_range(2.5..2.9),
        );
        let shell = Shell::new(size, &mut random);

        let solids = furniture::furnish(size, &mut random);

        let lamp = Point3::new(
            size.x * random.random_range(0.4..0.6),
            size.y * random.random_range(0.4..0.6),
            size.z - 0.25,
        );

        Self::lit_by(size, shell, solids, lamp, Light::PLAIN)
    }

    /// A room of `size`, meters, with its lamp at `lamp`.
    fn lit_by(
        size: Vector3<f64>,
        shell: Shell,
        solids: Vec<Solid>,
        lamp: Point3<f64>,
        light: Light,
    ) -> Self {
        let mut scene = Self {
            size,
            shell,
            solids,
            lamp,
            light,
            shade: Shade::default(),
            detail: 0.0,
        };
        scene.shade_lamp();

        scene
    }

    /// Rebuilds the index of boxes around the lamp. Must be called after any box has moved.
    fn shade_lamp(&mut self) {
        self.shade = Shade::new(self.lamp, &self.solids, light::LIFT_M);
    }

    /// Width (x), depth (y) and height (z), meters.
    pub fn size(&self) -> Vector3<f64> {
        self.size
    }
}

impl Shell {
    fn new(size: Vector3<f64>, random: &mut ChaCha8Rng) -> Self {
        // One of the four walls has an accent color.
        let base = Color::of_hue(random.random_range(0.0..1.0), 0.22, 0.78);
        let accent = Color::of_hue(random.random_range(0.0..1.0), 0.45, 0.6);
        let accent_wall = random.random_range(0..4);
        let wall_colors =
            std::array::from_fn(|wall| if wall == accent_wall { accent } else { base });

        let wood = Color::of_hue(
            random.random_range(0.05..0.1),
            0.55,
            random.random_range(0.35..0.6),
        );

        let tile = Color::of_hue(random.random_range(0.0..1.0), 0.15, 0.65);
        let floor = if random.random_bool(0.6) {
            Floor::Planks(wood)
        } else {
            Floor::Tiles(tile)
        };

        // The window is never in the door's wall.
        let door_wall = random.random_range(0..4);
        let window_wall = (door_wall + random.random_range(1..4)) % 4;

        // Walls are numbered counterclockwise, seen from above, from the wall y = 0: the even
        // ones run along x.
        let panels = std::array::from_fn(|wall| {
            let length = if wall % 2 == 0 { size.x } else { size.y };

            let feature = if wall == door_wall {
                Some(PanelKind::Door)
            } else if wall == window_wall {
                Some(PanelKind::Window)
            } else {
                None
            };

            wall_panels(length, feature, random)
        });

        let center = [size.x * 0.5, size.y * 0.5];
        let half = [random.random_range(0.8..1.3), random.random_range(0.6..1.0)];

        let rug = Rug {
            low: [center[0] - half[0], center[1] - half[1]],
            high: [center[0] + half[0], center[1] + half[1]],
            colors: [
                Color::of_hue(random.random_range(0.0..1.0), 0.6, 0.45),
                Color::of_hue(random.random_range(0.0..1.0), 0.3, 0.75),
            ],
        };

        Self {
            seed: random.random(),
            wall_colors,
            wallpaper: Wallpaper::None,
            floor,
            panels,
            rug,
        }
    }
}

impl Shell {
    /// Desaturates the walls: a `share` of 0 gives gray, 1 changes nothing.
    fn fade(&mut self, share: f64) {
        for color in &mut self.wall_colors {
            let grey = color.0.iter().sum::<f64>() / 3.0;
            *color = Color([grey; 3]).mixed(*color, share);
        }
    }

    /// Adds notes and prints to the walls, at most three per meter.
    fn pin_up(&mut self, size: Vector3<f64>, random: &mut ChaCha8Rng) {
        for (wall, panels) in self.panels.iter_mut().enumerate() {
            let length = if wall.is_multiple_of(2) {
                size.x
            } else {
                size.y
            };
            let notes = length * random.random_range(0.2..3.0);

            for _ in 0..notes as usize {
                let [width, height] = [0, 1].map(|_| random.random_range(0.08..0.4));
                let low = [
                    random.random_range(0.1..length - width - 0.1),
                    random.random_range(0.4..(size.z - height - 0.2)),
                ];

                panels.push(Panel {
                    low,
                    high: [low[0] + width, low[1] + height],
                    kind: PanelKind::Note,
                    seed: random.random(),
                });
            }
        }
    }
}

/// The panels of one wall: the optional door or window, and pictures.
fn wall_panels(length: f64, feature: Option<PanelKind>, random: &mut ChaCha8Rng) -> Vec<Panel> {
    let mut panels = Vec::new();
    let mut taken = None;
    if let Some(kind) = feature {
        let (width, low, high) = if kind == PanelKind::Door {
            (0.9, 0.0, 2.05)
        } else {
            (1.5, 0.95, 2.15)
        };

        let middle = length * random.random_range(0.35..0.65);
        let from = middle - width / 2.0;
        let to = middle + width / 2.0;

        panels.push(Panel {
            low: [from, low],
            high: [to, high],
            kind,
            seed: random.random(),
        });

        // Keep pictures 15 cm away from the door or window.
        taken = Some((from - 0.15, to + 0.15));
    }

    // Each third of the wall gets a picture, unless it would overlap the door or window or come
    // within 10 cm of a corner.
    for slot in 0..3 {
        let middle = length * (f64::from(slot) + 0.5) / 3.0 + random.random_range(-0.2..0.2);
        let width = random.random_range(0.4..0.9);
        let height = random.random_range(0.4..0.7);
        let from = middle - width / 2.0;

        let to = middle + width / 2.0;
        if taken.is_some_and(|(low, high)| from < high && to > low)
            || from < 0.1
            || to > length - 0.1
        {
            continue;
        }

        let bottom = random.random_range(1.25..1.5);
        panels.push(Panel {
            low: [from, bottom],
            high: [to, bottom + height],
            kind: PanelKind::Picture,
            seed: random.random(),
        });
    }

    panels
}

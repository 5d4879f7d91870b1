//! A suite of rooms: many that differ in size, furniture, texture and light, and in how the camera
//! goes through them.
//!
//! The ways are the paper's difficulty factors: dense revisits, a single pass, a corridor.
//! Everything follows from the suite's seed and the room's number; adding rooms changes none that
//! are there.

use nalgebra::{Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::camera_path::{Way, along, around};
use super::texture::Colour;
use super::{Floor, Light, Scene, Shell, Wallpaper, furniture};
use crate::geometry::Pose;

/// How the camera goes through a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Walk {
    /// Round and round in the middle of a room: every place is seen several times.
    Revisits,
    /// Across a room once.
    SinglePass,
    /// Along a corridor once.
    Corridor,
}

impl Walk {
    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Revisits => "revisits",
            Self::SinglePass => "single-pass",
            Self::Corridor => "corridor",
        }
    }
}

/// One room of a suite.
#[derive(Debug, Clone)]
pub struct SuiteRoom {
    /// What is seen.
    pub scene: Scene,
    /// How the camera goes.
    pub walk: Walk,
    seed: u64,
}

impl SuiteRoom {
    /// Room `number` of the suite of `seed`: of twenty rooms nine are revisited, six passed once,
    /// five corridors.
    pub fn new(seed: u64, number: u32) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(u64::from(number) + 16);
        let seed = random.random();

        let walk = match random.random_range(0..20) {
            0..9 => Walk::Revisits,
            9..15 => Walk::SinglePass,
            _ => Walk::Corridor,
        };
        let size = size(walk, &mut random);
        let mut shell = Shell::new(size, &mut random);

        decorate(&mut shell, walk, size, &mut random);

        let pieces = match walk {
            Walk::Corridor => furniture::furnish_corridor(size, &mut random),
            Walk::Revisits | Walk::SinglePass => furniture::furnish_loosely(size, &mut random),
        };

        let lamp = Point3::new(
            size.x * random.random_range(0.35..0.65),
            size.y * random.random_range(0.4..0.6),
            size.z - random.random_range(0.15..0.45),
        );

        let warm = random.random_range(0.0..1.0);
        let light = Light {
            lamp: random.random_range(1.0..2.6) * if walk == Walk::Corridor { 1.6 } else { 1.0 },
            lamp_tint: [1.08, 1.0 - 0.06 * warm, 1.05 - 0.38 * warm],
            sky: random.random_range(0.18..0.42),
        };

        Self {
            scene: Scene {
                size,
                shell,
                pieces,
                lamp,
                light,
            },
            walk,
            seed,
        }
    }

    /// `frame_count` poses, `world_from_camera`, metres, about 30 a second.
    pub fn path(&self, frame_count: usize) -> Vec<Pose> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        let size = self.scene.size;
        match self.walk {
            Walk::Revisits => around(size, frame_count, &mut random),
            Walk::SinglePass => {
                let flip = f64::from(u8::from(random.random_bool(0.5)));
                let from = Vector3::new(0.28, 0.3 + 0.4 * flip, 0.0);
                let to = Vector3::new(0.72, 0.7 - 0.4 * flip, 0.0);
                let sweep = random.random_range(0.6..1.5)
                    * if random.random_bool(0.5) { 1.0 } else { -1.0 };

                let way = Way {
                    from: from.component_mul(&size),
                    to: to.component_mul(&size),
                    sway: 0.18,
                    sweep,
                };

                along(&way, frame_count, &mut random)
            }
            Walk::Corridor => {
                let reach = (0.74 * size.x).min(0.015 * frame_count as f64);
                let begin = size.x * 0.13 + random.random_range(0.0..1.0) * (0.74 * size.x - reach);
                let mut ends = [begin, begin + reach];
                if random.random_bool(0.5) {
                    ends.reverse();
                }

                let at = |x: f64| Vector3::new(x, size.y * 0.5, 0.0);
                let way = Way {
                    from: at(ends[0]),
                    to: at(ends[1]),
                    sway: 0.1,
                    sweep: 0.0,
                };

                along(&way, frame_count, &mut random)
            }
        }
    }
}

/// Width, depth and height, metres.
fn size(walk: Walk, random: &mut ChaCha8Rng) -> Vector3<f64> {
    let height = random.random_range(2.4..3.1);
    if walk == Walk::Corridor {
        return Vector3::new(
            random.random_range(8.0..14.0),
            random.random_range(1.9..2.5),
            height,
        );
    }

    let (low, high) = [(3.4, 4.4), (4.2, 6.0), (5.6, 8.5)][random.random_range(0..3)];
    let width = random.random_range(low..high);

    Vector3::new(
        width,
        (width * random.random_range(0.7..1.0)).max(3.2),
        height,
    )
}

/// Other floors and walls than a single room has.
fn decorate(shell: &mut Shell, walk: Walk, size: Vector3<f64>, random: &mut ChaCha8Rng) {
    if random.random_bool(0.3) {
        shell.floor = Floor::Carpet(Colour::of_hue(
            random.random_range(0.0..1.0),
            0.35,
            random.random_range(0.3..0.6),
        ));
    }

    shell.wallpaper = match random.random_range(0..6) {
        0 => Wallpaper::Stripes(random.random_range(0.1..0.4)),
        1 => Wallpaper::Boards(random.random_range(0.8..1.3)),
        2 => Wallpaper::Bricks,
        _ => Wallpaper::None,
    };

    if walk == Walk::Corridor {
        shell.rug.low = [0.5, size.y * 0.5 - 0.4];
        shell.rug.high = [size.x - 0.5, size.y * 0.5 + 0.4];
    } else if random.random_bool(0.35) {
        shell.rug.high = shell.rug.low;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    /// Oracle: geometry. A camera needs 20 cm to the walls and must not stand inside a box, or
    /// nearer than 8 cm to one.
    #[test]
    fn the_camera_keeps_clear_of_walls_and_furniture() {
        for number in 0..120 {
            let room = SuiteRoom::new(7, number);
            let size = room.scene.size;
            for (frame, pose) in room.path(400).iter().enumerate() {
                let at = Point3::from(pose.translation.vector);
                for axis in 0..3 {
                    let gap = at[axis].min(size[axis] - at[axis]);
                    assert!(
                        gap > 0.2,
                        "room {number} ({:?}), frame {frame}: {gap} m to a wall",
                        room.walk
                    );
                }

                for solid in room.scene.pieces.iter().flat_map(|piece| &piece.solids) {
                    let v = at - solid.centre;
                    let turned = [
                        solid.cos * v.x + solid.sin * v.y,
                        solid.cos * v.y - solid.sin * v.x,
                        v.z,
                    ];
                    let clear = (0..3).any(|axis| turned[axis].abs() > solid.half[axis] + 0.08);

                    assert!(
                        clear,
                        "room {number} ({:?}), frame {frame} is in furniture",
                        room.walk
                    );
                }
            }
        }
    }

    /// Oracle: the definitions. A revisited room brings the camera back near an early place long
    /// after, again and again; the others do not, and a calm hand moves at most a few centimetres
    /// and degrees from frame to frame.
    #[test]
    fn walks_are_what_they_are_called() {
        let mut seen = [0; 3];

        for number in 0..60 {
            let room = SuiteRoom::new(3, number);
            let path = room.path(400);
            let apart = |a: usize, b: usize| {
                (path[a].translation.vector - path[b].translation.vector).norm()
            };
            let returns = (0..100)
                .filter(|&early| (early + 150..400).any(|later| apart(early, later) < 0.3))
                .count();

            let expected = if room.walk == Walk::Revisits {
                40..=100
            } else {
                0..=0
            };

            assert!(
                expected.contains(&returns),
                "room {number}, {:?}: {returns}",
                room.walk
            );

            for frame in 1..400 {
                let turn = path[frame - 1].rotation.angle_to(&path[frame].rotation);
                assert!(
                    apart(frame - 1, frame) < 0.05 && turn < 0.05,
                    "room {number}, frame {frame}"
                );
            }
        }

        for number in 0..1_000 {
            seen[SuiteRoom::new(3, number).walk as usize] += 1;
        }

        for (count, expected) in seen.into_iter().zip([450, 300, 250_i32]) {
            assert!(
                (expected - 60..expected + 60).contains(&count),
                "four deviations: {seen:?}"
            );
        }
    }
}

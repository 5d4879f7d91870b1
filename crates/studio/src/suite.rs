//! A suite of rooms that differ in size, furniture, texture and light, and in how the camera moves
//! through them.
//!
//! The kinds of walk are the paper's difficulty factors: dense revisits, a single pass, a corridor.
//! Everything follows from the suite's seed and the room's number: adding rooms changes none of the
//! others.

use nalgebra::{Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use strum::IntoStaticStr;

use super::camera_path::{Way, along, around};
use super::texture::Color;
use super::{Floor, Light, Scene, Shell, Wallpaper, furniture};
use seese3_core::geometry::Pose;

/// How the camera moves through a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum Walk {
    /// Circles in the middle of a room: every position is visited several times.
    Revisits,
    /// Crosses a room once.
    SinglePass,
    /// Walks along a corridor once.
    Corridor,
}

/// One room of a suite.
#[derive(Debug, Clone)]
pub struct SuiteRoom {
    /// The furnished room.
    pub scene: Scene,
    /// How the camera moves.
    pub walk: Walk,
    seed: u64,
}

impl SuiteRoom {
    /// Room `number` of the suite of `seed`. Of twenty rooms, on average nine are revisited, six
    /// are passed once and five are corridors.
    pub fn new(seed: u64, number: u32) -> Self {
        // Every room draws from its own stream of the suite's generator.
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(u64::from(number) + 16);

        // The path has a seed of its own and does not depend on what the room draws below.
        let seed = random.random();

        let walk = match random.random_range(0..20) {
            0..9 => Walk::Revisits,
            9..15 => Walk::SinglePass,
            _ => Walk::Corridor,
        };
        let size = room_size(walk, &mut random);
        let mut shell = Shell::new(size, &mut random);

        decorate(&mut shell, walk, size, &mut random);

        let solids = match walk {
            Walk::Corridor => furniture::furnish_corridor(size, &mut random),
            Walk::Revisits | Walk::SinglePass => furniture::furnish_loosely(size, &mut random),
        };

        let lamp = Point3::new(
            size.x * random.random_range(0.35..0.65),
            size.y * random.random_range(0.4..0.6),
            size.z - random.random_range(0.15..0.45),
        );

        // A warm lamp has less green and much less blue. A corridor is long and needs a brighter
        // lamp.
        let warm = random.random_range(0.0..1.0);
        let light = Light {
            lamp: random.random_range(1.0..2.6) * if walk == Walk::Corridor { 1.6 } else { 1.0 },
            lamp_tint: [1.08, 1.0 - 0.06 * warm, 1.05 - 0.38 * warm],
            sky: random.random_range(0.18..0.42),
            ..Light::PLAIN
        };

        Self {
            scene: Scene::lit_by(size, shell, solids, lamp, light),
            walk,
            seed,
        }
    }

    /// `frame_count` poses, `world_from_camera`, meters, at about 30 frames per second.
    pub fn path(&self, frame_count: usize) -> Vec<Pose> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        let size = self.scene.size;
        match self.walk {
            Walk::Revisits => around(size, frame_count, &mut random),
            Walk::SinglePass => {
                // The walk follows one of the two diagonals of the middle of the room, in shares
                // of its size; the view turns to the left or to the right on the way.
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
                // The walk keeps 13 % of the length away from both ends and advances at most
                // about 1.5 cm per frame: a short recording covers less of the corridor instead
                // of moving faster.
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

/// Width (x), depth (y) and height (z), meters.
pub(super) fn room_size(walk: Walk, random: &mut ChaCha8Rng) -> Vector3<f64> {
    let height = random.random_range(2.4..3.1);
    if walk == Walk::Corridor {
        return Vector3::new(
            random.random_range(8.0..14.0),
            random.random_range(1.9..2.5),
            height,
        );
    }

    // Small, medium and large rooms are equally frequent.
    let (low, high) = [(3.4, 4.4), (4.2, 6.0), (5.6, 8.5)][random.random_range(0..3)];
    let width = random.random_range(low..high);

    Vector3::new(
        width,
        (width * random.random_range(0.7..1.0)).max(3.2),
        height,
    )
}

/// Adds variety that [`Scene::new`] does not have: carpets, wallpapers, a runner in corridors, and
/// rooms without a rug.
pub(super) fn decorate(shell: &mut Shell, walk: Walk, size: Vector3<f64>, random: &mut ChaCha8Rng) {
    if random.random_bool(0.3) {
        shell.floor = Floor::Carpet(Color::of_hue(
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

    // Corridors have a runner along nearly all of their length; a rug of size zero is no rug.
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

                for solid in &room.scene.solids {
                    let v = at - solid.center;
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
    /// after, again and again; the others do not, and a calm hand moves at most a few centimeters
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

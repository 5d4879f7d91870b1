//! Furniture: pieces along the walls, and a table with chairs in the middle of the room.
//!
//! A piece has its own coordinates, meters: x along its width, centered; y from the wall into the
//! room; z up.

use nalgebra::{Point3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::solid::Solid;
use super::texture::{Color, Material};

/// A box of a piece: low corner, high corner, material.
type Block = ([f64; 3], [f64; 3], Material);

/// Furnishes a room of `size`, meters.
pub(super) fn furnish(size: Vector3<f64>, random: &mut ChaCha8Rng) -> Vec<Solid> {
    let mut solids = Vec::new();
    let quarter = std::f64::consts::FRAC_PI_2;

    // Two pieces at each wall, with their backs 2 cm from it. Walls are numbered counterclockwise,
    // seen from above, from the wall y = 0.
    for wall in 0..4u8 {
        let length = if wall % 2 == 0 { size.x } else { size.y };
        let turn = f64::from(wall) * quarter;
        for slot in 0..2 {
            let along = length * (0.27 + 0.46 * f64::from(slot)) + random.random_range(-0.1..0.1);
            let blocks = wall_piece(random);

            let at = match wall {
                0 => [along, 0.02],
                1 => [size.x - 0.02, along],
                2 => [size.x - along, size.y - 0.02],
                _ => [0.02, size.y - along],
            };
            solids.extend(placed(&blocks, at, turn, random));
        }
    }

    let center = [size.x * 0.5, size.y * 0.5];
    let turn = random.random_range(-0.4..0.4);
    let blocks = table(random);
    solids.extend(placed(&blocks, center, turn, random));

    // Three chairs stand around the table, about 120° apart.
    for side in 0..3 {
        let angle = turn + f64::from(side) * 2.1 + random.random_range(-0.3..0.3);
        let at = [
            center[0] + 0.85 * angle.cos(),
            center[1] + 0.75 * angle.sin(),
        ];
        let blocks = chair(random);
        solids.extend(placed(&blocks, at, angle + quarter, random));
    }

    solids
}

/// Furnishes a room of `size`, meters, with a random number of pieces along each wall, and in most
/// rooms with a table and chairs.
pub(super) fn furnish_loosely(size: Vector3<f64>, random: &mut ChaCha8Rng) -> Vec<Solid> {
    let mut solids = Vec::new();
    let quarter = std::f64::consts::FRAC_PI_2;
    for wall in 0..4u8 {
        let length = if wall % 2 == 0 { size.x } else { size.y };
        let turn = f64::from(wall) * quarter;
        let slots = random.random_range(1..=(length / 1.9) as u32);
        for slot in 0..slots {
            let along = length * (f64::from(slot) + 0.5) / f64::from(slots)
                + random.random_range(-0.12..0.12);
            let blocks = wall_piece(random);

            // Sample the piece before skipping it, so that the random sequence does not change.
            if random.random_bool(0.2) {
                continue;
            }

            let at = match wall {
                0 => [along, 0.02],
                1 => [size.x - 0.02, along],
                2 => [size.x - along, size.y - 0.02],
                _ => [0.02, size.y - along],
            };
            solids.extend(placed(&blocks, at, turn, random));
        }
    }

    if random.random_bool(0.7) {
        let center = [
            size.x * random.random_range(0.42..0.58),
            size.y * random.random_range(0.42..0.58),
        ];

        let turn = random.random_range(-0.6..0.6);
        let blocks = table(random);
        solids.extend(placed(&blocks, center, turn, random));

        // One to four chairs stand around the table, about 90° apart.
        for side in 0..random.random_range(1..5) {
            let angle = turn + f64::from(side) * 1.6 + random.random_range(-0.3..0.3);
            let at = [
                center[0] + 0.85 * angle.cos(),
                center[1] + 0.75 * angle.sin(),
            ];
            let blocks = chair(random);
            solids.extend(placed(&blocks, at, angle + quarter, random));
        }
    }

    solids
}

/// Furnishes a corridor along x, of `size`, meters, with shallow pieces on its long sides.
pub(super) fn furnish_corridor(size: Vector3<f64>, random: &mut ChaCha8Rng) -> Vec<Solid> {
    let mut solids = Vec::new();
    let mut along = random.random_range(0.9..1.8);
    while along < size.x - 0.9 {
        // Beds, sofas and desks are too deep for a corridor.
        let blocks = match random.random_range(0..5) {
            0 => bookshelf(random),
            1 => wardrobe(random),
            2 => plant(random),
            _ => sideboard(random),
        };

        let far = random.random_bool(0.5);
        let (at, turn) = if far {
            ([along, size.y - 0.02], std::f64::consts::PI)
        } else {
            ([along, 0.02], 0.0)
        };
        solids.extend(placed(&blocks, at, turn, random));

        along += random.random_range(1.5..2.8);
    }

    solids
}

fn wall_piece(random: &mut ChaCha8Rng) -> Vec<Block> {
    match random.random_range(0..7) {
        0 => bookshelf(random),
        1 => sofa(random),
        2 => bed(random),
        3 => desk(random),
        4 => wardrobe(random),
        5 => plant(random),
        _ => sideboard(random),
    }
}

fn hue(random: &mut ChaCha8Rng, saturation: f64, value: f64) -> Color {
    Color::of_hue(random.random_range(0.0..1.0), saturation, value)
}

fn timber(random: &mut ChaCha8Rng) -> Material {
    Material::Wood(Color::of_hue(
        random.random_range(0.04..0.11),
        0.6,
        random.random_range(0.25..0.6),
    ))
}

fn cloth(random: &mut ChaCha8Rng) -> Material {
    Material::Fabric(hue(random, 0.5, 0.5), hue(random, 0.4, 0.7))
}

fn bookshelf(random: &mut ChaCha8Rng) -> Vec<Block> {
    let half = random.random_range(0.4..0.65);
    let high = random.random_range(1.3..2.1);
    let wood = timber(random);

    // Books, two sides and the top; then shelves 0.33 m apart, aligned with the rows of the book
    // texture.
    let mut blocks = vec![
        ([-half, 0.0, 0.0], [half, 0.24, high], Material::Books),
        ([-half - 0.03, 0.0, 0.0], [-half, 0.32, high], wood),
        ([half, 0.0, 0.0], [half + 0.03, 0.32, high], wood),
        ([-half, 0.0, high], [half, 0.32, high + 0.03], wood),
    ];

    let boards = (high / 0.33) as usize;
    blocks.extend((0..boards).map(|board| {
        let z = 0.33 * board as f64;
        ([-half, 0.0, z], [half, 0.31, z + 0.025], wood)
    }));

    blocks
}

fn sofa(random: &mut ChaCha8Rng) -> Vec<Block> {
    let cover = cloth(random);
    let cushion = cloth(random);

    // Seat, back, two arms and two cushions.
    vec![
        ([-0.8, 0.0, 0.1], [0.8, 0.85, 0.42], cover),
        ([-0.8, 0.0, 0.42], [0.8, 0.22, 0.85], cover),
        ([-0.95, 0.0, 0.08], [-0.8, 0.85, 0.6], cover),
        ([0.8, 0.0, 0.08], [0.95, 0.85, 0.6], cover),
        ([-0.7, 0.24, 0.43], [-0.3, 0.38, 0.78], cushion),
        ([0.25, 0.24, 0.43], [0.65, 0.38, 0.78], cushion),
    ]
}

fn bed(random: &mut ChaCha8Rng) -> Vec<Block> {
    let wood = timber(random);
    let blanket = cloth(random);

    // Frame, mattress, blanket, headboard and two pillows.
    vec![
        ([-0.75, 0.0, 0.0], [0.75, 1.95, 0.28], wood),
        (
            [-0.72, 0.05, 0.28],
            [0.72, 1.9, 0.45],
            Material::Plain(Color::WHITE),
        ),
        ([-0.74, 0.7, 0.3], [0.74, 1.93, 0.5], blanket),
        ([-0.78, 0.0, 0.0], [0.78, 0.06, 1.0], wood),
        (
            [-0.6, 0.1, 0.45],
            [-0.1, 0.5, 0.58],
            Material::Plain(Color::WHITE),
        ),
        (
            [0.1, 0.1, 0.45],
            [0.6, 0.5, 0.58],
            Material::Plain(Color::WHITE),
        ),
    ]
}

fn desk(random: &mut ChaCha8Rng) -> Vec<Block> {
    let wood = timber(random);
    let screen = random.random_range(-0.25..0.25);

    // Top, one side, cupboard, screen, screen stand and an object.
    vec![
        ([-0.7, 0.0, 0.7], [0.7, 0.65, 0.74], wood),
        ([-0.68, 0.03, 0.0], [-0.62, 0.6, 0.7], wood),
        (
            [0.3, 0.03, 0.0],
            [0.68, 0.6, 0.7],
            Material::Doors(hue(random, 0.2, 0.6)),
        ),
        (
            [screen - 0.28, 0.15, 0.86],
            [screen + 0.28, 0.19, 1.2],
            Material::Screen,
        ),
        (
            [screen - 0.05, 0.12, 0.74],
            [screen + 0.05, 0.2, 0.86],
            Material::Plain(Color([0.1, 0.1, 0.1])),
        ),
        (
            [0.45, 0.2, 0.74],
            [0.62, 0.45, 0.9],
            Material::Plain(hue(random, 0.7, 0.6)),
        ),
    ]
}

fn wardrobe(random: &mut ChaCha8Rng) -> Vec<Block> {
    let half = random.random_range(0.5..0.8);
    let high = random.random_range(1.8..2.15);

    let color = Color::of_hue(
        random.random_range(0.03..0.15),
        0.35,
        random.random_range(0.4..0.8),
    );

    vec![(
        [-half, 0.0, 0.0],
        [half, 0.58, high],
        Material::Doors(color),
    )]
}

fn sideboard(random: &mut ChaCha8Rng) -> Vec<Block> {
    let mut blocks = vec![(
        [-0.7, 0.0, 0.08],
        [0.7, 0.42, 0.8],
        Material::Doors(hue(random, 0.3, 0.65)),
    )];

    // Objects of random size and color stand on top.
    for item in 0..4 {
        let x = -0.55 + 0.33 * f64::from(item) + random.random_range(-0.05..0.05);
        let half = random.random_range(0.04..0.1);
        let high = random.random_range(0.1..0.4);
        let stuff = Material::Plain(hue(random, 0.7, 0.65));
        blocks.push((
            [x - half, 0.15, 0.8],
            [x + half, 0.15 + 2.0 * half, 0.8 + high],
            stuff,
        ));
    }

    blocks
}

fn plant(random: &mut ChaCha8Rng) -> Vec<Block> {
    let pot = Material::Plain(hue(random, 0.5, 0.5));
    let mut blocks = vec![([-0.17, 0.12, 0.0], [0.17, 0.46, 0.36], pot)];

    // Random cubes of leaves around the stem; the stem is added last.
    for _ in 0..7 {
        let x = random.random_range(-0.25..0.25);
        let y = random.random_range(0.15..0.5);
        let z = random.random_range(0.45..1.4);
        let half = random.random_range(0.07..0.16);

        let green = Material::Leaves(Color::of_hue(random.random_range(0.25..0.4), 0.65, 0.5));
        blocks.push((
            [x - half, y - half, z - half],
            [x + half, y + half, z + half],
            green,
        ));
    }

    blocks.push((
        [-0.02, 0.27, 0.3],
        [0.02, 0.31, 1.3],
        Material::Plain(Color([0.25, 0.16, 0.1])),
    ));

    blocks
}

fn table(random: &mut ChaCha8Rng) -> Vec<Block> {
    let wood = timber(random);
    let leg = |x: f64, y: f64| ([x - 0.03, y - 0.03, 0.0], [x + 0.03, y + 0.03, 0.72], wood);
    let mut blocks = vec![([-0.6, -0.42, 0.72], [0.6, 0.42, 0.76], wood)];

    blocks.extend([
        leg(-0.54, -0.36),
        leg(0.54, -0.36),
        leg(-0.54, 0.36),
        leg(0.54, 0.36),
    ]);

    // Objects of random size and color stand on top.
    for item in 0..3 {
        let x = -0.4 + 0.4 * f64::from(item);
        let y = random.random_range(-0.25..0.25);
        let half = random.random_range(0.05..0.11);
        let high = random.random_range(0.04..0.3);

        let stuff = Material::Plain(hue(random, 0.8, 0.7));
        blocks.push((
            [x - half, y - half, 0.76],
            [x + half, y + half, 0.76 + high],
            stuff,
        ));
    }

    blocks
}

fn chair(random: &mut ChaCha8Rng) -> Vec<Block> {
    let wood = timber(random);
    let seat = cloth(random);
    let leg = |x: f64, y: f64| ([x - 0.02, y - 0.02, 0.0], [x + 0.02, y + 0.02, 0.43], wood);

    vec![
        ([-0.22, -0.22, 0.43], [0.22, 0.22, 0.48], seat),
        ([-0.22, 0.19, 0.48], [0.22, 0.22, 0.95], wood),
        leg(-0.19, -0.19),
        leg(0.19, -0.19),
        leg(-0.19, 0.19),
        leg(0.19, 0.19),
    ]
}

/// Small objects on horizontal furniture tops, and larger ones on the floor along the walls of a
/// room of `size`, meters.
pub(super) fn things(
    furniture: &[Solid],
    size: Vector3<f64>,
    random: &mut ChaCha8Rng,
) -> Vec<Solid> {
    let mut things = Vec::new();

    // Objects on tops of table height stay below the camera; higher tops belong to shelves at the
    // wall.
    for top in furniture
        .iter()
        .filter(|solid| solid.half.xy().min() > 0.14)
    {
        let height = top.center.z + top.half.z;
        if !(0.35..=1.95).contains(&height) {
            continue;
        }

        let area = 4.0 * top.half.x * top.half.y;
        let most = 1 + (area * 9.0) as u32;
        for _ in 0..random.random_range(0..=most) {
            let half = Vector3::new(
                random.random_range(0.02..0.12),
                random.random_range(0.02..0.12),
                random.random_range(0.015..0.14),
            );
            let off = Vector3::new(
                (top.half.x - half.x).max(0.0) * random.random_range(-1.0..1.0),
                (top.half.y - half.y).max(0.0) * random.random_range(-1.0..1.0),
                top.half.z + half.z,
            );
            let turned = Vector3::new(
                top.cos * off.x - top.sin * off.y,
                top.sin * off.x + top.cos * off.y,
                off.z,
            );

            things.push(thing(top.center + turned, half, random));
        }
    }

    for _ in 0..random.random_range(3..14) {
        let half = Vector3::from_fn(|_, _| random.random_range(0.05..0.22));
        let along = random.random_range(0.3..0.7);
        let deep = random.random_range(0.3..0.8);
        let at = match random.random_range(0..4) {
            0 => [along * size.x, deep],
            1 => [size.x - deep, along * size.y],
            2 => [along * size.x, size.y - deep],
            _ => [deep, along * size.y],
        };

        things.push(thing(Point3::new(at[0], at[1], half.z), half, random));
    }

    things
}

/// A box with random material and rotation.
fn thing(center: Point3<f64>, half: Vector3<f64>, random: &mut ChaCha8Rng) -> Solid {
    let (sin, cos) = random.random_range(-1.5f64..1.5).sin_cos();
    let strength = random.random_range(0.2..0.8);
    let material = match random.random_range(0..7) {
        0 => Material::Books,
        1 => cloth(random),
        2 => timber(random),
        3 => Material::Plain(hue(random, strength, 0.6)),
        4 => Material::Plain(Color::WHITE.scaled(strength)),
        _ => Material::Printed(hue(random, 0.4, 0.75), hue(random, 0.7, 0.3)),
    };

    Solid {
        center,
        half,
        cos,
        sin,
        material,
        seed: random.random(),
    }
}

/// The boxes of a piece at position `at` on the floor, meters, rotated about the vertical axis by
/// `turn`, radians.
fn placed<'a>(
    blocks: &'a [Block],
    at: [f64; 2],
    turn: f64,
    random: &'a mut ChaCha8Rng,
) -> impl Iterator<Item = Solid> + 'a {
    let (sin, cos) = turn.sin_cos();

    blocks.iter().map(move |&(low, high, material)| {
        let low = Vector3::from(low);
        let high = Vector3::from(high);
        let middle = (low + high) / 2.0;
        let half = (high - low) / 2.0;

        // Transform from piece to room coordinates.
        let center = Point3::new(
            at[0] + cos * middle.x - sin * middle.y,
            at[1] + sin * middle.x + cos * middle.y,
            middle.z,
        );

        Solid {
            center,
            half,
            cos,
            sin,
            material,
            seed: random.random(),
        }
    })
}

//! Procedural textures: colors from noise, by position on a surface in meters.

/// A color in linear light: red, green and blue, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Color(pub [f64; 3]);

impl Color {
    pub const WHITE: Self = Self([0.85, 0.85, 0.83]);

    /// The color with a hue, a saturation and a value (HSV), 0 to 1 each; the hue wraps around.
    pub fn of_hue(hue: f64, saturation: f64, value: f64) -> Self {
        let channel = |shift: f64| {
            let distance = ((hue * 6.0 + shift).rem_euclid(6.0) - 3.0).abs() - 1.0;
            value * (1.0 - saturation + saturation * distance.clamp(0.0, 1.0))
        };
        Self([channel(0.0), channel(4.0), channel(2.0)])
    }

    pub fn scaled(self, by: f64) -> Self {
        Self(self.0.map(|channel| channel * by))
    }

    pub fn mixed(self, other: Self, share: f64) -> Self {
        Self(std::array::from_fn(|c| {
            self.0[c] * (1.0 - share) + other.0[c] * share
        }))
    }
}

/// The material of a box.
#[derive(Debug, Clone, Copy)]
pub(super) enum Material {
    Plain(Color),
    Wood(Color),
    Fabric(Color, Color),
    Books,
    Doors(Color),
    Screen,
    Leaves(Color),
    /// Printed cardboard: paper color and ink color.
    Printed(Color, Color),
}

impl Material {
    /// Color at (u, v), meters, on a face. `front` is true for the face toward the room.
    pub fn color(self, u: f64, v: f64, front: bool, seed: u32) -> Color {
        match self {
            Self::Plain(color) => color.scaled(0.94 + 0.06 * noise(u * 8.0, v * 8.0, seed)),
            Self::Wood(color) => wood(color, u, v, seed),
            Self::Fabric(color, stripe) => {
                let weave = 0.85 + 0.15 * noise(u * 60.0, v * 60.0, seed);
                let striped = (u * 7.0 + unit(seed, 1)).rem_euclid(1.0) < 0.3;

                color
                    .mixed(stripe, if striped { 0.55 } else { 0.0 })
                    .scaled(weave)
            }
            Self::Books if front => books(u, v, seed),
            Self::Books => wood(Color([0.3, 0.2, 0.12]), u, v, seed),
            Self::Doors(color) => {
                // Doors are 50 cm wide, with dark seams between them and a handle near one edge;
                // seams and handles only on the front.
                let gap = (u / 0.5).rem_euclid(1.0);
                let seam = front && !(0.015..=0.985).contains(&gap);
                let handle = front && (0.86..0.9).contains(&gap) && (v.abs() < 0.12);
                let shade = if seam { 0.35 } else { 1.0 };

                if handle {
                    Color([0.6, 0.6, 0.62])
                } else {
                    wood(color, v, u, seed).scaled(shade)
                }
            }
            Self::Screen if front => {
                // Lit lines of different lengths, like text, on a dark screen.
                let line = hash2((v * 40.0).floor() as i64, 3, seed);
                let lit = (u * 14.0).rem_euclid(7.0) < 1.0 + 5.0 * line
                    && (v * 40.0).rem_euclid(1.0) < 0.55;
                if lit {
                    Color([0.55, 0.75, 0.8])
                } else {
                    Color([0.05, 0.07, 0.12])
                }
            }
            Self::Screen => Color([0.06, 0.06, 0.06]),
            Self::Leaves(color) => color.scaled(0.45 + 0.75 * fractal(u * 14.0, v * 14.0, seed)),
            Self::Printed(paper, ink) => printed(paper, ink, u, v, seed),
        }
    }
}

/// Wood with its grain along u.
pub(super) fn wood(color: Color, u: f64, v: f64, seed: u32) -> Color {
    let ring = fractal(u * 1.6, v * 22.0, seed);
    color.scaled(0.7 + 0.5 * ring)
}

/// Rows of book spines between boards 0.33 m apart.
fn books(u: f64, v: f64, seed: u32) -> Color {
    let row = (v / 0.33).floor() as i64;
    let height = (v / 0.33).rem_euclid(1.0);

    // Spines are 4.5 cm wide and vary in height; the shelf above them is dark.
    let cell = (u / 0.045 + 0.4 * hash2(row, 1, seed)).floor() as i64;
    let tall = 0.62 + 0.3 * hash2(cell, row, seed);

    if height < 0.08 || height > tall {
        return Color([0.07, 0.05, 0.04]);
    }

    let spine = Color::of_hue(
        hash2(cell, row, seed ^ 0x51),
        0.65,
        0.25 + 0.6 * hash2(cell, row, seed ^ 0x77),
    );

    let band = (0.5..0.6).contains(&(height / tall));
    if band {
        spine.mixed(Color::WHITE, 0.7)
    } else {
        spine
    }
}

/// A sheet on a wall: a small painting or printed paper, with equal probability.
pub(super) fn note(u: f64, v: f64, seed: u32) -> Color {
    if unit(seed, 5) < 0.5 {
        return picture(2.0 * u, 2.0 * v, seed);
    }

    let paper = Color::of_hue(unit(seed, 8), 0.3 * unit(seed, 9), 0.8);
    let ink = Color::of_hue(unit(seed, 10), 0.7, 0.3);
    printed(paper, ink, u, v, seed)
}

/// Blocks of print, 4 by 2.5 cm: blank, lines of text, or solid ink.
fn printed(paper: Color, ink: Color, u: f64, v: f64, seed: u32) -> Color {
    let column = (u / 0.04).floor() as i64;
    let row = (v / 0.025).floor() as i64;
    let kind = hash2(column, row, seed);

    let line = (v / 0.006).rem_euclid(1.0) < 0.5 && hash2((u / 0.005) as i64, row, seed) < 0.7;
    if kind > 0.7 || (kind > 0.35 && line) {
        ink
    } else {
        paper
    }
}

/// Fine detail of a surface (grain, wear, dirt), as a factor of its color. It has three octaves,
/// from 11 cm down to 8 mm. Octaves too fine for `finest`, the size of a pixel there in meters,
/// fade out. `strength` is 0 to 1.
pub(super) fn detail(u: f64, v: f64, finest: f64, strength: f64, seed: u32) -> f64 {
    // Roughness varies between surfaces.
    let rough = strength * (0.3 + 0.7 * unit(seed, 23));
    let mut sum = 0.0;

    for (octave, (per_meter, amplitude)) in [(9.0, 0.2), (33.0, 0.35), (120.0, 0.45)]
        .into_iter()
        .enumerate()
    {
        // Fade out an octave as its cells shrink to 1.5 pixels, to avoid aliasing.
        let shown = (2.0 - 3.0 * per_meter * finest).clamp(0.0, 1.0);
        if shown <= 0.0 {
            break;
        }

        let cell = noise(u * per_meter, v * per_meter, seed ^ (octave as u32 + 11));
        sum += shown * amplitude * (2.0 * cell - 1.0);
    }

    (1.0 + rough * sum).max(0.05)
}

/// A random painting: soft shapes in three colors.
pub(super) fn picture(u: f64, v: f64, seed: u32) -> Color {
    let a = fractal(u * 5.0, v * 5.0, seed);
    let b = fractal(u * 3.0 + 9.0, v * 6.0, seed ^ 0xa5);
    let hue = unit(seed, 7);
    let sky = Color::of_hue(hue, 0.5, 0.85);

    let land = Color::of_hue(hue + 0.35, 0.7, 0.45);
    let dark = Color::of_hue(hue + 0.6, 0.8, 0.18);
    let ground = if a > 0.52 { land } else { sky };
    if b > 0.62 {
        dark
    } else {
        ground.scaled(0.7 + 0.5 * b)
    }
}

/// Three octaves of [`noise`], 0 to 1.
pub(super) fn fractal(x: f64, y: f64, seed: u32) -> f64 {
    (4.0 * noise(x, y, seed)
        + 2.0 * noise(2.0 * x, 2.0 * y, seed ^ 1)
        + noise(4.0 * x, 4.0 * y, seed ^ 2))
        / 7.0
}

/// Smooth value noise with cells of size 1, 0 to 1.
pub(super) fn noise(x: f64, y: f64, seed: u32) -> f64 {
    let i = floor(x);
    let j = floor(y);

    // The smoothstep polynomial has zero slope at 0 and 1, so the noise is smooth across cell
    // borders.
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let s = smooth(x - i as f64);
    let t = smooth(y - j as f64);

    let corner = |di: i64, dj: i64| hash2(i.wrapping_add(di), j.wrapping_add(dj), seed);

    let low = corner(0, 0) * (1.0 - s) + corner(1, 0) * s;
    let high = corner(0, 1) * (1.0 - s) + corner(1, 1) * s;

    low * (1.0 - t) + high * t
}

/// The largest integer not above `x`. The cast truncates toward zero and is faster than
/// [`f64::floor`].
fn floor(x: f64) -> i64 {
    let cut = x as i64;
    if (cut as f64) > x { cut - 1 } else { cut }
}

/// A pseudo-random number, 0 to 1, for a cell (i, j).
pub(super) fn hash2(i: i64, j: i64, seed: u32) -> f64 {
    // Integer hash: multiplications and shifts mix the bits, so that neighboring cells get
    // uncorrelated numbers.
    let mut h = (i as u32).wrapping_mul(0x9e37_79b1)
        ^ (j as u32).wrapping_mul(0x85eb_ca77)
        ^ seed.wrapping_mul(0xc2b2_ae3d);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);

    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    f64::from(h ^ (h >> 15)) / f64::from(u32::MAX)
}

/// A pseudo-random number, 0 to 1, for a seed and a purpose.
pub(super) fn unit(seed: u32, purpose: i64) -> f64 {
    hash2(purpose, 17, seed)
}

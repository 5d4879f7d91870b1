//! Image motion between two views: the similarity transform that aligns one view with the next.
//!
//! Image motion depends on the camera's rotation and translation and on the unknown scene depth.
//! One similarity (shift, turn, growth) for the whole image is coarse: near parts of a scene move
//! further. But it needs no model and no intrinsics, and suffices to check whether poses match
//! their images ([`crate::pose_check`]).
//!
//! The alignment is Lucas-Kanade: Gauss-Newton on brightness differences, coarse to fine.

use nalgebra::{Matrix4, Vector2, Vector4};

use seese3_core::image::RgbImage;

/// Maximum width of reduced images, pixels. Wider images hardly improve the alignment.
const WIDTH: usize = 160;
/// Minimum shorter side of a reduced image, pixels.
const LEAST_SIDE: usize = 32;
/// Number of pyramid levels. Each level halves the width of the previous one.
const LEVELS: usize = 3;
const STEPS_PER_LEVEL: usize = 12;
/// A level has converged when a step shifts by less than this, pixels.
const SMALL_STEP_PX: f64 = 0.02;
/// Minimum overlap, as a fraction of the first image.
const LEAST_OVERLAP: f64 = 0.3;
/// Scale of the Cauchy weight of brightness differences, in standard deviations. It reduces the
/// influence of occluded and moving objects.
const ROBUST_DEVIATIONS: f64 = 0.5;
/// Damping of turn and growth in a Gauss-Newton step, per pixel. Without texture, they stay
/// unchanged.
const HELD_BACK: f64 = 1e-3;

/// A grayscale image, reduced to a small size.
#[derive(Debug, Clone, PartialEq)]
pub struct SmallImage {
    width: usize,
    height: usize,
    /// Row by row from the top left, 0 to 255.
    brightness: Vec<f64>,
}

/// The motion of an image's content from one image to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageMotion {
    /// Shift of the image center, right and down, image widths.
    pub shift: Vector2<f64>,
    /// Rotation about the image center, from right to down (clockwise), radians.
    pub turn: f64,
    /// Relative growth: 0.1 means that content looks 10 % larger.
    pub growth: f64,
}

/// An estimated image motion and its quality.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// The estimated motion.
    pub motion: ImageMotion,
    /// The correlation of brightness in the overlap, -1 to 1.
    pub correlation: f64,
}

impl SmallImage {
    /// Reduces an image by averaging pixels; `None` if it is too small to align.
    pub fn of(image: &RgbImage) -> Option<Self> {
        let width = image.width.min(WIDTH);
        let height = image.height * width / image.width.max(1);
        if width.min(height) < LEAST_SIDE {
            return None;
        }

        let mut sums = vec![(0.0, 0.0); width * height];
        for y in 0..image.height {
            let row = y * height / image.height;
            for x in 0..image.width {
                let column = x * width / image.width;
                let (sum, count) = &mut sums[row * width + column];
                *sum += image.pixel(x, y).map(f64::from).iter().sum::<f64>() / 3.0;
                *count += 1.0;
            }
        }

        let brightness = sums.iter().map(|(sum, count)| sum / count).collect();
        Some(Self {
            width,
            height,
            brightness,
        })
    }

    /// The brightness of a pixel; outside the image, of the nearest pixel inside.
    fn at(&self, x: isize, y: isize) -> f64 {
        let column = x.clamp(0, self.width as isize - 1) as usize;
        let row = y.clamp(0, self.height as isize - 1) as usize;
        self.brightness[row * self.width + column]
    }

    /// Blurred by the weights 1, 2, 1 in both directions.
    fn blurred(&self) -> Self {
        let weights = [(-1, 1.0), (0, 2.0), (1, 1.0)];
        let pixel = |x: usize, y: usize| {
            let mut sum = 0.0;
            for (dy, weight_y) in weights {
                for (dx, weight_x) in weights {
                    sum += weight_x * weight_y * self.at(x as isize + dx, y as isize + dy);
                }
            }
            sum / 16.0
        };

        self.mapped(self.width, self.height, pixel)
    }

    /// Half the size: every four pixels averaged.
    fn halved(&self) -> Self {
        let pixel = |x: usize, y: usize| {
            let [x, y] = [2 * x as isize, 2 * y as isize];
            (self.at(x, y) + self.at(x + 1, y) + self.at(x, y + 1) + self.at(x + 1, y + 1)) / 4.0
        };

        self.mapped(self.width / 2, self.height / 2, pixel)
    }

    fn mapped(&self, width: usize, height: usize, pixel: impl Fn(usize, usize) -> f64) -> Self {
        let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Self {
            width,
            height,
            brightness: places.map(|(x, y)| pixel(x, y)).collect(),
        }
    }

    /// Brightness and its gradient (right, down) at a sub-pixel position, bilinearly interpolated.
    fn sample(&self, x: f64, y: f64) -> Sample {
        let column = (x.floor() as isize).min(self.width as isize - 2);
        let row = (y.floor() as isize).min(self.height as isize - 2);
        let right = x - column as f64;
        let down = y - row as f64;

        // The gradient at a pixel is the central difference.
        let slope_x = |x: isize, y: isize| (self.at(x + 1, y) - self.at(x - 1, y)) / 2.0;
        let slope_y = |x: isize, y: isize| (self.at(x, y + 1) - self.at(x, y - 1)) / 2.0;
        let between = |value: &dyn Fn(isize, isize) -> f64| {
            let above = (1.0 - right) * value(column, row) + right * value(column + 1, row);
            let below = (1.0 - right) * value(column, row + 1) + right * value(column + 1, row + 1);
            (1.0 - down) * above + down * below
        };

        Sample {
            brightness: between(&|x, y| self.at(x, y)),
            slope: Vector2::new(between(&slope_x), between(&slope_y)),
        }
    }
}

struct Sample {
    brightness: f64,
    slope: Vector2<f64>,
}

/// A pixel of the first image with the second image's brightness at the warped position.
struct Overlap {
    /// Position relative to the center of the first image, pixels.
    place: Vector2<f64>,
    first: f64,
    second: Sample,
}

/// Aligns `first` with `second`. `None` if their sizes differ, they overlap too little, or one has
/// no texture.
pub fn align(first: &SmallImage, second: &SmallImage) -> Option<Alignment> {
    if (first.width, first.height) != (second.width, second.height) {
        return None;
    }

    // The pyramid, finest level first.
    let mut sizes = vec![[first.blurred(), second.blurred()]];
    while sizes.len() < LEVELS {
        let [first, second] = &sizes[sizes.len() - 1];
        sizes.push([first.halved().blurred(), second.halved().blurred()]);
    }

    // Growth, turn, and the shift in pixels of the current level.
    let mut warp = Vector4::zeros();
    let mut correlation = 0.0;
    for [first, second] in sizes.iter().rev() {
        warp.z *= 2.0;
        warp.w *= 2.0;
        correlation = refine(first, second, &mut warp)?;
    }

    let width = first.width as f64;
    let motion = ImageMotion {
        shift: Vector2::new(warp.z, warp.w) / width,
        turn: warp.y,
        growth: warp.x,
    };
    Some(Alignment {
        motion,
        correlation,
    })
}

/// Refines a warp at one level, and returns the final correlation of the overlap.
fn refine(first: &SmallImage, second: &SmallImage, warp: &mut Vector4<f64>) -> Option<f64> {
    for _ in 0..STEPS_PER_LEVEL {
        let step = step(&overlap(first, second, warp)?)?;
        *warp += step;
        if step.z.abs() + step.w.abs() < SMALL_STEP_PX {
            break;
        }
    }

    let overlap = overlap(first, second, warp)?;
    let [first, second] = standardized(&overlap)?;
    let products = first.iter().zip(&second).map(|(a, b)| a * b);
    Some(products.sum::<f64>() / overlap.len() as f64)
}

/// The pixels that both images show under a warp; `None` if they are too few.
fn overlap(first: &SmallImage, second: &SmallImage, warp: &Vector4<f64>) -> Option<Vec<Overlap>> {
    let last = Vector2::new(first.width as f64 - 1.0, first.height as f64 - 1.0);
    let middle = last / 2.0;
    let &[growth, turn, right, down] = warp.as_ref();

    let mut overlap = Vec::with_capacity(first.brightness.len());
    for (place, &brightness) in first.brightness.iter().enumerate() {
        let pixel = Vector2::new((place % first.width) as f64, (place / first.width) as f64);
        let place = pixel - middle;

        let there = middle
            + place * (1.0 + growth)
            + Vector2::new(-place.y, place.x) * turn
            + Vector2::new(right, down);
        let is_inside = there >= Vector2::zeros() && there <= last;
        if is_inside {
            overlap.push(Overlap {
                place,
                first: brightness,
                second: second.sample(there.x, there.y),
            });
        }
    }

    let is_enough = overlap.len() as f64 >= LEAST_OVERLAP * first.brightness.len() as f64;
    is_enough.then_some(overlap)
}

/// The brightness of both images, standardized to mean 0 and deviation 1 to cancel exposure. `None`
/// if one of them is uniform.
fn standardized(overlap: &[Overlap]) -> Option<[Vec<f64>; 2]> {
    let values = [
        overlap.iter().map(|both| both.first).collect(),
        overlap.iter().map(|both| both.second.brightness).collect(),
    ];
    let [first, second] = values.map(|values: Vec<f64>| {
        let (mean, deviation) = mean_and_deviation(&values);
        (deviation > 1e-6).then(|| {
            let standard = values.iter().map(|value| (value - mean) / deviation);
            standard.collect::<Vec<f64>>()
        })
    });

    Some([first?, second?])
}

fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count;

    (mean, variance.sqrt())
}

/// One Gauss-Newton step, to be added to the warp.
fn step(overlap: &[Overlap]) -> Option<Vector4<f64>> {
    let [first, second] = standardized(overlap)?;
    let brightness: Vec<f64> = overlap.iter().map(|both| both.second.brightness).collect();
    let (_, deviation) = mean_and_deviation(&brightness);

    // The Jacobian of the second image's standardized brightness by growth, turn and shift. Its
    // mean is subtracted, as from the brightness.
    let slopes = overlap.iter().map(|both| {
        let slope = both.second.slope / deviation;
        let across = Vector2::new(-both.place.y, both.place.x);
        Vector4::new(slope.dot(&both.place), slope.dot(&across), slope.x, slope.y)
    });
    let slopes: Vec<Vector4<f64>> = slopes.collect();
    let mean = slopes.iter().sum::<Vector4<f64>>() / slopes.len() as f64;

    let mut moment = Matrix4::zeros();
    let mut product = Vector4::zeros();
    for ((slope, first), second) in slopes.iter().zip(&first).zip(&second) {
        let difference = second - first;
        let weight = (1.0 + (difference / ROBUST_DEVIATIONS).powi(2)).recip();
        let slope = slope - mean;
        moment += slope * slope.transpose() * weight;
        product += slope * (difference * weight);
    }

    let held_back = HELD_BACK * overlap.len() as f64;
    moment[(0, 0)] += held_back;
    moment[(1, 1)] += held_back;
    Some(-moment.cholesky()?.solve(&product))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wave texture, warped by a similarity: the content at `place` in the plain image is at
    /// (1 + growth) · turned `place` + shift in this one. Lengths in pixels of an image 160 wide.
    fn image(growth: f64, turn: f64, shift: [f64; 2], exposure: f64) -> RgbImage {
        let (width, height) = (160, 120);
        let mut bytes = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let seen = Vector2::new(f64::from(x) - 79.5, f64::from(y) - 59.5);
                let moved = seen - Vector2::from(shift);
                let scale = (1.0 + growth).powi(2) + turn * turn;
                let place = Vector2::new(
                    (1.0 + growth) * moved.x + turn * moved.y,
                    (1.0 + growth) * moved.y - turn * moved.x,
                ) / scale;

                let waves = (place.x / 9.0).sin() * (place.y / 7.0).cos()
                    + (place.x / 23.0 + place.y / 17.0).sin();
                bytes.extend([(exposure * (100.0 + 40.0 * waves)) as u8; 3]);
            }
        }
        RgbImage {
            width: 160,
            height: 120,
            bytes,
        }
    }

    /// Oracle: the similarity that the second image was drawn by.
    #[test]
    fn a_similarity_is_found_whatever_the_exposure() {
        let small = |image: &RgbImage| SmallImage::of(image).unwrap();
        let first = small(&image(0.0, 0.0, [0.0, 0.0], 1.0));
        for (growth, turn, shift) in [
            (0.0, 0.0, [0.0, 0.0]),
            (0.0, 0.0, [6.3, -4.2]),
            (0.05, 0.0, [-2.0, 1.0]),
            (0.0, -0.06, [0.0, 3.0]),
            (-0.04, 0.05, [4.0, 2.0]),
        ] {
            let second = small(&image(growth, turn, shift, 0.8));
            let found = align(&first, &second).unwrap();
            assert!(found.correlation > 0.99, "{found:?}");

            let motion = found.motion;
            assert!((motion.growth - growth).abs() < 0.005, "{motion:?}");
            assert!((motion.turn - turn).abs() < 0.005, "{motion:?}");
            let off = motion.shift * 160.0 - Vector2::from(shift);
            assert!(off.norm() < 0.2, "{motion:?} off by {off}");
        }
    }

    /// Oracle: the definition. An image without texture or of another size cannot be aligned.
    #[test]
    fn images_that_tell_nothing_are_not_aligned() {
        let textured = image(0.0, 0.0, [0.0, 0.0], 1.0);
        let dark = RgbImage {
            bytes: vec![0; textured.bytes.len()],
            ..textured.clone()
        };
        let tall = RgbImage {
            width: 120,
            height: 160,
            bytes: textured.bytes.clone(),
        };
        let small = |image: &RgbImage| SmallImage::of(image).unwrap();
        assert_eq!(align(&small(&textured), &small(&dark)), None);
        assert_eq!(align(&small(&dark), &small(&textured)), None);
        assert_eq!(align(&small(&textured), &small(&tall)), None);

        let tiny = RgbImage {
            width: 8,
            height: 6,
            bytes: vec![7; 8 * 6 * 3],
        };
        assert_eq!(SmallImage::of(&tiny), None);
    }
}

//! Matches of image points between two frames with known poses.
//!
//! Corners are matched by the correlation of their patches, within a band along the epipolar line.
//! The band is wide, so that the matches do not depend on the exact camera.

use nalgebra::{Matrix2, Vector2, Vector3};

use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::image::RgbImage;

/// Width of reduced images, pixels. Narrower images keep their size.
const WIDTH: usize = 320;
/// Minimum shorter side of a reduced image, pixels.
const LEAST_SIDE: usize = 64;
/// Maximum number of corners of an image.
const CORNERS: usize = 400;
/// Half the side of the window in which the texture of a corner is measured, pixels.
const WINDOW: usize = 2;
/// Minimum distance between corners along each axis, pixels.
const SPACING: usize = 4;
/// Minimum texture of a corner: mean squared gradient along the weaker direction, in squared gray
/// levels (0 to 255) per squared pixel.
const LEAST_TEXTURE: f32 = 4.0;
/// Half the side of a patch, pixels.
const PATCH: isize = 5;
/// Number of pixels of a patch.
const PATCH_PIXELS: usize = ((2 * PATCH + 1) * (2 * PATCH + 1)) as usize;
/// Distance of corners from the border, pixels.
const BORDER: usize = 10;
/// Minimum correlation of the patches of a match.
const LEAST_CORRELATION: f32 = 0.8;
/// Minimum difference in correlation between the best and the second-best candidate.
const DISTINCT_BY: f32 = 0.03;
/// Largest growth or shrinkage of a patch that the rotation between two frames explains.
const LARGEST_SCALE: f64 = 2.0;

/// A grayscale image with its corners.
#[derive(Debug, Clone)]
pub(crate) struct CornerImage {
    gray: GrayImage,
    corners: Vec<Corner>,
}

/// Brightness, 0 to 255, row by row from the top left.
#[derive(Debug, Clone)]
struct GrayImage {
    width: usize,
    height: usize,
    brightness: Vec<f32>,
    /// Width and height of a pixel, image widths.
    pixel: Vector2<f64>,
}

#[derive(Debug, Clone)]
struct Corner {
    /// Column and row.
    at: [usize; 2],
    patch: Patch,
}

/// Brightness of a square around a point, with mean 0 and length 1.
type Patch = [f32; PATCH_PIXELS];

/// The camera and the motion between two frames.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PairGeometry<'a> {
    /// The camera, of which a rough estimate suffices.
    pub camera: &'a CameraIntrinsics,
    /// The motion: the second camera's coordinates from the first one's.
    pub second_from_first: Pose,
    /// Largest distance of a match from its epipolar line, pixels of an image 320 wide.
    pub gate_px: f64,
}

impl CornerImage {
    /// Reduces an image and finds its corners; `None` if it is too small.
    pub fn of(image: &RgbImage) -> Option<Self> {
        let gray = GrayImage::of(image)?;
        let corners = gray.corners();
        Some(Self { gray, corners })
    }
}

/// Matched points of two frames, image widths. Each is the best match of the other.
pub(crate) fn match_points(
    first: &CornerImage,
    second: &CornerImage,
    geometry: &PairGeometry<'_>,
) -> Vec<[Vector2<f64>; 2]> {
    let places: Vec<Vector3<f64>> = second
        .corners
        .iter()
        .map(|corner| geometry.direction(second.gray.point(corner.center())))
        .collect();

    // The best candidate of each corner of the first image, and the best corner of each candidate.
    let mut best = Vec::with_capacity(first.corners.len());
    let mut best_of_second = vec![(LEAST_CORRELATION, usize::MAX); second.corners.len()];
    for (row, corner) in first.corners.iter().enumerate() {
        let point = first.gray.point(corner.center());
        let template = geometry
            .warp(point)
            .and_then(|warp| first.gray.patch(corner.center(), &warp));
        let Some(template) = template else {
            best.push(None);
            continue;
        };

        let line = geometry.line(point);
        let mut found = (LEAST_CORRELATION, usize::MAX);
        let mut second_best = 0.0_f32;
        for (place, candidate) in second.corners.iter().enumerate() {
            if line.dot(&places[place]).abs() > 1.0 {
                continue;
            }
            let correlation = correlation(&template, &candidate.patch);
            if correlation > found.0 {
                if found.1 != usize::MAX {
                    second_best = found.0;
                }
                found = (correlation, place);
            } else {
                second_best = second_best.max(correlation);
            }
            if correlation > best_of_second[place].0 {
                best_of_second[place] = (correlation, row);
            }
        }
        let is_distinct = found.1 != usize::MAX && found.0 - second_best >= DISTINCT_BY;
        best.push(is_distinct.then_some((found.1, template)));
    }

    let mut matches = Vec::new();
    for (row, found) in best.into_iter().enumerate() {
        let Some((place, template)) = found else {
            continue;
        };
        if best_of_second[place].1 != row {
            continue;
        }
        if let Some(at) = second.gray.refined(second.corners[place].at, &template) {
            let point = first.gray.point(first.corners[row].center());
            matches.push([point, second.gray.point(at)]);
        }
    }
    matches
}

impl PairGeometry<'_> {
    /// Direction of an image point, at depth 1.
    fn direction(&self, point: Vector2<f64>) -> Vector3<f64> {
        self.camera.to_image_plane(point).push(1.0)
    }

    /// The epipolar line of a point of the first image, in units of the gate: its product with a
    /// direction is within ±1 inside the band.
    fn line(&self, point: Vector2<f64>) -> Vector3<f64> {
        let turned = self.second_from_first.rotation * self.direction(point);
        let line = self.second_from_first.translation.vector.cross(&turned);
        let focal_px = self.camera.focal().mean() * WIDTH as f64;
        line * (focal_px / (self.gate_px * line.xy().norm().max(1e-12)))
    }

    /// Derivative of a point of the first image by the point of the second image to which the
    /// rotation alone moves it. `None` if it leaves the image plane or changes size too much.
    fn warp(&self, point: Vector2<f64>) -> Option<Matrix2<f64>> {
        let rotation = self.second_from_first.rotation;
        let direction = self.direction(point);
        let turned = rotation * direction;
        if turned.z < 0.1 {
            return None;
        }

        // Derivative of (x / z, y / z) of the turned direction.
        let column = |axis: Vector3<f64>| {
            let moved = rotation * axis;
            (moved.xy() - turned.xy() * (moved.z / turned.z)) / turned.z
        };
        let forward = Matrix2::from_columns(&[column(Vector3::x()), column(Vector3::y())]);
        let scale = forward.determinant().abs().sqrt();
        let is_usual = (LARGEST_SCALE.recip()..LARGEST_SCALE).contains(&scale);
        is_usual.then(|| forward.try_inverse()).flatten()
    }
}

impl Corner {
    fn center(&self) -> Vector2<f64> {
        Vector2::new(self.at[0] as f64, self.at[1] as f64)
    }
}

impl GrayImage {
    /// The mean brightness of the pixels of `image` in each pixel.
    fn of(image: &RgbImage) -> Option<Self> {
        let width = image.width.min(WIDTH);
        let height = image.height * width / image.width.max(1);
        if width.min(height) < LEAST_SIDE {
            return None;
        }

        let mut sums = vec![(0_u32, 0_u32); width * height];
        let columns: Vec<usize> = (0..image.width).map(|x| x * width / image.width).collect();
        let rows = image.bytes.chunks_exact(3 * image.width);
        for (y, bytes) in rows.enumerate() {
            let start = y * height / image.height * width;
            for (column, color) in columns.iter().zip(bytes.chunks_exact(3)) {
                let (sum, count) = &mut sums[start + column];
                *sum += color.iter().copied().map(u32::from).sum::<u32>();
                *count += 3;
            }
        }

        let aspect = image.height as f64 / image.width as f64;
        Some(Self {
            width,
            height,
            brightness: sums
                .iter()
                .map(|(sum, n)| *sum as f32 / *n as f32)
                .collect(),
            pixel: Vector2::new(1.0 / width as f64, aspect / height as f64),
        })
    }

    /// The image point of a pixel position, image widths from the top left corner.
    fn point(&self, at: Vector2<f64>) -> Vector2<f64> {
        at.add_scalar(0.5).component_mul(&self.pixel)
    }

    /// The strongest corners by Shi and Tomasi: the smaller eigenvalue of the matrix of gradients.
    fn corners(&self) -> Vec<Corner> {
        let texture = self.texture();
        let mut found = Vec::new();
        for y in BORDER..self.height - BORDER {
            for x in BORDER..self.width - BORDER {
                let here = texture[y * self.width + x];
                if here < LEAST_TEXTURE {
                    continue;
                }
                let is_best = (y - SPACING..=y + SPACING).all(|row| {
                    let start = row * self.width + x - SPACING;
                    let others = &texture[start..=start + 2 * SPACING];
                    others.iter().all(|other| *other <= here)
                });
                if is_best {
                    found.push((here, [x, y]));
                }
            }
        }

        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(CORNERS);
        let corner = |(_, at): (f32, [usize; 2])| {
            let [x, y] = at.map(|place| place as isize);
            let patch = self.whole_patch(x, y)?;
            Some(Corner { at, patch })
        };
        found.into_iter().filter_map(corner).collect()
    }

    /// The smaller eigenvalue of the mean product of gradients around each pixel; 0 at the border.
    fn texture(&self) -> Vec<f32> {
        let width = self.width;
        let gradient = |at: usize| {
            let [x, y] = [at % width, at / width];
            if x == 0 || y == 0 || x + 1 == width || y + 1 == self.height {
                return [0.0; 2];
            }
            let right = (self.brightness[at + 1] - self.brightness[at - 1]) / 2.0;
            let down = (self.brightness[at + width] - self.brightness[at - width]) / 2.0;
            [right, down]
        };
        let gradients: Vec<[f32; 2]> = (0..self.brightness.len()).map(gradient).collect();
        let [xx, xy, yy] = [[0, 0], [0, 1], [1, 1]].map(|[a, b]| {
            let products: Vec<f32> = gradients.iter().map(|axes| axes[a] * axes[b]).collect();
            self.window_means(&products)
        });

        let smaller = |at: usize| {
            let half = (xx[at] - yy[at]) / 2.0;
            (xx[at] + yy[at]) / 2.0 - (half * half + xy[at] * xy[at]).sqrt()
        };
        (0..self.brightness.len()).map(smaller).collect()
    }

    /// The mean in a window around each pixel; 0 at the border.
    fn window_means(&self, values: &[f32]) -> Vec<f32> {
        let side = 2 * WINDOW + 1;
        let mean_along = |values: &[f32], step: usize| {
            let mut means = vec![0.0; values.len()];
            let inside = means.len() - 2 * WINDOW * step;
            let means_inside = means[WINDOW * step..].iter_mut().take(inside);
            for (start, mean) in means_inside.enumerate() {
                let sum: f32 = (0..side).map(|place| values[start + place * step]).sum();
                *mean = sum / side as f32;
            }
            means
        };
        mean_along(&mean_along(values, 1), self.width)
    }

    /// The patch around a pixel. `None` at the border and without texture.
    fn whole_patch(&self, x: isize, y: isize) -> Option<Patch> {
        let is_inside = x >= PATCH
            && y >= PATCH
            && x + PATCH < self.width as isize
            && y + PATCH < self.height as isize;
        if !is_inside {
            return None;
        }

        let mut patch = [0.0; PATCH_PIXELS];
        let side = (2 * PATCH + 1) as usize;
        for (row, values) in patch.chunks_exact_mut(side).enumerate() {
            let start = (y - PATCH) as usize * self.width + (x - PATCH) as usize + row * self.width;
            values.copy_from_slice(&self.brightness[start..start + side]);
        }
        standardized(patch)
    }

    /// The patch around a pixel, with its offsets multiplied by `warp`. `None` at the border and
    /// without texture.
    fn patch(&self, center: Vector2<f64>, warp: &Matrix2<f64>) -> Option<Patch> {
        let mut patch = [0.0; PATCH_PIXELS];
        let offsets = (-PATCH..=PATCH).flat_map(|y| (-PATCH..=PATCH).map(move |x| [x, y]));
        for (value, [x, y]) in patch.iter_mut().zip(offsets) {
            *value = self.sample(center + warp * Vector2::new(x as f64, y as f64))?;
        }
        standardized(patch)
    }

    /// Brightness at a sub-pixel position, bilinearly interpolated; `None` outside the image.
    fn sample(&self, at: Vector2<f64>) -> Option<f32> {
        let last = Vector2::new(self.width as f64 - 1.0, self.height as f64 - 1.0);
        if !(at.x >= 0.0 && at.y >= 0.0 && at.x < last.x && at.y < last.y) {
            return None;
        }

        let start = at.y as usize * self.width + at.x as usize;
        let [right, down] = [at.x.fract() as f32, at.y.fract() as f32];
        let row = |start: usize| {
            let [a, b] = [self.brightness[start], self.brightness[start + 1]];
            a + right * (b - a)
        };
        let [above, below] = [row(start), row(start + self.width)];
        Some(above + down * (below - above))
    }

    /// The sub-pixel position of best correlation with `template` near a pixel: the peak of a
    /// parabola along each axis. `None` if no pixel within two is a local maximum.
    fn refined(&self, at: [usize; 2], template: &Patch) -> Option<Vector2<f64>> {
        let [mut x, mut y] = at.map(|place| place as isize);
        let score = |x: isize, y: isize| {
            let patch = self.whole_patch(x, y)?;
            Some(correlation(template, &patch))
        };

        for _ in 0..=2 {
            let here = score(x, y)?;
            let across = [score(x - 1, y)?, score(x + 1, y)?];
            let down = [score(x, y - 1)?, score(x, y + 1)?];
            let steps = [across, down].map(|[before, after]| {
                isize::from(after > here && after >= before)
                    - isize::from(before > here && before > after)
            });
            if steps == [0, 0] {
                let [dx, dy] = [across, down].map(|sides| peak(sides, here));
                return Some(Vector2::new(x as f64 + dx, y as f64 + dy));
            }
            x += steps[0];
            y += steps[1];
        }
        None
    }
}

/// The place of the maximum, -0.5 to 0.5, of the parabola through values at -1, 0 and 1.
fn peak([before, after]: [f32; 2], here: f32) -> f64 {
    let curvature = f64::from(before + after - 2.0 * here);
    if curvature >= 0.0 {
        return 0.0;
    }
    (f64::from(before - after) / (2.0 * curvature)).clamp(-0.5, 0.5)
}

fn correlation(a: &Patch, b: &Patch) -> f32 {
    // Eight sums instead of one let the compiler use vector instructions.
    let mut sums = [0.0_f32; 8];
    let [a, b] = [a.chunks_exact(8), b.chunks_exact(8)];
    let rest: f32 = a
        .remainder()
        .iter()
        .zip(b.remainder())
        .map(|(a, b)| a * b)
        .sum();
    for (a, b) in a.zip(b) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    rest + sums.iter().sum::<f32>()
}

/// The patch with mean 0 and length 1; `None` without texture.
fn standardized(mut patch: Patch) -> Option<Patch> {
    let mean = patch.iter().sum::<f32>() / PATCH_PIXELS as f32;
    patch.iter_mut().for_each(|value| *value -= mean);
    let length = correlation(&patch, &patch).sqrt();
    if length < 1.0 {
        return None;
    }
    patch.iter_mut().for_each(|value| *value /= length);
    Some(patch)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use seese3_core::geometry::{Distortion, PixelCamera};
    use seese3_core::statistics::{median, quantile};

    const SIZE: [usize; 2] = [320, 240];

    fn camera(focal_px: f64) -> CameraIntrinsics {
        CameraIntrinsics::new(PixelCamera {
            width: 320.0,
            height: 240.0,
            focal: Vector2::repeat(focal_px),
            center: None,
            distortion: Distortion::None,
        })
        .unwrap()
    }

    /// The place on the plane at depth 1 of the world that a camera sees at an image point.
    fn on_plane(pose: &Pose, camera: &CameraIntrinsics, point: Vector2<f64>) -> Point3<f64> {
        let ray = pose.rotation * camera.to_image_plane(point).push(1.0);
        let start = pose.translation.vector;
        Point3::from(start + ray * ((1.0 - start.z) / ray.z))
    }

    /// An image of the plane, painted with waves of all directions.
    fn view(pose: &Pose, camera: &CameraIntrinsics, contrast: f64) -> RgbImage {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let waves: Vec<[f64; 3]> = (0..60)
            .map(|_| [120.0, 120.0, 3.0].map(|most| random.random_range(-most..most)))
            .collect();
        let mut bytes = Vec::new();
        for place in 0..SIZE[0] * SIZE[1] {
            let pixel = Vector2::new((place % SIZE[0]) as f64, (place / SIZE[0]) as f64);
            let seen = on_plane(pose, camera, pixel.add_scalar(0.5) / 320.0);
            let sum: f64 = waves
                .iter()
                .map(|[x, y, phase]| (x * seen.x + y * seen.y + phase).sin())
                .sum();
            bytes.extend([(128.0 + contrast * sum).clamp(0.0, 255.0) as u8; 3]);
        }
        RgbImage {
            width: SIZE[0],
            height: SIZE[1],
            bytes,
        }
    }

    /// Oracle: where the ray of the first point meets the painted plane, projected into the second
    /// camera, which is turned about all axes. The matcher is given a focal length that is wrong by
    /// a fifth.
    #[test]
    fn matches_are_views_of_one_place() {
        let truth = camera(260.0);
        let first_pose = Pose::identity();
        let second_pose = Pose::new(
            Vector3::new(0.15, -0.05, 0.03),
            Vector3::new(0.05, -0.1, 0.3),
        );
        let image = |pose: &Pose| CornerImage::of(&view(pose, &truth, 10.0)).unwrap();
        let [first, second] = [image(&first_pose), image(&second_pose)];

        for (focal_px, gate_px) in [(260.0, 12.0), (312.0, 24.0), (208.0, 24.0)] {
            let geometry = PairGeometry {
                camera: &camera(focal_px),
                second_from_first: second_pose.inv_mul(&first_pose),
                gate_px,
            };
            let found = match_points(&first, &second, &geometry);
            let errors: Vec<Vector2<f64>> = found
                .iter()
                .map(|[a, b]| {
                    let place = on_plane(&first_pose, &truth, *a);
                    let there = second_pose.inverse() * place;
                    let expected = truth.project(there.coords).unwrap();
                    320.0 * (b - expected)
                })
                .collect();
            assert!(found.len() > 60, "{focal_px}: {}", found.len());
            for axis in [0, 1] {
                let along: Vec<f64> = errors.iter().map(|error| error[axis]).collect();
                let bias_px = median(&along);
                assert!(bias_px.abs() < 0.05, "{focal_px}: {bias_px}");
            }
            let errors_px: Vec<f64> = errors.iter().map(|error| error.norm()).collect();
            let [half, most] = [0.5, 0.9].map(|share| quantile(&errors_px, share).unwrap());
            assert!(half < 0.25 && most < 1.0, "{focal_px}: {half} {most}");
        }
    }

    /// Oracle: the definition. An image without texture has no match, and a tiny one no corners.
    #[test]
    fn images_without_texture_do_not_match() {
        let truth = camera(260.0);
        let moved = Pose::translation(0.1, 0.0, 0.0);
        let first = CornerImage::of(&view(&Pose::identity(), &truth, 10.0)).unwrap();
        let blank = CornerImage::of(&view(&moved, &truth, 0.0)).unwrap();
        let geometry = PairGeometry {
            camera: &truth,
            second_from_first: moved.inverse(),
            gate_px: 12.0,
        };
        assert!(match_points(&first, &blank, &geometry).is_empty());
        assert!(match_points(&blank, &first, &geometry).is_empty());

        let tiny = RgbImage {
            width: 40,
            height: 30,
            bytes: vec![9; 40 * 30 * 3],
        };
        assert!(CornerImage::of(&tiny).is_none());
    }
}

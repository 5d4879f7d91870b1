//! Camera model: motion blur, exposure, white balance, vignetting and sensor noise.

use nalgebra::{Isometry3, Matrix4, Vector4};

use super::render::{Camera, Radiance};
use super::texture::hash2;
use seese3_core::image::RgbImage;

/// Camera settings of one photograph.
#[derive(Debug, Clone)]
pub(super) struct Shot {
    /// Camera motion while the shutter is open: the end pose in the start pose's frame, meters.
    pub motion: Isometry3<f64>,
    /// Exposure factor, in addition to the automatic exposure.
    pub exposure: f64,
    /// White balance: factors of red, green and blue.
    pub white: [f64; 3],
    /// Vignetting: relative darkening at the image corners.
    pub vignette: f64,
    /// Standard deviations of photon noise in a white pixel and of electronic noise; 1 is white.
    pub noise: [f64; 2],
    pub seed: u32,
}

/// Automatic exposure: target mean light, linear, and the fraction of the logarithmic difference
/// that is corrected.
const METER: (f64, f64) = (0.2, 0.75);

/// Number of samples of motion blur per pixel.
const BLUR: usize = 6;

/// The photograph of `radiance`, the light at `camera` in the middle of the exposure.
pub(super) fn photograph(radiance: &Radiance, camera: Camera, shot: &Shot) -> RgbImage {
    let Radiance { width, height, .. } = *radiance;
    let gain = shot.exposure * metered(radiance);
    let tone = Tone::new();
    let blur = Blur::new(radiance, camera, shot.motion);
    let corner = (width * width + height * height) as f64 / 4.0;
    let mut bytes = Vec::with_capacity(width * height * 3);

    for row in 0..height {
        for column in 0..width {
            let light = blur.light(column, row);

            // Vignetting grows with the squared distance from the image center.
            let right = column as f64 - width as f64 / 2.0;
            let down = row as f64 - height as f64 / 2.0;
            let lens = 1.0 - shot.vignette * (right * right + down * down) / corner;

            for (channel, &light) in light.iter().enumerate() {
                let exposed = (gain * lens * shot.white[channel] * light).min(1.5);

                // The variance of photon noise is proportional to the light; that of electronic
                // noise is constant.
                let [white, black] = shot.noise;
                let deviation = (white * white * exposed + black * black).sqrt();
                let place = (row * width + column) * 3 + channel;

                bytes.push(tone.of(exposed + deviation * grain(place, shot.seed)));
            }
        }
    }

    RgbImage {
        width,
        height,
        bytes,
    }
}

/// The gain of the automatic exposure. It corrects only part of the difference to the target.
fn metered(radiance: &Radiance) -> f64 {
    let sum: f64 = radiance
        .light
        .iter()
        .map(|[red, green, blue]| (0.3 * red + 0.6 * green + 0.1 * blue).min(2.0))
        .sum();
    let mean = sum / radiance.light.len() as f64;
    let (aim, share) = METER;

    (aim / mean.max(1e-3)).powf(share)
}

/// Motion blur of an image.
struct Blur<'a> {
    radiance: &'a Radiance,
    /// The size of a pixel at distance 1.
    scale: f64,
    /// Transform from the camera frame at the start of the exposure to that at its end.
    end_from_begin: Matrix4<f64>,
}

impl<'a> Blur<'a> {
    fn new(radiance: &'a Radiance, camera: Camera, motion: Isometry3<f64>) -> Self {
        Self {
            radiance,
            scale: camera.pixel(),
            end_from_begin: motion.inverse().to_homogeneous(),
        }
    }

    /// The mean light along the image motion of a pixel.
    fn light(&self, column: usize, row: usize) -> [f64; 3] {
        let Radiance { width, height, .. } = *self.radiance;
        let still = self.radiance.light[row * width + column];
        let [right, down] = self.way(column, row);

        // Skip motions below 0.7 pixels. Skip those above a fifth of the image width too: they
        // belong to surfaces nearer than a real lens allows.
        let squared_length = right * right + down * down;
        let limit = (width as f64 / 5.0).powi(2);
        if !(0.5..limit).contains(&squared_length) {
            return still;
        }

        let mut sum = [0.0; 3];
        for sample in 0..BLUR {
            let share = (sample as f64 + 0.5) / BLUR as f64 - 0.5;
            let beside = |from: usize, by: f64, size: usize| {
                ((from as f64 + by * share + 0.5) as usize).min(size - 1)
            };
            let at = beside(row, down, height) * width + beside(column, right, width);
            let light = self.radiance.light[at];
            (0..3).for_each(|c| sum[c] += light[c]);
        }

        sum.map(|channel| channel / BLUR as f64)
    }

    /// Image motion of a pixel's surface during the exposure, pixels to the right and down.
    fn way(&self, column: usize, row: usize) -> [f64; 2] {
        let Radiance { width, height, .. } = *self.radiance;

        // The surface point in the camera frame, then in the camera frame at the end.
        let x = (column as f64 + 0.5 - width as f64 / 2.0) * self.scale;
        let y = (row as f64 + 0.5 - height as f64 / 2.0) * self.scale;
        let distance = f64::from(self.radiance.distance[row * width + column]);
        let depth = distance / (1.0 + x * x + y * y).sqrt();
        let after = self.end_from_begin * Vector4::new(x * depth, y * depth, depth, 1.0);

        [
            (after.x / after.z - x) / self.scale,
            (after.y / after.z - y) / self.scale,
        ]
    }
}

/// Noise of mean 0 and standard deviation 1 for an index in the image: the sum of four uniform
/// numbers.
fn grain(place: usize, seed: u32) -> f64 {
    let bits = (hash2(place as i64, 0, seed) * f64::from(u32::MAX)) as u32;
    let sum: u32 = bits.to_le_bytes().into_iter().map(u32::from).sum();

    // A uniform byte has variance (256² − 1) / 12.
    (f64::from(sum) - 510.0) / (4.0 * 65_535.0 / 12.0_f64).sqrt()
}

/// Lookup table from linear light to image bytes: the power 1 / 2.2.
struct Tone {
    bytes: Vec<u8>,
}

impl Tone {
    const STEPS: usize = 8_192;

    fn new() -> Self {
        let bytes = (0..=Self::STEPS)
            .map(|step| {
                let light = step as f64 / Self::STEPS as f64;
                (255.0 * light.powf(1.0 / 2.2)).round() as u8
            })
            .collect();

        Self { bytes }
    }

    fn of(&self, light: f64) -> u8 {
        self.bytes[(light.clamp(0.0, 1.0) * Self::STEPS as f64) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera of 40 × 30 pixels with a focal length of 20 pixels.
    fn camera() -> Camera {
        Camera {
            field_of_view_rad: std::f64::consts::FRAC_PI_2,
            ..Camera::sized(40, 30)
        }
    }

    fn shot(motion: Isometry3<f64>) -> Shot {
        Shot {
            motion,
            exposure: 1.0,
            white: [1.0; 3],
            vignette: 0.0,
            noise: [0.0; 2],
            seed: 1,
        }
    }

    /// A white column of pixels on black; all pixels are `distance` meters away.
    fn stripe(distance: f32) -> Radiance {
        let light = (0..40 * 30)
            .map(|at| if at % 40 == 20 { [1.0; 3] } else { [0.0; 3] })
            .collect();

        Radiance {
            width: 40,
            height: 30,
            light,
            distance: vec![distance; 40 * 30],
        }
    }

    /// Oracle: the pinhole camera by hand. With a focal length of 20 pixels, a step of 0.3 m moves
    /// an image point at 1 m by 6 pixels, so a line blurs over about 6 columns. At 4 m it is a
    /// quarter of that, which covers up to 3 columns.
    #[test]
    fn what_is_near_blurs_more() {
        let motion = Isometry3::translation(0.3, 0.0, 0.0);
        let smeared = |meters: f32| {
            let radiance = stripe(meters);
            let blur = Blur::new(&radiance, camera(), motion);
            (0..40)
                .filter(|&column| blur.light(column, 15)[0] > 0.0)
                .count()
        };

        assert!((5..=7).contains(&smeared(1.0)), "{}", smeared(1.0));
        assert!((1..=3).contains(&smeared(4.0)), "{}", smeared(4.0));
    }

    /// Oracle: the definition of the automatic exposure. It corrects 75 % of the change, so twice
    /// the light gives 2^0.25 times the linear brightness.
    #[test]
    fn the_meter_takes_back_most_of_a_change_of_light() {
        let grey = |light: f64| Radiance {
            width: 40,
            height: 30,
            light: vec![[light; 3]; 40 * 30],
            distance: vec![1.0; 40 * 30],
        };
        let taken = |light: f64| {
            let image = photograph(&grey(light), camera(), &shot(Isometry3::identity()));
            (f64::from(image.pixel(20, 15)[0]) / 255.0).powf(2.2)
        };

        let ratio = taken(0.4) / taken(0.2);
        assert!((ratio - 2f64.powf(0.25)).abs() < 0.02, "{ratio}");
    }

    /// Oracle: the definitions of mean and deviation.
    #[test]
    fn grain_has_mean_zero_and_deviation_one() {
        let noise: Vec<f64> = (0..20_000).map(|place| grain(place, 5)).collect();
        let mean = noise.iter().sum::<f64>() / 20_000.0;
        let square = noise.iter().map(|value| value * value).sum::<f64>() / 20_000.0;

        assert!(
            mean.abs() < 0.03 && (square - 1.0).abs() < 0.04,
            "{mean} {square}"
        );
    }
}

//! Disturbances of a camera's images and of its frame rate.

use image::imageops;
use nalgebra::{Unit, Vector2, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use seese3_core::geometry::Pose;
use seese3_core::image::RgbImage;
use seese3_core::statistics::normal_deviates;
use seese3_robot::pose_filter::MeasuredGravity;

/// Image width for which blurs are stated, pixels; blurs scale with the image width.
const STATED_WIDTH: f64 = 640.0;
/// Period of the occluder's motion across the image and back, frames.
const OCCLUDER_PERIOD: usize = 40;
/// The brightness of the occluder, 0 to 255.
const OCCLUDER_BRIGHTNESS: u8 = 60;

/// Error of the simulated gravity direction, radians.
const GRAVITY_ERROR_RAD: f64 = 0.02;
/// Standard deviation of the gravity direction passed to the tracker, radians: the service's
/// default.
const GRAVITY_DEVIATION_RAD: f64 = 0.03;

/// A disturbance of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Disturbance {
    /// The unchanged images.
    None,
    /// The camera is rotated about its optical axis. Corners are filled with the nearest edge
    /// pixels.
    Roll {
        /// Clockwise angle, degrees.
        degrees: f64,
        /// Whether the robot measures the direction of gravity.
        with_gravity: bool,
    },
    /// A Gaussian blur.
    Blur {
        /// Standard deviation, pixels in an image 640 pixels wide.
        deviation: f64,
    },
    /// The brightness of every pixel is multiplied by a factor.
    Exposure {
        /// The factor.
        factor: f64,
    },
    /// A gray bar of full image height moves across the image, back and forth.
    Occluder {
        /// Fraction of the image that the bar covers.
        share: f64,
    },
    /// Gaussian noise is added to every pixel and channel.
    Noise {
        /// Standard deviation, on the scale 0 to 255.
        deviation: f64,
    },
    /// The camera has a narrower field of view than the mapping camera, unknown to the tracker.
    FieldOfView {
        /// Fraction of the width and of the height that the camera sees.
        share: f64,
    },
    /// One image is repeated with new timestamps for a part of the stream, while the camera moves.
    Frozen,
    /// Every pixel has the same brightness for a part of the stream.
    Blank {
        /// The brightness, 0 to 255.
        brightness: u8,
    },
    /// The camera has a lower frame rate, and numbers its frames consecutively.
    Rate {
        /// One of this many tracked frames is taken.
        every: usize,
    },
}

/// Which frames of a stream are disturbed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// All frames.
    Whole,
    /// A part in the middle of each stream.
    Part,
}

impl Disturbance {
    /// The disturbances of a full evaluation, in the order of tables.
    pub const ALL: [Self; 19] = [
        Self::None,
        Self::roll(10.0, false),
        Self::roll(-10.0, false),
        Self::roll(10.0, true),
        Self::roll(-10.0, true),
        Self::Blur { deviation: 2.0 },
        Self::Blur { deviation: 4.0 },
        Self::Exposure { factor: 0.6 },
        Self::Exposure { factor: 1.4 },
        Self::Occluder { share: 0.2 },
        Self::Noise { deviation: 10.0 },
        Self::Noise { deviation: 25.0 },
        Self::FieldOfView { share: 0.8 },
        Self::Frozen,
        Self::Blank { brightness: 0 },
        Self::Blank { brightness: 255 },
        Self::Rate { every: 2 },
        Self::Rate { every: 4 },
        Self::Rate { every: 8 },
    ];

    const fn roll(degrees: f64, with_gravity: bool) -> Self {
        Self::Roll {
            degrees,
            with_gravity,
        }
    }

    /// Its name in tables and JSON.
    pub fn name(self) -> String {
        match self {
            Self::None => "none".to_owned(),
            Self::Roll {
                degrees,
                with_gravity: false,
            } => format!("roll {degrees}°"),
            Self::Roll { degrees, .. } => format!("roll {degrees}°, gravity"),
            Self::Blur { deviation } => format!("blur {deviation} px"),
            Self::Exposure { factor } => format!("exposure × {factor}"),
            Self::Occluder { share } => format!("occluder {:.0} %", 100.0 * share),
            Self::Noise { deviation } => format!("noise {deviation} of 255"),
            Self::FieldOfView { share } => format!("field of view × {share}"),
            Self::Frozen => "frozen".to_owned(),
            Self::Blank { brightness: 0 } => "black".to_owned(),
            Self::Blank { brightness: 255 } => "white".to_owned(),
            Self::Blank { brightness } => format!("blank {brightness}"),
            Self::Rate { every } => format!("1 of {every} frames"),
        }
    }

    /// Which frames of a stream it disturbs.
    pub fn extent(self) -> Extent {
        match self {
            Self::Frozen | Self::Blank { .. } => Extent::Part,
            _ => Extent::Whole,
        }
    }

    /// Whether all images are images of the undisturbed camera, possibly repeated or skipped.
    pub fn keeps_images(self) -> bool {
        matches!(self, Self::None | Self::Frozen | Self::Rate { .. })
    }

    /// The pose of the disturbed camera for an undisturbed camera at `pose`; both
    /// `world_from_camera`. A clockwise roll is a rotation about +z, from x (right) to y (down).
    pub fn truth(self, pose: &Pose) -> Pose {
        match self {
            Self::Roll { degrees, .. } => {
                let turn = Vector3::new(0.0, 0.0, degrees.to_radians());
                pose * Pose::new(Vector3::zeros(), turn)
            }
            _ => *pose,
        }
    }

    /// The gravity direction measured by a robot with its camera at `pose`; `None` if the robot
    /// does not measure gravity. `down` is the true direction in the world frame. The measurement
    /// has a constant error of 0.02 rad (1.1°) about the camera's axis.
    pub fn gravity(self, pose: &Pose, down: Unit<Vector3<f64>>) -> Option<MeasuredGravity> {
        let Self::Roll {
            with_gravity: true, ..
        } = self
        else {
            return None;
        };

        let error = Pose::rotation(Vector3::z() * GRAVITY_ERROR_RAD);
        Some(MeasuredGravity {
            in_world: down,
            in_camera: error.rotation * (pose.rotation.inverse() * down),
            deviation_rad: GRAVITY_DEVIATION_RAD,
        })
    }

    /// The disturbed image of frame `number` of a stream.
    pub fn disturbed(self, picture: &RgbImage, number: usize) -> RgbImage {
        match self {
            Self::None | Self::Frozen | Self::Rate { .. } => picture.clone(),
            Self::Roll { degrees, .. } => turned(picture, degrees.to_radians()),
            Self::Blur { deviation } => {
                blurred(picture, deviation * picture.width as f64 / STATED_WIDTH)
            }
            Self::Exposure { factor } => {
                with_bytes(picture, |byte, _| rounded(f64::from(byte) * factor))
            }
            Self::Occluder { share } => occluded(picture, share, number),
            Self::Noise { deviation } => noisy(picture, deviation, number as u64),
            Self::FieldOfView { share } => resampled(picture, |from_center| from_center * share),
            Self::Blank { brightness } => with_bytes(picture, |_, _| brightness),
        }
    }
}

/// The image of a camera rolled clockwise by an angle; the scene rotates the opposite way.
fn turned(picture: &RgbImage, radians: f64) -> RgbImage {
    let (sin, cos) = radians.sin_cos();
    resampled(picture, |at| {
        Vector2::new(cos * at.x - sin * at.y, sin * at.x + cos * at.y)
    })
}

/// Resamples an image bilinearly. `source` maps an output pixel to an input pixel, both relative
/// to the image center. Positions outside the image are clamped to its edge.
fn resampled(picture: &RgbImage, source: impl Fn(Vector2<f64>) -> Vector2<f64>) -> RgbImage {
    let last = Vector2::new(picture.width as f64 - 1.0, picture.height as f64 - 1.0);
    let center = last / 2.0;

    let mut bytes = Vec::with_capacity(picture.bytes.len());
    for y in 0..picture.height {
        for x in 0..picture.width {
            let at = Vector2::new(x as f64, y as f64) - center;
            let from = source(at) + center;
            let from = Vector2::new(from.x.clamp(0.0, last.x), from.y.clamp(0.0, last.y));
            bytes.extend(bilinear(picture, from));
        }
    }

    RgbImage { bytes, ..*picture }
}

fn bilinear(picture: &RgbImage, at: Vector2<f64>) -> [u8; 3] {
    let (left, top) = (at.x.floor() as usize, at.y.floor() as usize);
    let right = (left + 1).min(picture.width - 1);
    let bottom = (top + 1).min(picture.height - 1);
    let part = Vector2::new(at.x.fract(), at.y.fract());

    std::array::from_fn(|channel| {
        let value = |x, y| f64::from(picture.pixel(x, y)[channel]);
        let above = value(left, top) * (1.0 - part.x) + value(right, top) * part.x;
        let below = value(left, bottom) * (1.0 - part.x) + value(right, bottom) * part.x;
        rounded(above * (1.0 - part.y) + below * part.y)
    })
}

fn blurred(picture: &RgbImage, deviation: f64) -> RgbImage {
    let (width, height) = (picture.width as u32, picture.height as u32);
    // The byte count always matches the size, so the fallback is never taken.
    let Some(buffer) = image::RgbImage::from_raw(width, height, picture.bytes.clone()) else {
        return picture.clone();
    };

    RgbImage {
        bytes: imageops::blur(&buffer, deviation as f32).into_raw(),
        ..*picture
    }
}

fn occluded(picture: &RgbImage, share: f64, number: usize) -> RgbImage {
    // The left edge of the bar moves from 0 to 1 − share and back.
    let phase = (number % OCCLUDER_PERIOD) as f64 / OCCLUDER_PERIOD as f64;
    let left = (1.0 - share) * (1.0 - (2.0 * phase - 1.0).abs());
    let width = picture.width as f64;

    with_bytes(picture, |byte, at| {
        let x = (at / 3 % picture.width) as f64 / width;
        if x >= left && x < left + share {
            OCCLUDER_BRIGHTNESS
        } else {
            byte
        }
    })
}

fn noisy(picture: &RgbImage, deviation: f64, seed: u64) -> RgbImage {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let noise = normal_deviates(&mut random, picture.bytes.len());
    let bytes = picture.bytes.iter().zip(noise);

    RgbImage {
        bytes: bytes
            .map(|(byte, noise)| rounded(f64::from(*byte) + deviation * noise))
            .collect(),
        ..*picture
    }
}

fn with_bytes(picture: &RgbImage, change: impl Fn(u8, usize) -> u8) -> RgbImage {
    let bytes = picture.bytes.iter().enumerate();
    RgbImage {
        bytes: bytes.map(|(at, byte)| change(*byte, at)).collect(),
        ..*picture
    }
}

fn rounded(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    /// A black image of 41 × 31 pixels with one white pixel at (x, y).
    fn point(x: usize, y: usize) -> RgbImage {
        let mut picture = RgbImage {
            width: 41,
            height: 31,
            bytes: vec![0; 41 * 31 * 3],
        };
        let at = (y * 41 + x) * 3;
        picture.bytes[at..at + 3].fill(255);
        picture
    }

    fn brightest(picture: &RgbImage) -> (usize, usize) {
        let pixels = (0..picture.height).flat_map(|y| (0..picture.width).map(move |x| (x, y)));
        pixels.max_by_key(|&(x, y)| picture.pixel(x, y)[0]).unwrap()
    }

    /// Oracle: by hand. The camera rolls clockwise by 90°, so a point to the right of the center
    /// moves above it.
    #[test]
    fn a_camera_that_rolls_clockwise_sees_the_world_turn_the_other_way() {
        let quarter = Disturbance::roll(90.0, false);
        let turned = quarter.disturbed(&point(30, 15), 0);
        assert_eq!(brightest(&turned), (20, 5));

        // A point to the right of the level camera is above the rolled camera (y is down).
        let right = quarter.truth(&Pose::identity()).inverse() * Point3::new(1.0, 0.0, 5.0);
        assert!((right - Point3::new(0.0, -1.0, 5.0)).norm() < 1e-12);
    }

    /// Oracle: by hand. Half the field of view doubles the distance of a point from the center.
    #[test]
    fn a_narrower_field_of_view_magnifies() {
        let near = Disturbance::FieldOfView { share: 0.5 }.disturbed(&point(25, 15), 0);
        assert_eq!(brightest(&near), (30, 15));
    }

    /// Oracle: a Gaussian of unit sum has height 1 / (2πσ²), and e^(−1/2) of that at one σ.
    #[test]
    fn a_blur_is_a_gaussian() {
        let deviation = 3.0;
        let stated = deviation * STATED_WIDTH / 41.0;
        let blurred = Disturbance::Blur { deviation: stated }.disturbed(&point(20, 15), 0);
        let value = |x, y| f64::from(blurred.pixel(x, y)[0]);

        let height = 255.0 / (2.0 * std::f64::consts::PI * deviation * deviation);
        assert!((value(20, 15) - height).abs() < 1.0, "{}", value(20, 15));
        assert!((value(23, 15) - height * (-0.5_f64).exp()).abs() < 1.0);
    }

    /// Oracle: the definitions, on a gray image.
    #[test]
    fn exposure_noise_and_occluders_do_what_they_say() {
        let grey = RgbImage {
            width: 200,
            height: 100,
            bytes: vec![100; 200 * 100 * 3],
        };
        let bytes = |disturbance: Disturbance, number| disturbance.disturbed(&grey, number).bytes;

        assert!(
            bytes(Disturbance::Exposure { factor: 1.4 }, 0)
                .iter()
                .all(|&byte| byte == 140)
        );
        assert!(
            bytes(Disturbance::Exposure { factor: 3.0 }, 0)
                .iter()
                .all(|&byte| byte == 255)
        );

        let noisy = bytes(Disturbance::Noise { deviation: 10.0 }, 7);
        let squares = noisy.iter().map(|&byte| (f64::from(byte) - 100.0).powi(2));
        let deviation = (squares.sum::<f64>() / noisy.len() as f64).sqrt();
        assert!((deviation - 10.0).abs() < 0.2, "{deviation}");
        assert_ne!(noisy, bytes(Disturbance::Noise { deviation: 10.0 }, 8));

        for number in [0, 13, 20, 39] {
            let occluded = bytes(Disturbance::Occluder { share: 0.2 }, number);
            let covered = occluded
                .iter()
                .filter(|&&byte| byte == OCCLUDER_BRIGHTNESS)
                .count();
            let share = covered as f64 / occluded.len() as f64;
            assert!((share - 0.2).abs() < 0.006, "{share}");
        }
    }
}

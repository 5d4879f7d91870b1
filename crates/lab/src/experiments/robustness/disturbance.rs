//! What is done to a camera's images on the way to a tracker.

use image::imageops;
use nalgebra::{Unit, Vector2, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use seese3_core::geometry::Pose;
use seese3_core::image::RgbImage;
use seese3_core::statistics::normal_deviates;
use seese3_robot::tracking::MeasuredGravity;

/// The width in pixels for which blurs are stated; in other images they are as large a part.
const STATED_WIDTH: f64 = 640.0;
/// The occluder crosses the image once in so many frames.
const OCCLUDER_PERIOD: usize = 40;
/// The brightness of the occluder, 0 to 255.
const OCCLUDER_BRIGHTNESS: u8 = 60;

/// How far off measured directions of gravity are, radians.
const GRAVITY_ERROR_RAD: f64 = 0.02;
/// What the tracker is told of that, radians: what the service assumes if nobody says.
const GRAVITY_DEVIATION_RAD: f64 = 0.03;

/// A disturbance of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Disturbance {
    /// The images as they are.
    None,
    /// The camera is turned about its axis. Corners are filled with the nearest pixels of the edge.
    Roll {
        /// Clockwise, degrees.
        degrees: f64,
        /// Whether the robot measures which way is down.
        with_gravity: bool,
    },
    /// A Gaussian blur.
    Blur {
        /// Standard deviation, pixels of an image that is 640 wide.
        deviation: f64,
    },
    /// All brightness is multiplied.
    Exposure {
        /// By this.
        factor: f64,
    },
    /// A grey bar over the whole height moves across the image, back and forth.
    Occluder {
        /// The part of the image that it covers.
        share: f64,
    },
    /// Normal noise on every pixel and channel.
    Noise {
        /// Standard deviation, of 255.
        deviation: f64,
    },
    /// The camera sees less than the one that mapped, and is not known to.
    FieldOfView {
        /// The part of the width and of the height that it sees.
        share: f64,
    },
    /// For a while the same image comes again and again, with new times, while the camera moves on.
    Frozen,
    /// For a while every pixel has one brightness.
    Blank {
        /// 0 to 255.
        brightness: u8,
    },
    /// The camera takes fewer frames a second, and numbers those that it takes.
    Rate {
        /// Of so many tracked frames it takes one.
        every: usize,
    },
}

/// When a disturbance is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// From the first frame to the last.
    Whole,
    /// During a part in the middle of each stream.
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

    /// When it is there.
    pub fn extent(self) -> Extent {
        match self {
            Self::Frozen | Self::Blank { .. } => Extent::Part,
            _ => Extent::Whole,
        }
    }

    /// Whether the images are those of the undisturbed camera, though others or fewer of them.
    pub fn keeps_images(self) -> bool {
        matches!(self, Self::None | Self::Frozen | Self::Rate { .. })
    }

    /// Where the disturbed camera is, if the undisturbed one is at `pose`; both `world_from_camera`. A
    /// camera that is turned clockwise about its axis is turned about +z, from x, right, to y, down.
    pub fn truth(self, pose: &Pose) -> Pose {
        match self {
            Self::Roll { degrees, .. } => {
                let turn = Vector3::new(0.0, 0.0, degrees.to_radians());
                pose * Pose::new(Vector3::zeros(), turn)
            }
            _ => *pose,
        }
    }

    /// Which way is down, as a robot measures it whose camera is at `pose`; none if it does not.
    /// `down` is the direction in the world's frame. The measured direction is off by
    /// 1.1 degrees about the camera's axis all the time.
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

    /// The image that the camera takes as frame `number` of its stream.
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
            Self::FieldOfView { share } => resampled(picture, |from_centre| from_centre * share),
            Self::Blank { brightness } => with_bytes(picture, |_, _| brightness),
        }
    }
}

/// A camera that is turned by an angle sees the world turned by its opposite.
fn turned(picture: &RgbImage, radians: f64) -> RgbImage {
    let (sin, cos) = radians.sin_cos();
    resampled(picture, |at| {
        Vector2::new(cos * at.x - sin * at.y, sin * at.x + cos * at.y)
    })
}

/// Each pixel taken from elsewhere, bilinearly: `source` says from where, both places relative to the
/// centre of the image. Beyond the image its edge goes on.
fn resampled(picture: &RgbImage, source: impl Fn(Vector2<f64>) -> Vector2<f64>) -> RgbImage {
    let last = Vector2::new(picture.width as f64 - 1.0, picture.height as f64 - 1.0);
    let centre = last / 2.0;

    let mut bytes = Vec::with_capacity(picture.bytes.len());
    for y in 0..picture.height {
        for x in 0..picture.width {
            let at = Vector2::new(x as f64, y as f64) - centre;
            let from = source(at) + centre;
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
    // The bytes are as many as the size says, or the picture would not be one.
    let Some(buffer) = image::RgbImage::from_raw(width, height, picture.bytes.clone()) else {
        return picture.clone();
    };

    RgbImage {
        bytes: imageops::blur(&buffer, deviation as f32).into_raw(),
        ..*picture
    }
}

fn occluded(picture: &RgbImage, share: f64, number: usize) -> RgbImage {
    // The left edge of the bar goes from 0 to 1 − share and back.
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

    /// A white point at a place of a black image of 41 × 31 pixels.
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

    /// Oracle: by hand. The camera turns clockwise by a quarter: what was to the right of the centre
    /// is then above it.
    #[test]
    fn a_camera_that_rolls_clockwise_sees_the_world_turn_the_other_way() {
        let quarter = Disturbance::roll(90.0, false);
        let turned = quarter.disturbed(&point(30, 15), 0);
        assert_eq!(brightest(&turned), (20, 5));

        // What is to the right of the level camera, in its frame, is above the turned one: y is down.
        let right = quarter.truth(&Pose::identity()).inverse() * Point3::new(1.0, 0.0, 5.0);
        assert!((right - Point3::new(0.0, -1.0, 5.0)).norm() < 1e-12);
    }

    /// Oracle: by hand. A camera that sees half as much shows things twice as far from the centre.
    #[test]
    fn a_narrower_field_of_view_magnifies() {
        let near = Disturbance::FieldOfView { share: 0.5 }.disturbed(&point(25, 15), 0);
        assert_eq!(brightest(&near), (30, 15));
    }

    /// Oracle: a Gaussian keeps the sum; at one deviation it has e^(−1/2) of its height.
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

    /// Oracle: the definitions, on a grey image.
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

//! The option `--camera`: camera intrinsics in pixels.

use std::str::FromStr;

use anyhow::{Context, bail, ensure};
use nalgebra::Vector2;
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};

/// The form of the option, for help texts.
pub const CAMERA_FORM: &str = "WIDTHxHEIGHT,FOCAL[,CX,CY][,LENS]";

/// The Brown–Conrady coefficients, in their order.
const BROWN_CONRADY: [&str; 5] = ["k1", "k2", "p1", "p2", "k3"];
/// The key of the Kannala–Brandt coefficients.
const FISHEYE: &str = "fisheye";

/// A camera given in pixels: image size, focal lengths, principal point and lens distortion.
#[derive(Debug, Clone, Copy)]
pub struct CameraOption(pub CameraIntrinsics);

impl CameraOption {
    /// The option's text for images of this width in pixels, which [`FromStr`] reads. Lengths are
    /// rounded to 0.1 pixels, coefficients to 0.0001.
    pub fn text(&self, width: u32) -> String {
        let Self(camera) = self;
        let pixels = camera.in_pixels(f64::from(width));
        let rounded = |value: f64, steps: f64| (value * steps).round() / steps;
        let pixel = |value: f64| rounded(value, 10.0);

        let middle = Vector2::new(pixels.width, pixels.height) / 2.0;
        let center = pixels.center.unwrap_or(middle);
        let [fx, fy] = [pixel(pixels.focal.x), pixel(pixels.focal.y)];
        let mut text = format!("{width}x{},{fx}", pixels.height.round());
        if fx != fy {
            text += &format!(",{fy}");
        }
        if fx != fy || (center - middle).amax() >= 0.1 {
            text += &format!(",{},{}", pixel(center.x), pixel(center.y));
        }

        let coefficient = |value: &f64| rounded(*value, 1e4);
        match camera.distortion() {
            Distortion::None => {}
            Distortion::BrownConrady(values) => {
                let values = values.each_ref().map(coefficient);
                for (key, value) in BROWN_CONRADY.iter().zip(values) {
                    if value != 0.0 {
                        text += &format!(",{key}={value}");
                    }
                }
            }
            Distortion::KannalaBrandt(values) => {
                let [k1, k2, k3, k4] = values.each_ref().map(coefficient);
                text += &format!(",{FISHEYE}={k1}:{k2}:{k3}:{k4}");
            }
        }
        text
    }
}

impl FromStr for CameraOption {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let mut parts = text.split(',').map(str::trim);
        let (width, height) = size(parts.next().unwrap_or_default())?;

        let (lens, numbers): (Vec<&str>, Vec<&str>) = parts.partition(|part| part.contains('='));
        let numbers = numbers.into_iter().map(number);
        let (focal, center) = match *numbers.collect::<anyhow::Result<Vec<f64>>>()? {
            [focal] => ([focal, focal], None),
            [focal, x, y] => ([focal, focal], Some(Vector2::new(x, y))),
            [fx, fy, x, y] => ([fx, fy], Some(Vector2::new(x, y))),
            ref other => bail!(
                "has {} numbers after the image size; must be FOCAL, or FOCAL,CX,CY or FX,FY,CX,CY \
                 in pixels, for example 640x480,525",
                other.len()
            ),
        };

        let camera = CameraIntrinsics::new(PixelCamera {
            width,
            height,
            focal: focal.into(),
            center,
            distortion: distortion(&lens)?,
        })?;
        Ok(Self(camera))
    }
}

fn number(text: &str) -> anyhow::Result<f64> {
    text.parse()
        .with_context(|| format!("'{text}' is not a number"))
}

fn size(text: &str) -> anyhow::Result<(f64, f64)> {
    let (width, height) = text.split_once('x').with_context(|| {
        format!("'{text}' is not WIDTHxHEIGHT, the image size in pixels, for example 640x480")
    })?;
    Ok((number(width)?, number(height)?))
}

/// The lens distortion of parts KEY=VALUE.
fn distortion(parts: &[&str]) -> anyhow::Result<Distortion> {
    let mut brown_conrady = [None; 5];
    let mut fisheye = None;

    for (key, value) in parts.iter().filter_map(|part| part.split_once('=')) {
        let is_repeated = if key == FISHEYE {
            fisheye.replace(fisheye_coefficients(value)?).is_some()
        } else {
            let place = BROWN_CONRADY.iter().position(|name| *name == key);
            let place = place.with_context(|| {
                format!(
                    "'{key}' is not a distortion coefficient; must be one of {}, or fisheye",
                    BROWN_CONRADY.join(", ")
                )
            })?;
            brown_conrady[place].replace(number(value)?).is_some()
        };
        ensure!(!is_repeated, "{key} is given twice");
    }

    match fisheye {
        None => Ok(Distortion::brown_conrady(
            brown_conrady.map(Option::unwrap_or_default),
        )),
        Some(_) if brown_conrady.iter().any(Option::is_some) => bail!(
            "fisheye and {} are coefficients of different lens models; give one of them",
            BROWN_CONRADY.join(", ")
        ),
        Some(coefficients) => Ok(Distortion::KannalaBrandt(coefficients)),
    }
}

fn fisheye_coefficients(value: &str) -> anyhow::Result<[f64; 4]> {
    let numbers: Vec<f64> = value
        .split(':')
        .map(number)
        .collect::<anyhow::Result<_>>()?;
    <[f64; 4]>::try_from(numbers).map_err(|numbers| {
        anyhow::anyhow!(
            "fisheye has {} coefficients; must be K1:K2:K3:K4",
            numbers.len()
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> PixelCamera {
        let CameraOption(camera) = text.parse().unwrap();
        camera.in_pixels(640.0)
    }

    /// Oracle: by hand, with numbers whose quotients by 640 are exact.
    #[test]
    fn a_camera_is_stated_in_pixels() {
        let camera = PixelCamera {
            width: 640.0,
            height: 480.0,
            focal: Vector2::new(525.0, 525.0),
            center: Some(Vector2::new(320.0, 240.0)),
            distortion: Distortion::None,
        };
        assert_eq!(parsed("640x480,525"), camera);

        let center = Some(Vector2::new(330.0, 250.0));
        assert_eq!(
            parsed("640x480,525,330,250"),
            PixelCamera { center, ..camera }
        );
        let focal = Vector2::new(525.0, 530.0);
        assert_eq!(
            parsed("640x480, 525, 530, 330, 250"),
            PixelCamera {
                focal,
                center,
                ..camera
            }
        );
    }

    /// Oracle: by hand.
    #[test]
    fn a_lens_follows_the_other_numbers() {
        let lens = |text: &str| parsed(text).distortion;
        assert_eq!(
            lens("640x480,525,k1=-0.1,p2=-0.002,k3=3e-3"),
            Distortion::BrownConrady([-0.1, 0.0, 0.0, -0.002, 0.003])
        );
        assert_eq!(
            lens("640x480,525,530,330,250,fisheye=-0.03:0.01:-0.002:0.0005"),
            Distortion::KannalaBrandt([-0.03, 0.01, -0.002, 0.0005])
        );
        assert_eq!(lens("640x480,525,k1=0"), Distortion::None);
    }

    /// Oracle: the texts as a person would give them.
    #[test]
    fn a_camera_is_written_as_it_is_read() {
        for text in [
            "640x480,525",
            "640x480,519.4,k1=-0.0616",
            "640x480,525,330.5,250",
            "640x480,525,530,320,240",
            "752x480,458.7,457.3,367.2,248.4,k1=-0.2834,k2=0.074,p1=0.0002",
            "640x480,525,fisheye=-0.03:0.01:-0.002:0.0005",
        ] {
            let camera: CameraOption = text.parse().unwrap();
            let width = text.split('x').next().unwrap().parse().unwrap();
            assert_eq!(camera.text(width), text);
        }
    }

    /// Oracle: the form of the option.
    #[test]
    fn errors_name_what_is_wrong() {
        for (wrong, word) in [
            ("525", "'525' is not WIDTHxHEIGHT"),
            ("axb,525", "'a' is not a number"),
            ("640x480", "0 numbers"),
            ("640x480,525,330", "2 numbers"),
            ("640x480,525,c", "'c' is not a number"),
            ("640x480,0.9", "focal length is 0.9"),
            ("640x480,nan", "focal length is NaN"),
            ("640x480,525,900,1", "principal point (900, 1)"),
            ("640x480,525,k4=1", "'k4' is not a distortion coefficient"),
            ("640x480,525,k1=a", "'a' is not a number"),
            ("640x480,525,k1=0.1,k1=0.2", "k1 is given twice"),
            ("640x480,525,k1=-2", "folds the image"),
            ("640x480,525,fisheye=1:2:3", "fisheye has 3 coefficients"),
            (
                "640x480,525,k1=0.1,fisheye=0:0:0:0",
                "different lens models",
            ),
        ] {
            let error = wrong.parse::<CameraOption>().unwrap_err().to_string();
            assert!(error.contains(word), "{wrong}: {error}");
        }
    }
}

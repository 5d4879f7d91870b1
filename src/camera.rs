//! The option `--camera`: pinhole intrinsics in pixels.

use std::str::FromStr;

use anyhow::{Context, bail};
use seese3_core::geometry::{Pinhole, PixelCamera};

/// A camera given as `WIDTHxHEIGHT,FOCAL` or `WIDTHxHEIGHT,FOCAL,CX,CY`, in pixels.
#[derive(Debug, Clone, Copy)]
pub struct CameraOption(pub PixelCamera);

impl CameraOption {
    /// The camera.
    ///
    /// # Errors
    /// If a number is out of its range.
    pub fn pinhole(self) -> anyhow::Result<Pinhole> {
        Pinhole::new(self.0).context("--camera")
    }
}

impl FromStr for CameraOption {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let numbers = text
            .split([',', 'x'])
            .map(|number| number.trim().parse().ok())
            .collect::<Option<Vec<f64>>>();
        let (width, height, focal, centre) = match numbers.as_deref() {
            Some(&[width, height, focal]) => (width, height, focal, None),
            Some(&[width, height, focal, x, y]) => (width, height, focal, Some([x, y].into())),
            _ => bail!(
                "must be WIDTHxHEIGHT,FOCAL or WIDTHxHEIGHT,FOCAL,CX,CY in pixels, for example \
                 640x480,585"
            ),
        };

        let camera = PixelCamera {
            width,
            height,
            focal,
            centre,
        };
        Pinhole::new(camera)?;

        Ok(Self(camera))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn a_camera_is_stated_in_pixels() {
        let camera: CameraOption = "640x480,585".parse().unwrap();
        let pinhole = camera.pinhole().unwrap();
        assert_eq!(pinhole.focal(), 585.0 / 640.0);
        assert_eq!([pinhole.centre().x, pinhole.centre().y], [0.5, 0.375]);

        let camera: CameraOption = "640x480,585,330,250".parse().unwrap();
        assert_eq!(camera.0.centre, Some([330.0, 250.0].into()));

        for wrong in [
            "585",
            "640x480",
            "640x480,0.9",
            "640x480,585,900,1",
            "640x480,nan",
            "axb,c",
        ] {
            assert!(wrong.parse::<CameraOption>().is_err(), "{wrong}");
        }
    }
}

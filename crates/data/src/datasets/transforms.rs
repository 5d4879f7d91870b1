//! `transforms.json` of NeRF, instant-ngp and nerfstudio: `transform_matrix` is camera-to-world along
//! OpenGL's axes, and is turned to x right, y down, z forward here.
//!
//! Translations are in whatever unit the program had that wrote the file: those that come from COLMAP
//! are not metres. Frames are sorted by the numbers in their names; the file often is not.

use std::path::{Path, PathBuf};

use nalgebra::Matrix4;
use serde::Deserialize;

use super::collect::{About, Collected};
use super::natural::sort_naturally;
use super::{DropReason, Error, Reader, Recording, read_bytes};
use crate::pose_check::{Axes, Convention};
use seese3_core::Cause;
use seese3_core::geometry::{Pinhole, PixelCamera};

/// The parts of the file that are read.
#[derive(Debug, Deserialize)]
struct Transforms {
    #[serde(flatten)]
    camera: Camera,
    frames: Vec<Frame>,
}

/// A pinhole camera, pixels, as far as it is stated.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct Camera {
    /// Without it, OPENCV, which has no distortion either where its coefficients are left out.
    camera_model: Option<String>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    /// The horizontal field of view, radians: of NeRF's own files.
    camera_angle_x: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: [[f64; 4]; 4],
}

/// Reads a `transforms.json`, or the one in a folder.
///
/// # Errors
/// [`Error`] if the file cannot be read or is malformed, if no usable frame is left, or if `reader`
/// refuses unusable frames and there are some.
pub fn read_transforms(path: &Path, reader: &mut Reader<'_>) -> Result<Recording, Error> {
    let file = if path.is_dir() {
        path.join("transforms.json")
    } else {
        path.to_owned()
    };
    let folder = file.parent().map_or_else(PathBuf::new, Path::to_owned);
    let malformed = |problem: Cause| Error::Malformed {
        file: file.clone(),
        problem,
    };

    // Some editors put a byte order mark before the text.
    let content = read_bytes(&file)?;
    let text = content.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&content);
    let transforms: Transforms =
        serde_json::from_slice(text).map_err(|error| malformed(error.into()))?;
    let mut frames = transforms.frames;
    sort_naturally(&mut frames, |frame| &frame.file_path);

    let opengl = Convention {
        axes: Axes::OpenGl,
        ..Convention::default()
    };
    let count = frames.len();
    let mut collected = Collected::default();
    for (done, frame) in frames.into_iter().enumerate() {
        (reader.progress)(done, count);
        let name = frame.file_path.trim_start_matches("./").to_owned();
        let Some(image) = image_of(&folder, &name) else {
            let looked_for = format!(
                "{}, as it is or with .png, .jpg or .jpeg",
                folder.join(&name).display()
            );
            collected.drop_without(looked_for, name, DropReason::MissingImage);
            continue;
        };

        let [a, b, c, d] = frame.transform_matrix;
        let matrix = Matrix4::from_row_slice(&[a, b, c, d].concat());
        let about = About {
            name,
            image: Some(image),
            ..About::default()
        };
        collected.take(about, &matrix, &file)?;
    }

    let mut recording = collected.finish(&folder, reader)?;
    for pose in &mut recording.frames.poses {
        *pose = opengl.to_world_from_camera(pose);
    }
    recording.stated.camera =
        pinhole(transforms.camera).map_err(|problem| malformed(problem.into()))?;
    Ok(recording)
}

/// The path of an image below the folder; NeRF's files leave out the ending.
fn image_of(folder: &Path, name: &str) -> Option<String> {
    let endings = ["", ".png", ".jpg", ".jpeg"].map(|ending| format!("{name}{ending}"));
    endings
        .into_iter()
        .find(|image| folder.join(image).is_file())
}

/// The camera, if all of it is stated once for all frames. None for cameras that are no pinhole, such as
/// fisheyes, and for pixels that are not square.
fn pinhole(camera: Camera) -> Result<Option<Pinhole>, String> {
    let is_pinhole = match camera.camera_model.as_deref() {
        None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL") => true,
        Some(_) => false,
    };
    let is_square = match camera.fl_x.zip(camera.fl_y) {
        Some((x, y)) => (y / x - 1.0).abs() < 0.02,
        None => true,
    };
    if !is_pinhole || !is_square {
        return Ok(None);
    }

    let Some((width, height)) = camera.w.zip(camera.h) else {
        return Ok(None);
    };
    let by_angle = |angle: f64| width / (2.0 * (angle / 2.0).tan());
    let Some(focal) = camera.fl_x.or(camera.camera_angle_x.map(by_angle)) else {
        return Ok(None);
    };

    let pinhole = Pinhole::new(PixelCamera {
        width,
        height,
        focal,
        centre: camera.cx.zip(camera.cy).map(|(x, y)| [x, y].into()),
    });
    pinhole.map(Some).map_err(|error| error.to_string())
}

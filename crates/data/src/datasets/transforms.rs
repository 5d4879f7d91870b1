//! `transforms.json` of NeRF, instant-ngp and nerfstudio. `transform_matrix` is camera-to-world
//! with OpenGL axes; it is converted to x right, y down, z forward.
//!
//! Translations have the unit of the program that wrote the file; COLMAP's unit is arbitrary, not
//! meters. Frames are sorted by the numbers in their names, because the file often is unsorted.

use std::path::{Path, PathBuf};

use nalgebra::Matrix4;
use serde::Deserialize;

use super::collect::{About, Collected};
use super::natural::sort_naturally;
use super::{DropReason, Error, Reader, Recording, read_bytes};
use crate::pose_check::{Axes, Convention};
use seese3_core::Cause;
use seese3_core::geometry::{CameraIntrinsics, Distortion, PixelCamera};

/// The parts of the file that are read.
#[derive(Debug, Deserialize)]
struct Transforms {
    #[serde(flatten)]
    camera: Camera,
    frames: Vec<Frame>,
}

/// The camera's parameters, pixels. Any of them may be missing.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct Camera {
    /// If missing, the camera is taken as OPENCV.
    camera_model: Option<String>,
    /// How instant-ngp states the model OPENCV_FISHEYE.
    #[serde(default)]
    is_fisheye: bool,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    /// The horizontal field of view, radians. The original NeRF files have it in place of `fl_x`.
    camera_angle_x: Option<f64>,
    #[serde(default)]
    k1: f64,
    #[serde(default)]
    k2: f64,
    #[serde(default)]
    k3: f64,
    /// A coefficient of OPENCV_FISHEYE only.
    #[serde(default)]
    k4: f64,
    #[serde(default)]
    p1: f64,
    #[serde(default)]
    p2: f64,
}

#[derive(Debug, Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: [[f64; 4]; 4],
}

/// Reads a `transforms.json`, or the one in a folder.
///
/// # Errors
/// [`Error`] if the file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`.
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

    // Some editors write a byte order mark before the text.
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
        intrinsics(&transforms.camera).map_err(|problem| malformed(problem.into()))?;
    Ok(recording)
}

/// An image's path relative to the folder. The original NeRF files omit the extension.
fn image_of(folder: &Path, name: &str) -> Option<String> {
    let endings = ["", ".png", ".jpg", ".jpeg"].map(|ending| format!("{name}{ending}"));
    endings
        .into_iter()
        .find(|image| folder.join(image).is_file())
}

/// The camera, if the file states it once for all frames. `None` if size or focal length is
/// missing, and for other models, such as panoramas.
fn intrinsics(camera: &Camera) -> Result<Option<CameraIntrinsics>, String> {
    let size = camera.w.zip(camera.h);
    let (Some((width, height)), Some(distortion)) = (size, distortion(camera)) else {
        return Ok(None);
    };

    let by_angle = |angle: f64| width / (2.0 * (angle / 2.0).tan());
    let Some(fx) = camera.fl_x.or(camera.camera_angle_x.map(by_angle)) else {
        return Ok(None);
    };

    let intrinsics = CameraIntrinsics::new(PixelCamera {
        width,
        height,
        focal: [fx, camera.fl_y.unwrap_or(fx)].into(),
        center: camera.cx.zip(camera.cy).map(|(x, y)| [x, y].into()),
        distortion,
    });
    intrinsics.map(Some).map_err(|error| error.to_string())
}

/// The lens distortion; `None` for other models.
fn distortion(camera: &Camera) -> Option<Distortion> {
    let &Camera {
        k1,
        k2,
        k3,
        k4,
        p1,
        p2,
        ..
    } = camera;

    match camera.camera_model.as_deref() {
        Some("OPENCV_FISHEYE") => Some(Distortion::KannalaBrandt([k1, k2, k3, k4])),
        None | Some("OPENCV") if camera.is_fisheye => {
            Some(Distortion::KannalaBrandt([k1, k2, k3, k4]))
        }
        None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL")
            if k4 == 0.0 =>
        {
            Some(Distortion::brown_conrady([k1, k2, p1, p2, k3]))
        }
        _ => None,
    }
}

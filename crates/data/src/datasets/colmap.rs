//! COLMAP models: `cameras` and `images` as `.bin` or `.txt`. Poses are camera-from-world with axes
//! x right, y down, z forward; quaternions are (w, x, y, z).
//!
//! - The unit of translations is arbitrary, unless the model was aligned with known positions.
//! - Images are sorted by the numbers in their names. With several folders, each is a sequence.
//! - COLMAP ignores EXIF orientation: poses refer to the pixels as stored.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Quaternion;

use super::collect::{About, Collected};
use super::natural::sort_naturally;
use super::text::number;
use super::{DropReason, Error, Reader, Recording, read_bytes, read_text};
use seese3_core::Cause;
use seese3_core::geometry::{Pinhole, PixelCamera, Pose, pose_from_quaternion};

/// Subfolders of a project that are searched for a model.
const MODELS: [&str; 4] = ["", "sparse/0", "sparse", "0"];
/// Folders that are searched for the images, relative to the model's folder.
const IMAGES: [&str; 4] = ["images", "../images", "../../images", "."];
/// Bytes of an image point in `images.bin`: two coordinates and the id of a 3D point.
const POINT_BYTES: u64 = 24;

/// A camera of the model.
#[derive(Debug, Clone, PartialEq)]
struct Camera {
    width: f64,
    height: f64,
    /// Focal lengths along x and y and principal point, pixels; `None` for fisheye and unknown
    /// models.
    pinhole: Option<[f64; 4]>,
}

/// An image of the model.
#[derive(Debug, Clone, PartialEq)]
struct Image {
    name: String,
    camera: u32,
    camera_from_world: Pose,
}

/// Reads a model, or the model in a project's folder. `images` is the folder of the images; if it
/// is `None`, the usual folders near the model are searched.
///
/// # Errors
/// [`Error`] if a file cannot be read or is malformed, if no usable frame is left, or if a frame
/// is unusable and `reader.unusable` is `Refuse`.
pub fn read_colmap(
    path: &Path,
    images: Option<&Path>,
    reader: &mut Reader<'_>,
) -> Result<Recording, Error> {
    let model = model_in(path)?;
    let [cameras, registered] = if model.join("images.bin").is_file() {
        ["cameras.bin", "images.bin"].map(|name| model.join(name))
    } else {
        ["cameras.txt", "images.txt"].map(|name| model.join(name))
    };
    let is_binary = registered
        .extension()
        .is_some_and(|extension| extension == "bin");

    let cameras = if is_binary {
        binary_cameras(&cameras)?
    } else {
        text_cameras(&cameras)?
    };
    let mut frames = if is_binary {
        binary_images(&registered)?
    } else {
        text_images(&registered)?
    };
    sort_naturally(&mut frames, |frame| &frame.name);

    let root = images_root(&model, images, &frames)?;
    let mut recording = collected(&root, &frames, reader)?;
    recording.stated.camera = one_camera(&cameras, &frames);
    Ok(recording)
}

fn collected(root: &Path, frames: &[Image], reader: &mut Reader<'_>) -> Result<Recording, Error> {
    // Only images of the same folder are consecutive frames.
    let folder = |name: &str| {
        name.rsplit_once('/')
            .map_or("", |(folder, _)| folder)
            .to_owned()
    };
    let mut folders: Vec<String> = frames.iter().map(|frame| folder(&frame.name)).collect();
    folders.sort();
    folders.dedup();
    let sequence = |name: &str| {
        let place = folders.binary_search(&folder(name)).ok()?;
        (folders.len() > 1).then_some(place as u32)
    };

    let mut frames: Vec<&Image> = frames.iter().collect();
    frames.sort_by_key(|frame| sequence(&frame.name));
    let count = frames.len();
    let mut collected = Collected::default();
    for (done, frame) in frames.into_iter().enumerate() {
        (reader.progress)(done, count);
        let name = frame.name.clone();
        if !root.join(&name).is_file() {
            let looked_for = root.join(&name).display().to_string();
            collected.drop_without(looked_for, name, DropReason::MissingImage);
            continue;
        }

        let about = About {
            image: Some(name.clone()),
            sequence: sequence(&name),
            name,
            ..About::default()
        };
        collected.keep(about, frame.camera_from_world.inverse());
    }

    collected.finish(root, reader)
}

/// The folder of the model.
fn model_in(path: &Path) -> Result<PathBuf, Error> {
    let folders = MODELS.map(|folder| path.join(folder));
    let has_model = |folder: &PathBuf| {
        let has = |name| folder.join(name).is_file();
        (has("images.bin") && has("cameras.bin")) || (has("images.txt") && has("cameras.txt"))
    };

    folders
        .into_iter()
        .find(has_model)
        .ok_or_else(|| Error::Malformed {
            file: path.to_owned(),
            problem:
                "holds no COLMAP model: cameras and images as .bin or .txt, in this folder or in \
                  sparse/0"
                    .into(),
        })
}

/// The folder that image names are relative to.
fn images_root(model: &Path, given: Option<&Path>, frames: &[Image]) -> Result<PathBuf, Error> {
    if let Some(given) = given {
        return Ok(given.to_owned());
    }

    let has_one = |folder: &PathBuf| {
        let mut names = frames.iter().map(|frame| folder.join(&frame.name));
        names.any(|image| image.is_file())
    };
    let folders = IMAGES.map(|folder| model.join(folder));
    folders
        .into_iter()
        .find(has_one)
        .ok_or_else(|| Error::Malformed {
            file: model.to_owned(),
            problem: "has no folder with the model's images nearby; give it with --images DIR"
                .into(),
        })
}

/// The camera shared by all images, if its two focal lengths differ by less than 5 %. Distortion is
/// ignored.
fn one_camera(cameras: &BTreeMap<u32, Camera>, frames: &[Image]) -> Option<Pinhole> {
    let first = cameras.get(&frames.first()?.camera)?;
    let is_same = |frame: &Image| cameras.get(&frame.camera) == Some(first);
    if !frames.iter().all(is_same) {
        return None;
    }

    let [focal_x, focal_y, x, y] = first.pinhole?;
    let is_square = (focal_x / focal_y - 1.0).abs() < 0.05;
    let camera = PixelCamera {
        width: first.width,
        height: first.height,
        focal: focal_x,
        centre: Some([x, y].into()),
    };
    is_square.then(|| Pinhole::new(camera).ok()).flatten()
}

/// The parameter layout of a COLMAP camera model.
struct Model {
    name: &'static str,
    /// Whether the focal lengths along x and y are separate parameters.
    has_two_focals: bool,
    /// The number of parameters.
    numbers: usize,
}

/// COLMAP's camera models, indexed by model id.
const CAMERA_MODELS: [Model; 11] = [
    model("SIMPLE_PINHOLE", false, 3),
    model("PINHOLE", true, 4),
    model("SIMPLE_RADIAL", false, 4),
    model("RADIAL", false, 5),
    model("OPENCV", true, 8),
    model("OPENCV_FISHEYE", true, 8),
    model("FULL_OPENCV", true, 12),
    model("FOV", true, 5),
    model("SIMPLE_RADIAL_FISHEYE", false, 4),
    model("RADIAL_FISHEYE", false, 5),
    model("THIN_PRISM_FISHEYE", true, 12),
];

const fn model(name: &'static str, has_two_focals: bool, numbers: usize) -> Model {
    Model {
        name,
        has_two_focals,
        numbers,
    }
}

impl Model {
    fn camera(&self, width: f64, height: f64, numbers: &[f64]) -> Camera {
        // A fisheye camera is not a pinhole, although it has a focal length.
        let is_pinhole = !self.name.contains("FISHEYE") && self.name != "FOV";
        let pinhole = match *numbers {
            [x, y, cx, cy, ..] if is_pinhole && self.has_two_focals => Some([x, y, cx, cy]),
            [focal, cx, cy, ..] if is_pinhole && !self.has_two_focals => {
                Some([focal, focal, cx, cy])
            }
            _ => None,
        };

        Camera {
            width,
            height,
            pinhole,
        }
    }
}

fn pose(file: &Path, what: &str, numbers: [f64; 7]) -> Result<Pose, Error> {
    let [w, x, y, z, tx, ty, tz] = numbers;
    pose_from_quaternion([tx, ty, tz], Quaternion::new(w, x, y, z)).map_err(|problem| {
        Error::Malformed {
            file: file.to_owned(),
            problem: format!("{what}: {problem}").into(),
        }
    })
}

fn text_cameras(file: &Path) -> Result<BTreeMap<u32, Camera>, Error> {
    let text = read_text(file)?;
    let mut cameras = BTreeMap::new();
    for (line, row) in (1..).zip(text.lines()) {
        let words: Vec<&str> = row.split_whitespace().collect();
        if words.is_empty() || row.starts_with('#') {
            continue;
        }

        let wrong = |problem: Cause| Error::Line {
            file: file.to_owned(),
            line,
            problem,
        };
        let &[id, name, ref sizes @ ..] = words.as_slice() else {
            return Err(wrong("is not ID MODEL WIDTH HEIGHT PARAMETERS".into()));
        };
        let id = id
            .parse()
            .map_err(|_| wrong(format!("'{id}' is not the id of a camera").into()))?;
        let numbers: Result<Vec<f64>, Error> =
            sizes.iter().map(|word| number(file, line, word)).collect();
        let numbers = numbers?;

        let model = CAMERA_MODELS.iter().find(|model| model.name == name);
        let [width, height, parameters @ ..] = numbers.as_slice() else {
            return Err(wrong("is not ID MODEL WIDTH HEIGHT PARAMETERS".into()));
        };
        let camera = match model {
            Some(model) if model.numbers != parameters.len() => {
                return Err(wrong(
                    format!(
                        "has {} parameters, {name} has {}",
                        parameters.len(),
                        model.numbers
                    )
                    .into(),
                ));
            }
            Some(model) => model.camera(*width, *height, parameters),
            // An unknown model, from a newer COLMAP: the poses can still be read.
            None => Camera {
                width: *width,
                height: *height,
                pinhole: None,
            },
        };
        cameras.insert(id, camera);
    }

    Ok(cameras)
}

fn text_images(file: &Path) -> Result<Vec<Image>, Error> {
    let text = read_text(file)?;
    let mut images = Vec::new();
    let mut lines = (1..)
        .zip(text.lines())
        .filter(|(_, row)| !row.starts_with('#'));
    while let Some((line, row)) = lines.next() {
        if row.trim().is_empty() {
            continue;
        }

        let wrong = |problem: Cause| Error::Line {
            file: file.to_owned(),
            line,
            problem,
        };
        let words: Vec<&str> = row.splitn(10, ' ').collect();
        let &[_, w, x, y, z, tx, ty, tz, camera, name] = words.as_slice() else {
            return Err(wrong(
                "is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME".into(),
            ));
        };

        let mut numbers = [0.0; 7];
        for (value, word) in numbers.iter_mut().zip([w, x, y, z, tx, ty, tz]) {
            *value = number(file, line, word)?;
        }
        let camera = camera
            .parse()
            .map_err(|_| wrong(format!("'{camera}' is not the id of a camera").into()))?;
        images.push(Image {
            camera_from_world: pose(file, name, numbers)?,
            name: name.trim().to_owned(),
            camera,
        });

        // The points seen in the image, a line that may be empty.
        if let Some((line, points)) = lines.next()
            && points.split_whitespace().count() % 3 != 0
        {
            return Err(Error::Line {
                file: file.to_owned(),
                line,
                problem: "is not a line of points, X Y POINT3D_ID each: every image has two lines, of which \
                          the second may be empty"
                    .into(),
            });
        }
    }

    Ok(images)
}

/// A little-endian reader over the bytes of a file.
struct Bytes<'a> {
    file: &'a Path,
    left: &'a [u8],
}

impl Bytes<'_> {
    fn cut(&self) -> Error {
        Error::Malformed {
            file: self.file.to_owned(),
            problem: "ends in the middle of a record: it is truncated, or is not a COLMAP file"
                .into(),
        }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let (taken, left) = self.left.split_first_chunk().ok_or_else(|| self.cut())?;
        self.left = left;
        Ok(*taken)
    }

    fn u32(&mut self) -> Result<u32, Error> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, Error> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, Error> {
        self.take().map(f64::from_le_bytes)
    }

    /// Reads zero-terminated UTF-8 text.
    fn text(&mut self) -> Result<String, Error> {
        let end = self.left.iter().position(|byte| *byte == 0);
        let end = end.ok_or_else(|| self.cut())?;
        let text = std::str::from_utf8(&self.left[..end]).map_err(|_| Error::Malformed {
            file: self.file.to_owned(),
            problem: "has a name that is not UTF-8".into(),
        })?;
        self.left = &self.left[end + 1..];
        Ok(text.to_owned())
    }

    fn skip(&mut self, count: u64) -> Result<(), Error> {
        let left = usize::try_from(count)
            .ok()
            .and_then(|count| self.left.get(count..));
        self.left = left.ok_or_else(|| self.cut())?;
        Ok(())
    }
}

fn binary_cameras(file: &Path) -> Result<BTreeMap<u32, Camera>, Error> {
    let content = read_bytes(file)?;
    let mut bytes = Bytes {
        file,
        left: &content,
    };

    let count = bytes.u64()?;
    let mut cameras = BTreeMap::new();
    for _ in 0..count {
        let id = bytes.u32()?;
        let kind = bytes.u32()?;
        let width = bytes.u64()? as f64;
        let height = bytes.u64()? as f64;

        // The number of parameters is needed to find the next camera.
        let model = CAMERA_MODELS
            .get(kind as usize)
            .ok_or_else(|| Error::Malformed {
                file: file.to_owned(),
                problem: format!(
                    "camera {id} has the unknown model {kind}; convert the model to text with \
                     `colmap model_converter --output_type TXT`"
                )
                .into(),
            })?;
        let numbers: Result<Vec<f64>, Error> = (0..model.numbers).map(|_| bytes.f64()).collect();
        cameras.insert(id, model.camera(width, height, &numbers?));
    }

    Ok(cameras)
}

fn binary_images(file: &Path) -> Result<Vec<Image>, Error> {
    let content = read_bytes(file)?;
    let mut bytes = Bytes {
        file,
        left: &content,
    };

    let count = bytes.u64()?;
    let mut images = Vec::new();
    for _ in 0..count {
        bytes.u32()?;
        let mut numbers = [0.0; 7];
        for number in &mut numbers {
            *number = bytes.f64()?;
        }
        let camera = bytes.u32()?;
        let name = bytes.text()?;
        let points = bytes.u64()?;
        bytes.skip(points.saturating_mul(POINT_BYTES))?;

        images.push(Image {
            camera_from_world: pose(file, &name, numbers)?,
            name,
            camera,
        });
    }

    Ok(images)
}

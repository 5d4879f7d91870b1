//! COLMAP models: `cameras` and `images` as `.bin` or `.txt`. Poses are camera-from-world with axes
//! x right, y down, z forward; quaternions are (w, x, y, z).
//!
//! - The unit of translations is arbitrary, unless the model was aligned with known positions.
//! - A model has no times; see [`ImageTimes`].
//! - Images are sorted by the numbers in their names. With several folders, each is a sequence.
//! - COLMAP ignores EXIF orientation: poses refer to the pixels as stored.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Quaternion;

use super::collect::{About, Collected};
use super::natural::sort_naturally;
use super::text::{data_lines, nanoseconds, number, wrong};
use super::{DropReason, Error, Reader, Recording, read_bytes, read_text};
use seese3_core::Cause;
use seese3_core::geometry::{
    CameraIntrinsics, Distortion, PixelCamera, Pose, pose_from_quaternion,
};

/// Subfolders of a project that are searched for a model.
const MODELS: [&str; 4] = ["", "sparse/0", "sparse", "0"];
/// Folders that are searched for the images, relative to the model's folder.
const IMAGES: [&str; 4] = ["images", "../images", "../../images", "."];
/// Bytes of an image point in `images.bin`: two coordinates and the id of a 3D point.
const POINT_BYTES: u64 = 24;

/// The cameras of the model by id; `None` for camera models that [`camera_of`] does not read.
type Cameras = BTreeMap<u32, Option<PixelCamera>>;

/// When the images of a model were taken. The times of all images are on one clock.
#[derive(Debug, Clone, Default)]
pub enum ImageTimes {
    /// Not known.
    #[default]
    Unknown,
    /// Images per second. The last number in the name of an image counts the images of the video.
    Rate(f64),
    /// A file with the lines `SECONDS NAME`, one for each image of the model.
    File(PathBuf),
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
/// [`Error`] if a file cannot be read or is malformed, if an image has no time although times are
/// given, if no usable frame is left, or if a frame is unusable and `reader.unusable` is `Refuse`.
pub fn read_colmap(
    path: &Path,
    images: Option<&Path>,
    times: &ImageTimes,
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
    let times = times.of(&frames)?;
    let mut recording = collected(&root, &frames, &times, reader)?;
    recording.stated.camera = one_camera(&cameras, &frames);
    Ok(recording)
}

/// `times` are nanoseconds by name; empty if they are not known.
fn collected(
    root: &Path,
    frames: &[Image],
    times: &BTreeMap<String, i64>,
    reader: &mut Reader<'_>,
) -> Result<Recording, Error> {
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
            timestamp_ns: times.get(&name).copied(),
            name,
            ..About::default()
        };
        collected.keep(about, frame.camera_from_world.inverse());
    }

    collected.finish(root, reader)
}

impl ImageTimes {
    /// Nanoseconds by the name of the image; empty if they are not known.
    fn of(&self, images: &[Image]) -> Result<BTreeMap<String, i64>, Error> {
        match self {
            Self::Unknown => Ok(BTreeMap::new()),
            Self::Rate(hertz) => {
                let time = |image: &Image| {
                    let number = last_number(&image.name).ok_or_else(|| Error::Malformed {
                        file: PathBuf::from(&image.name),
                        problem: "has no number in its name, which a rate of images needs; state the times of \
                                  the images in a file"
                            .into(),
                    })?;
                    Ok((image.name.clone(), (number / hertz * 1e9).round() as i64))
                };
                images.iter().map(time).collect()
            }
            Self::File(file) => {
                let times = times_by_name(file)?;
                let without = images.iter().find(|image| !times.contains_key(&image.name));
                without.map_or(Ok(times), |image| {
                    Err(Error::Malformed {
                        file: file.clone(),
                        problem: format!("has no line for the image {}", image.name).into(),
                    })
                })
            }
        }
    }
}

/// The last number in a name.
fn last_number(name: &str) -> Option<f64> {
    let digits = name
        .split(|c: char| !c.is_ascii_digit())
        .rfind(|part| !part.is_empty());
    digits?.parse().ok()
}

/// Times by name, from the lines `SECONDS NAME`.
fn times_by_name(file: &Path) -> Result<BTreeMap<String, i64>, Error> {
    let text = read_text(file)?;
    let mut times = BTreeMap::new();
    for (line, row) in data_lines(&text) {
        let named = row.trim().split_once(char::is_whitespace);
        let parsed = named.and_then(|(seconds, name)| Some((nanoseconds(seconds)?, name.trim())));
        let (time_ns, name) = parsed.ok_or_else(|| {
            let problem = "is not SECONDS NAME: non-negative decimal seconds without an exponent, and the name of an image \
                           of the model";
            wrong(file, line, problem.into())
        })?;
        if times.insert(name.to_owned(), time_ns).is_some() {
            return Err(wrong(
                file,
                line,
                format!("states a second time for the image {name}").into(),
            ));
        }
    }
    Ok(times)
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

/// The camera shared by all images; `None` if they have several cameras, or one that is not valid.
fn one_camera(cameras: &Cameras, frames: &[Image]) -> Option<CameraIntrinsics> {
    let first = cameras.get(&frames.first()?.camera)?;
    let is_same = |frame: &Image| cameras.get(&frame.camera) == Some(first);
    if !frames.iter().all(is_same) {
        return None;
    }

    CameraIntrinsics::new((*first)?).ok()
}

/// Name and number of parameters of COLMAP's camera models, indexed by model id.
const CAMERA_MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// The camera of a model's parameters; `None` for models with another kind of distortion.
fn camera_of(model: &str, width: f64, height: f64, parameters: &[f64]) -> Option<PixelCamera> {
    let (focal, center, distortion) = match (model, parameters) {
        ("SIMPLE_PINHOLE", &[f, x, y]) => ([f, f], [x, y], Distortion::None),
        ("PINHOLE", &[fx, fy, x, y]) => ([fx, fy], [x, y], Distortion::None),
        ("SIMPLE_RADIAL", &[f, x, y, k1]) => {
            let lens = Distortion::brown_conrady([k1, 0.0, 0.0, 0.0, 0.0]);
            ([f, f], [x, y], lens)
        }
        ("RADIAL", &[f, x, y, k1, k2]) => {
            let lens = Distortion::brown_conrady([k1, k2, 0.0, 0.0, 0.0]);
            ([f, f], [x, y], lens)
        }
        ("OPENCV", &[fx, fy, x, y, k1, k2, p1, p2]) => {
            let lens = Distortion::brown_conrady([k1, k2, p1, p2, 0.0]);
            ([fx, fy], [x, y], lens)
        }
        // The last three coefficients are those of the denominator.
        ("FULL_OPENCV", &[fx, fy, x, y, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]) => {
            let lens = Distortion::brown_conrady([k1, k2, p1, p2, k3]);
            ([fx, fy], [x, y], lens)
        }
        ("SIMPLE_RADIAL_FISHEYE", &[f, x, y, k1]) => {
            let lens = Distortion::KannalaBrandt([k1, 0.0, 0.0, 0.0]);
            ([f, f], [x, y], lens)
        }
        ("RADIAL_FISHEYE", &[f, x, y, k1, k2]) => {
            let lens = Distortion::KannalaBrandt([k1, k2, 0.0, 0.0]);
            ([f, f], [x, y], lens)
        }
        ("OPENCV_FISHEYE", &[fx, fy, x, y, k1, k2, k3, k4]) => {
            let lens = Distortion::KannalaBrandt([k1, k2, k3, k4]);
            ([fx, fy], [x, y], lens)
        }
        _ => return None,
    };

    Some(PixelCamera {
        width,
        height,
        focal: focal.into(),
        center: Some(center.into()),
        distortion,
    })
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

fn text_cameras(file: &Path) -> Result<Cameras, Error> {
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

        let [width, height, parameters @ ..] = numbers.as_slice() else {
            return Err(wrong("is not ID MODEL WIDTH HEIGHT PARAMETERS".into()));
        };
        // The poses of an unknown model, from a newer COLMAP, can still be read.
        let model = CAMERA_MODELS.iter().find(|(model, _)| *model == name);
        if let Some((_, count)) = model
            && *count != parameters.len()
        {
            return Err(wrong(
                format!("has {} parameters, {name} has {count}", parameters.len()).into(),
            ));
        }
        let camera = camera_of(name, *width, *height, parameters);
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

fn binary_cameras(file: &Path) -> Result<Cameras, Error> {
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
        let (model, parameter_count) =
            CAMERA_MODELS
                .get(kind as usize)
                .ok_or_else(|| Error::Malformed {
                    file: file.to_owned(),
                    problem: format!(
                        "camera {id} has the unknown model {kind}; convert the model to text with \
                     `colmap model_converter --output_type TXT`"
                    )
                    .into(),
                })?;
        let numbers: Result<Vec<f64>, Error> = (0..*parameter_count).map(|_| bytes.f64()).collect();
        cameras.insert(id, camera_of(model, width, height, &numbers?));
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

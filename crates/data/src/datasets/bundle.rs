//! Folders of NumPy files: a format that any program can write, and the one in which rooms are
//! exported.
//!
//! ```text
//! poses.npy (n, 4, 4)   timestamps.npy (n,) ns   frame_ids.npy (n,)   features_NAME.npy (n, d)
//! sequences.npy (n,)    the recording that each frame is from, if there are several; not exported
//! keypoint_*.npy        the keypoints of the frames, see [`KeypointArrays`]
//! bundle.json           the metadata: name, license, images, sequences, split and the sources of
//!                       the features
//! ```
//!
//! `import numpy` reads the arrays only; `import bundle` also reads `bundle.json`, which restores
//! an exported room completely, except for its keypoints. They are for other programs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use ndarray::{Array1, Array2, Array3, ArrayBase, Data, Dimension};
use ndarray_npy::{WritableElement, WriteNpyExt};
use serde::{Deserialize, Serialize};

use super::collect::check_lengths;
use super::numpy::read_numbers;
use super::{
    Error, Recording, Stated, entries, read_bytes, read_features, read_poses, read_timestamps,
};
use seese3_core::Cause;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::room::Room;

const FORMAT: &str = "seese3 bundle 1";
const SAYS: &str = "bundle.json";

/// The content of `bundle.json`. Programs that write one may leave out what has a default.
#[derive(Debug, Serialize, Deserialize)]
struct Bundle {
    /// Always [`FORMAT`].
    format: String,
    #[serde(default)]
    name: String,
    /// The format that the room was first read from.
    #[serde(default)]
    recorded_as: String,
    #[serde(default, alias = "licence")]
    license: String,
    /// The folder that the image paths are relative to. If it is relative itself, it starts from
    /// the bundle's folder.
    #[serde(default)]
    images_root: String,
    /// Whether `frame_ids.npy` holds the recording's own frame numbers; if not, it holds row
    /// numbers.
    #[serde(default)]
    numbered: bool,
    #[serde(default)]
    names: Vec<String>,
    #[serde(default)]
    images: Vec<String>,
    #[serde(default)]
    sequences: Vec<u32>,
    #[serde(default)]
    held_out: Vec<bool>,
    #[serde(default)]
    worst_rotation_deviation: f64,
    /// The camera, in image widths, if known.
    #[serde(default)]
    camera: Option<CameraIntrinsics>,
    /// The source of each `features_NAME.npy`.
    features: Vec<FeatureSource>,
}

/// What [`write_numpy`] writes.
#[derive(Debug, Clone, Copy)]
pub struct BundleContents<'a> {
    /// The frames.
    pub room: &'a Room,
    /// Feature sets, one row per frame.
    pub features: &'a [Features],
    /// Keypoints of the frames, if the room has any.
    pub keypoints: Option<&'a KeypointArrays>,
}

/// The keypoints of n frames, k in all, frame after frame.
#[derive(Debug, Clone, PartialEq)]
pub struct KeypointArrays {
    /// `keypoint_counts.npy`: number of keypoints of each frame, shape (n).
    pub counts: Array1<i64>,
    /// `keypoint_positions.npy`: fractions of the image's width and height from its top left
    /// corner, shape (k, 2).
    pub positions: Array2<f32>,
    /// `keypoint_inverse_depths.npy`: 1 / z in the camera frame, per meter, shape (k).
    pub inverse_depths: Array1<f32>,
    /// `keypoint_deviations.npy`: relative standard deviations of the inverse depths, shape (k).
    pub deviations: Array1<f32>,
    /// `keypoint_descriptors.npy`: compressed descriptors of unit length, times 200, shape (k, 32).
    pub descriptors: Array2<i8>,
    /// `keypoint_basis_mean.npy`: compression subtracts it from a descriptor, shape (d).
    pub basis_mean: Array1<f32>,
    /// `keypoint_basis_axes.npy`: compression then multiplies by it, and scales to unit length,
    /// shape (d, 32).
    pub basis_axes: Array2<f32>,
}

/// Reads a folder of NumPy files, of which only `poses.npy` is required.
///
/// # Errors
/// [`Error`] if a file cannot be read or has another shape or type, if the number of timestamps,
/// frame numbers or sequence numbers differs from the number of poses, or if the frames of a
/// sequence are not in one block. The message names the file.
pub fn read_numpy(folder: &Path) -> Result<Recording, Error> {
    let mut recording = read_poses(&folder.join("poses.npy"))?;
    let there = |name: &str| Some(folder.join(name)).filter(|file| file.is_file());
    if let Some(file) = there("timestamps.npy") {
        recording.frames.timestamps_ns = read_timestamps(&file)?;
    }
    if let Some(file) = there("frame_ids.npy") {
        recording.frames.numbers = read_numbers(&file)?;
    }
    if let Some(file) = there("sequences.npy") {
        recording.frames.sequences = read_sequences(&file)?;
    }

    check_lengths(&folder.join("poses.npy"), &recording)?;

    for file_name in entries(folder)? {
        let name = file_name
            .strip_prefix("features_")
            .and_then(|name| name.strip_suffix(".npy"));
        let Some(name) = name else { continue };

        // The array does not record its encoder, so its source has only a name and a width.
        let file = folder.join(&file_name);
        let rows = read_features(&file)?;
        recording.features.push(checked(
            FeatureSource::imported(name, rows.ncols()),
            rows,
            &file,
        )?);
    }

    Ok(recording)
}

/// The sequence numbers of the frames. Frames of one sequence are consecutive, because motions are
/// read between consecutive rows.
fn read_sequences(file: &Path) -> Result<Vec<u32>, Error> {
    let malformed = |problem: String| Error::Malformed {
        file: file.to_owned(),
        problem: problem.into(),
    };

    let mut sequences: Vec<u32> = Vec::new();
    let mut ended = BTreeSet::new();
    for (row, number) in read_numbers(file)?.into_iter().enumerate() {
        let sequence = u32::try_from(number).map_err(|_| {
            malformed(format!(
                "row {row} is {number}; sequences are numbered from 0"
            ))
        })?;
        if let Some(&before) = sequences.last().filter(|&&before| before != sequence) {
            ended.insert(before);
        }
        if ended.contains(&sequence) {
            return Err(malformed(format!(
                "sequence {sequence} goes on in row {row}, after another one; the frames of a sequence \
                 must be in one block"
            )));
        }
        sequences.push(sequence);
    }
    Ok(sequences)
}

/// Reads a folder that [`write_numpy`] wrote.
///
/// # Errors
/// [`Error`] if a file cannot be read, or if `bundle.json` and the arrays do not match. The message
/// names the file.
pub fn read_bundle(folder: &Path) -> Result<Recording, Error> {
    let file = folder.join(SAYS);
    let malformed = |problem: Cause| Error::Malformed {
        file: file.clone(),
        problem,
    };
    let bundle: Bundle =
        serde_json::from_slice(&read_bytes(&file)?).map_err(|error| malformed(error.into()))?;

    // Destructured with no `..`, so that a new field breaks the build here.
    let Bundle {
        format,
        name,
        recorded_as,
        license,
        images_root,
        numbered,
        names,
        images,
        sequences,
        held_out,
        worst_rotation_deviation,
        camera,
        features,
    } = bundle;

    if format != FORMAT {
        return Err(malformed(
            format!("is of format '{format}', this program reads '{FORMAT}'").into(),
        ));
    }

    let mut recording = read_numpy(folder)?;
    let frames = &mut recording.frames;

    // `frame_ids.npy` is always written. Without numbers in the recording it only counts the rows.
    if !numbered {
        frames.numbers.clear();
    }

    frames.names = names;
    frames.images = images;
    frames.sequences = sequences;
    frames.held_out = held_out;

    // The exported rotations were already projected onto SO(3), so the deviation of the original
    // recording is in `bundle.json`.
    recording.worst_rotation_deviation = recording
        .worst_rotation_deviation
        .max(worst_rotation_deviation);

    recording.images_root = if images_root.is_empty() {
        images_root
    } else {
        resolved(folder, &images_root)?
    };

    check_lengths(&file, &recording)?;

    recording.stated = Stated {
        name,
        format: recorded_as,
        license,
        camera,
    };

    let read = std::mem::take(&mut recording.features);
    recording.features = with_sources(read, &features, &file)?;

    Ok(recording)
}

/// Replaces the placeholder source of every array by the one in `bundle.json`. The arrays and the
/// list must match: an unlisted array is an error, and so is a missing listed one.
fn with_sources(
    read: Vec<Features>,
    stated: &[FeatureSource],
    file: &Path,
) -> Result<Vec<Features>, Error> {
    let malformed = |problem: Cause| Error::Malformed {
        file: file.to_owned(),
        problem,
    };

    let mut features: Vec<Features> = Vec::with_capacity(read.len());
    for set in read {
        let array = &set.source().name;
        let source = stated.iter().find(|source| source.name == *array);
        let source = source
            .ok_or_else(|| malformed(format!("does not list features_{array}.npy").into()))?;

        features.push(checked(source.clone(), set.rows().to_owned(), file)?);
    }

    let is_missing =
        |source: &&FeatureSource| features.iter().all(|set| set.source().name != source.name);
    if let Some(FeatureSource { name, .. }) = stated.iter().find(is_missing) {
        return Err(malformed(
            format!("names features '{name}', but features_{name}.npy is missing").into(),
        ));
    }

    Ok(features)
}

/// Writes a room with its features and keypoints into a folder, which is created if necessary, and
/// returns the files. `bundle.json` is written last, so a folder without it is not a complete
/// export.
///
/// # Errors
/// [`Error::Io`] if a file cannot be written; [`Error::Malformed`] if the folder is not empty.
pub fn write_numpy(folder: &Path, contents: BundleContents<'_>) -> Result<Vec<PathBuf>, Error> {
    let BundleContents {
        room,
        features,
        keypoints,
    } = contents;
    let io = |cause| Error::Io {
        file: folder.to_owned(),
        cause,
    };
    std::fs::create_dir_all(folder).map_err(io)?;

    // Arrays that are already there would later be read as a part of this room.
    if !entries(folder)?.is_empty() {
        return Err(Error::Malformed {
            file: folder.to_owned(),
            problem: "is not empty; name another folder".into(),
        });
    }

    let n = room.frame_count();
    let mut files = Vec::new();

    // nalgebra stores a matrix by column; the transpose gives the rows that NumPy expects.
    let numbers = room
        .poses()
        .iter()
        .flat_map(|pose| pose.to_homogeneous().transpose().as_slice().to_vec())
        .collect();
    let poses = Array3::from_shape_vec((n, 4, 4), numbers).map_err(|error| Error::Malformed {
        file: folder.to_owned(),
        problem: error.into(),
    })?;

    files.push(write_array(folder, "poses.npy", &poses)?);

    if !room.timestamps_ns().is_empty() {
        files.push(write_array(
            folder,
            "timestamps.npy",
            &Array1::from(room.timestamps_ns().to_vec()),
        )?);
    }

    // The array is always written; `numbered` in `bundle.json` is false if it holds row numbers
    // only.
    let ids = if room.frame_numbers().is_empty() {
        (0..n as i64).collect()
    } else {
        room.frame_numbers().to_vec()
    };
    files.push(write_array(folder, "frame_ids.npy", &Array1::from(ids))?);

    for set in features {
        files.push(write_array(
            folder,
            &format!("features_{}.npy", set.source().name),
            &set.rows(),
        )?);
    }
    if let Some(keypoints) = keypoints {
        files.extend(write_keypoints(folder, keypoints)?);
    }

    let file = folder.join(SAYS);
    let text = serde_json::to_vec_pretty(&described(room, features)).map_err(|error| {
        Error::Malformed {
            file: file.clone(),
            problem: error.into(),
        }
    })?;
    std::fs::write(&file, text).map_err(|cause| Error::Io {
        file: file.clone(),
        cause,
    })?;

    files.push(file);
    Ok(files)
}

fn write_keypoints(folder: &Path, keypoints: &KeypointArrays) -> Result<[PathBuf; 7], Error> {
    let KeypointArrays {
        counts,
        positions,
        inverse_depths,
        deviations,
        descriptors,
        basis_mean,
        basis_axes,
    } = keypoints;

    Ok([
        write_array(folder, "keypoint_counts.npy", counts)?,
        write_array(folder, "keypoint_positions.npy", positions)?,
        write_array(folder, "keypoint_inverse_depths.npy", inverse_depths)?,
        write_array(folder, "keypoint_deviations.npy", deviations)?,
        write_array(folder, "keypoint_descriptors.npy", descriptors)?,
        write_array(folder, "keypoint_basis_mean.npy", basis_mean)?,
        write_array(folder, "keypoint_basis_axes.npy", basis_axes)?,
    ])
}

/// The content of `bundle.json` for a room.
fn described(room: &Room, features: &[Features]) -> Bundle {
    let frames = room.frames();
    let provenance = room.provenance();

    Bundle {
        format: FORMAT.to_owned(),
        name: room.id().to_string(),
        recorded_as: provenance.format.clone(),
        license: provenance.license.clone(),
        images_root: provenance.images_root.clone(),
        numbered: !frames.numbers.is_empty(),
        names: frames.names.clone(),
        images: frames.images.clone(),
        sequences: frames.sequences.clone(),
        held_out: frames.held_out.clone(),
        worst_rotation_deviation: provenance.worst_rotation_deviation,
        camera: provenance.camera,
        features: features.iter().map(|set| set.source().clone()).collect(),
    }
}

fn write_array<T, S, D>(
    folder: &Path,
    name: &str,
    array: &ArrayBase<S, D>,
) -> Result<PathBuf, Error>
where
    T: WritableElement,
    S: Data<Elem = T>,
    D: Dimension,
{
    let path = folder.join(name);
    let io = |cause| Error::Io {
        file: path.clone(),
        cause,
    };
    let mut file = std::io::BufWriter::new(std::fs::File::create(&path).map_err(io)?);
    array
        .write_npy(&mut file)
        .map_err(|error| io(std::io::Error::other(error)))?;

    std::io::Write::flush(&mut file).map_err(io)?;
    Ok(path)
}

fn resolved(folder: &Path, root: &str) -> Result<String, Error> {
    // If the images are no longer there, the path is kept without being resolved.
    let path = folder.join(root);
    let path = path.canonicalize().unwrap_or(path);

    let malformed = |problem: &str| Error::Malformed {
        file: folder.join(SAYS),
        problem: problem.into(),
    };

    path.to_str()
        .map(str::to_owned)
        .ok_or_else(|| malformed("images_root is not UTF-8"))
}

fn checked(source: FeatureSource, rows: Array2<f32>, file: &Path) -> Result<Features, Error> {
    Features::new(source, rows).map_err(|error| Error::Malformed {
        file: file.to_owned(),
        problem: error.into(),
    })
}

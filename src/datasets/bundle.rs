//! Folders of NumPy files: what any program can write, and what a room is given back as.
//!
//! ```text
//! poses.npy (n, 4, 4)   timestamps.npy (n,) ns   frame_ids.npy (n,)   features_NAME.npy (n, d)
//! bundle.json           what arrays cannot say: name, licence, images, sequences, split, what made the features
//! ```
//!
//! `import numpy` reads such a folder without its `bundle.json`, `import bundle` with it, so that
//! an exported room comes back whole.

use std::path::{Path, PathBuf};

use ndarray::{Array1, Array3, ArrayBase, Data, Dimension};
use ndarray_npy::{WritableElement, WriteNpyExt};
use serde::{Deserialize, Serialize};

use super::collect::check_lengths;
use super::numpy::read_numbers;
use super::{
    Error, Recording, Stated, entries, read_bytes, read_features, read_poses, read_timestamps,
};
use crate::features::{FeatureSource, Features};
use crate::room::Room;

const FORMAT: &str = "seese3 bundle 1";
const SAYS: &str = "bundle.json";

/// `bundle.json`.
#[derive(Debug, Serialize, Deserialize)]
struct Bundle {
    /// [`FORMAT`].
    format: String,
    name: String,
    /// The format that the room was first read from.
    recorded_as: String,
    licence: String,
    /// Where images' paths start from; relative to the bundle's folder if relative.
    images_root: String,
    /// Whether `frame_ids.npy` are the recording's own numbers, or only rows.
    numbered: bool,
    names: Vec<String>,
    images: Vec<String>,
    sequences: Vec<u32>,
    held_out: Vec<bool>,
    worst_rotation_deviation: f64,
    features: Vec<Made>,
}

/// What made `features_NAME.npy`.
#[derive(Debug, Serialize, Deserialize)]
struct Made {
    name: String,
    encoder: String,
    layer: String,
    base: String,
    norm: String,
    pooling: String,
    preprocess: String,
}

/// Reads a folder of NumPy files; only `poses.npy` must be there.
///
/// # Errors
/// [`Error`], naming the file.
pub fn read_numpy(folder: &Path) -> Result<Recording, Error> {
    let mut recording = read_poses(&folder.join("poses.npy"))?;
    let there = |name: &str| Some(folder.join(name)).filter(|file| file.is_file());
    if let Some(file) = there("timestamps.npy") {
        recording.frames.timestamps_ns = read_timestamps(&file)?;
    }
    if let Some(file) = there("frame_ids.npy") {
        recording.frames.numbers = read_numbers(&file)?;
    }

    check_lengths(&folder.join("poses.npy"), &recording)?;

    for file_name in entries(folder)? {
        let name = file_name
            .strip_prefix("features_")
            .and_then(|name| name.strip_suffix(".npy"));
        let Some(name) = name else { continue };

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

/// Reads a folder that [`write_numpy`] wrote.
///
/// # Errors
/// [`Error`], naming the file.
pub fn read_bundle(folder: &Path) -> Result<Recording, Error> {
    let file = folder.join(SAYS);
    let malformed = |problem: String| Error::Malformed {
        file: file.clone(),
        problem,
    };
    let bundle: Bundle = serde_json::from_slice(&read_bytes(&file)?)
        .map_err(|error| malformed(error.to_string()))?;

    // Destructured with no `..`, so that a new field breaks the build here.
    let Bundle {
        format,
        name,
        recorded_as,
        licence,
        images_root,
        numbered,
        names,
        images,
        sequences,
        held_out,
        worst_rotation_deviation,
        features,
    } = bundle;

    if format != FORMAT {
        return Err(malformed(format!(
            "is of format '{format}', this program reads '{FORMAT}'"
        )));
    }

    let mut recording = read_numpy(folder)?;
    let frames = &mut recording.frames;
    if !numbered {
        frames.numbers.clear();
    }

    frames.names = names;
    frames.images = images;
    frames.sequences = sequences;
    frames.held_out = held_out;

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
        licence,
    };

    let read = std::mem::take(&mut recording.features);
    for set in read {
        let made = features.iter().find(|made| made.name == set.source().name);
        let Made {
            name,
            encoder,
            layer,
            base,
            norm,
            pooling,
            preprocess,
        } = made.ok_or_else(|| {
            malformed(format!(
                "says nothing of features_{}.npy",
                set.source().name
            ))
        })?;

        let source = FeatureSource {
            name: name.clone(),
            encoder: encoder.clone(),
            layer: layer.clone(),
            base: base.clone(),
            norm: norm.clone(),
            pooling: pooling.clone(),
            preprocess: preprocess.clone(),
            dim: set.source().dim,
        };

        recording
            .features
            .push(checked(source, set.rows().to_owned(), &file)?);
    }

    if let Some(lost) = features.iter().find(|made| {
        recording
            .features
            .iter()
            .all(|set| set.source().name != made.name)
    }) {
        return Err(malformed(format!(
            "names features '{}', but features_{}.npy is missing",
            lost.name, lost.name
        )));
    }

    Ok(recording)
}

/// Writes a room and its features into a folder, made if it is not there; `bundle.json` last.
/// Returns the files.
///
/// # Errors
/// [`Error::Io`]; [`Error::Malformed`] if the folder holds anything already.
pub fn write_numpy(
    folder: &Path,
    room: &Room,
    features: &[Features],
) -> Result<Vec<PathBuf>, Error> {
    let io = |cause| Error::Io {
        file: folder.to_owned(),
        cause,
    };
    std::fs::create_dir_all(folder).map_err(io)?;

    if !entries(folder)?.is_empty() {
        return Err(Error::Malformed {
            file: folder.to_owned(),
            problem: "is not empty; name another folder".to_owned(),
        });
    }

    let n = room.frame_count();
    let mut files = Vec::new();

    let numbers = room
        .poses()
        .iter()
        .flat_map(|pose| pose.to_homogeneous().transpose().as_slice().to_vec())
        .collect();
    let poses = Array3::from_shape_vec((n, 4, 4), numbers).map_err(|error| Error::Malformed {
        file: folder.to_owned(),
        problem: error.to_string(),
    })?;

    files.push(write_array(folder, "poses.npy", &poses)?);

    if !room.timestamps_ns().is_empty() {
        files.push(write_array(
            folder,
            "timestamps.npy",
            &Array1::from(room.timestamps_ns().to_vec()),
        )?);
    }

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

    let frames = room.frames();
    let provenance = room.provenance();

    let bundle = Bundle {
        format: FORMAT.to_owned(),
        name: room.id().to_string(),
        recorded_as: provenance.format.clone(),
        licence: provenance.licence.clone(),
        images_root: provenance.images_root.clone(),
        numbered: !frames.numbers.is_empty(),
        names: frames.names.clone(),
        images: frames.images.clone(),
        sequences: frames.sequences.clone(),
        held_out: frames.held_out.clone(),
        worst_rotation_deviation: provenance.worst_rotation_deviation,
        features: features.iter().map(|set| made(set.source())).collect(),
    };

    let file = folder.join(SAYS);
    let text = serde_json::to_vec_pretty(&bundle).map_err(|error| Error::Malformed {
        file: file.clone(),
        problem: error.to_string(),
    })?;
    std::fs::write(&file, text).map_err(|cause| Error::Io {
        file: file.clone(),
        cause,
    })?;

    files.push(file);
    Ok(files)
}

fn made(source: &FeatureSource) -> Made {
    let FeatureSource {
        name,
        encoder,
        layer,
        base,
        norm,
        pooling,
        preprocess,
        dim: _,
    } = source.clone();

    Made {
        name,
        encoder,
        layer,
        base,
        norm,
        pooling,
        preprocess,
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
    // Where the images are not there any more the path stays as it is said.
    let path = folder.join(root);
    let path = path.canonicalize().unwrap_or(path);

    let malformed = |problem: &str| Error::Malformed {
        file: folder.join(SAYS),
        problem: problem.to_owned(),
    };

    path.to_str()
        .map(str::to_owned)
        .ok_or_else(|| malformed("images_root is not UTF-8"))
}

fn checked(
    source: FeatureSource,
    rows: ndarray::Array2<f32>,
    file: &Path,
) -> Result<Features, Error> {
    Features::new(source, rows).map_err(|error| Error::Malformed {
        file: file.to_owned(),
        problem: error.to_string(),
    })
}

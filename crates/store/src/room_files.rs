//! Serialization of a room's objects: frames and features as safetensors, names as JSON.

use ndarray::Array2;

use super::Error;
use super::tensors::{TensorReader, TensorWriter};
use seese3_core::Cause;
use seese3_core::features::Features;
use seese3_core::geometry::{Pose, nearest_rotation};
use seese3_core::room::{Frames, Room};

/// Serializes the poses of a room and its other numeric columns.
pub fn frames_file(room: &Room) -> Result<Vec<u8>, Error> {
    let n = room.frame_count();
    let mut tensors = TensorWriter::default();

    // nalgebra stores matrices in column-major order; the transpose gives NumPy's row-major order.
    let rows = room
        .poses()
        .iter()
        .flat_map(|pose| pose.to_homogeneous().transpose().as_slice().to_vec());
    tensors.f64("world_from_camera", &[n, 4, 4], rows);

    if !room.timestamps_ns().is_empty() {
        tensors.i64("timestamps_ns", &[n], room.timestamps_ns().iter().copied());
    }

    let frames = room.frames();

    // A column missing from the recording is omitted from the file and read back as empty.
    for (name, values) in [
        ("numbers", frames.numbers.clone()),
        (
            "sequences",
            frames
                .sequences
                .iter()
                .map(|&sequence| i64::from(sequence))
                .collect(),
        ),
        (
            "held_out",
            frames
                .held_out
                .iter()
                .map(|&held_out| i64::from(held_out))
                .collect(),
        ),
    ] {
        if !values.is_empty() {
            tensors.i64(name, &[n], values.into_iter());
        }
    }

    tensors.finish("frames")
}

/// Serializes a list of frame or image names.
pub fn names_file(names: &[String]) -> Result<Vec<u8>, Error> {
    serde_json::to_vec(names).map_err(|error| Error::Damaged {
        file: "frame-names".to_owned(),
        problem: error.into(),
    })
}

/// Serializes the rows of one feature set.
pub fn features_file(features: &Features) -> Result<Vec<u8>, Error> {
    let rows = features.rows();
    let mut tensors = TensorWriter::default();
    tensors.f32(
        "features",
        &[rows.nrows(), rows.ncols()],
        rows.iter().copied(),
    );

    tensors.finish("features")
}

/// Reads the columns written by [`frames_file`].
pub fn read_frames(file: &str, bytes: &[u8]) -> Result<Frames, Error> {
    let tensors = TensorReader::new(file, bytes)?;

    let damaged = |problem: Cause| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let matrices = tensors.f64("world_from_camera")?;
    if matrices.ncols() != 16 {
        return Err(damaged("'world_from_camera' is not (n, 4, 4)".into()));
    }

    // The stored entries have rounding errors. Project them onto SO(3) before conversion to a
    // quaternion.
    let pose = |(row, matrix): (usize, ndarray::ArrayView1<'_, f64>)| {
        let m = nalgebra::Matrix4::from_row_iterator(matrix.iter().copied());
        let rotation = nearest_rotation(&m.fixed_view::<3, 3>(0, 0).into_owned());
        let rotation = rotation
            .ok_or_else(|| damaged(format!("frame {row} has no valid rotation").into()))?
            .rotation;
        let quaternion = nalgebra::UnitQuaternion::from_rotation_matrix(&rotation);

        Ok(Pose::from_parts(
            m.fixed_view::<3, 1>(0, 3).into_owned().into(),
            quaternion,
        ))
    };

    let poses = matrices
        .outer_iter()
        .enumerate()
        .map(pose)
        .collect::<Result<_, Error>>()?;

    // Optional tensors: missing means that the recording has no such data.
    let column = |name: &str| -> Result<Vec<i64>, Error> {
        Ok(if tensors.has(name) {
            tensors.i64(name)?.iter().copied().collect()
        } else {
            Vec::new()
        })
    };

    let sequence = |value: i64| {
        u32::try_from(value).map_err(|_| damaged(format!("{value} is no sequence number").into()))
    };

    Ok(Frames {
        poses,
        timestamps_ns: column("timestamps_ns")?,
        numbers: column("numbers")?,
        sequences: column("sequences")?
            .into_iter()
            .map(sequence)
            .collect::<Result<_, _>>()?,
        held_out: column("held_out")?
            .into_iter()
            .map(|mark| mark != 0)
            .collect(),
        // Names and images are separate JSON objects, read by `load`.
        names: Vec::new(),
        images: Vec::new(),
    })
}

/// Reads the rows written by [`features_file`].
pub fn read_features(file: &str, bytes: &[u8]) -> Result<Array2<f32>, Error> {
    TensorReader::new(file, bytes)?.f32("features")
}

/// Reads the names written by [`names_file`].
pub fn read_names(file: &str, bytes: &[u8]) -> Result<Vec<String>, Error> {
    serde_json::from_slice(bytes).map_err(|error| Error::Damaged {
        file: file.to_owned(),
        problem: error.into(),
    })
}

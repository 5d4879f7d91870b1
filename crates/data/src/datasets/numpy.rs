//! NumPy files: poses (n, 4, 4), features (n, d), timestamps (n,).

use std::path::Path;

use half::f16;
use nalgebra::Matrix4;
use ndarray::{Array2, ArrayD, ArrayViewD, Ix2};
use ndarray_npy::{ViewElement, ViewNpyError, ViewNpyExt};

use super::{Error, Recording, read_bytes};
use seese3_core::Cause;
use seese3_core::geometry::{GivenPoseError, pose_from_matrix};
use seese3_core::room::Frames;

/// The alignment of the numbers in memory, bytes. It is enough for every type read here; in a file,
/// NumPy aligns them to 64 bytes.
const ALIGNMENT: usize = 16;
/// The beginning of a file that has the type of the numbers, bytes.
const HEADER: usize = 256;

/// A `.npy` file in memory, placed so that its numbers are aligned. The array is viewed in place,
/// so a size in the header that exceeds the file is an error, not an allocation.
struct NpyFile {
    bytes: Vec<u8>,
    start: usize,
}

impl NpyFile {
    fn read(file: &Path) -> Result<Self, Error> {
        Ok(Self::aligned(&read_bytes(file)?))
    }

    fn aligned(content: &[u8]) -> Self {
        // The length of the header is in bytes 8 and 9 in version 1 of the format, and in bytes 8
        // to 11 from version 2 on.
        let header = match content.get(6..12) {
            Some(&[1, _, low, high, _, _]) => 10 + usize::from(u16::from_le_bytes([low, high])),
            Some(&[_, _, a, b, c, d]) => {
                12usize.saturating_add(u32::from_le_bytes([a, b, c, d]) as usize)
            }
            _ => 0,
        };

        // A `Vec<u8>` may begin at any address. The content is shifted by up to 15 bytes, so that
        // the numbers behind the header begin at a multiple of `ALIGNMENT`.
        let mut bytes = vec![0; content.len() + ALIGNMENT];
        let start =
            (ALIGNMENT - (bytes.as_ptr() as usize).wrapping_add(header) % ALIGNMENT) % ALIGNMENT;
        bytes[start..start + content.len()].copy_from_slice(content);

        // Truncating does not reallocate, so the alignment is kept.
        bytes.truncate(start + content.len());
        Self { bytes, start }
    }

    fn view<T: ViewElement>(&self) -> Result<ArrayViewD<'_, T>, ViewNpyError> {
        ArrayViewD::view_npy(&self.bytes[self.start..])
    }

    /// The numbers as f64, whether stored as f64, f32 or f16.
    fn floats(&self, file: &Path) -> Result<ArrayD<f64>, Error> {
        let expected = |error: ViewNpyError| {
            malformed(
                file,
                &format!("{error}; expected float64, float32 or float16"),
            )
        };
        match self.view::<f64>() {
            Ok(view) => Ok(view.to_owned()),
            Err(ViewNpyError::WrongDescriptor(_)) => match self.view::<f32>() {
                Ok(view) => Ok(view.mapv(f64::from)),
                Err(ViewNpyError::WrongDescriptor(error)) => {
                    let halves = self.halves();
                    halves
                        .unwrap_or_else(|| Err(ViewNpyError::WrongDescriptor(error)))
                        .map_err(expected)
                }
                Err(error) => Err(malformed(file, &error.to_string())),
            },
            Err(error) => Err(malformed(file, &error.to_string())),
        }
    }

    /// The numbers of an array of f16; `None` if the file has another type. ndarray-npy does not
    /// read f16, so its bits are read as integers.
    fn halves(&self) -> Option<Result<ArrayD<f64>, ViewNpyError>> {
        let header = &self.bytes[self.start..(self.start + HEADER).min(self.bytes.len())];
        let at = header.windows(5).position(|text| text == b"'<f2'")?;
        let mut integers = self.bytes[self.start..].to_vec();
        integers[at..][..5].copy_from_slice(b"'<u2'");
        let integers = Self::aligned(&integers);
        let read = integers.view::<u16>();
        Some(read.map(|view| view.mapv(|bits| f16::from_bits(bits).to_f64())))
    }
}

fn malformed(file: &Path, problem: &str) -> Error {
    Error::Malformed {
        file: file.to_owned(),
        problem: problem.into(),
    }
}

/// Reads poses, `world_from_camera`, meters, from an array (n, 4, 4) or (n, 3, 4) of f64, f32 or
/// f16.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Malformed`] for another shape or type,
/// [`Error::Frame`] for a matrix that is not a pose.
pub fn read_poses(file: &Path) -> Result<Recording, Error> {
    let matrices = NpyFile::read(file)?.floats(file)?;
    let &[count, 3 | 4, 4] = matrices.shape() else {
        return Err(malformed(
            file,
            &format!(
                "has shape {:?}, poses are (n, 4, 4) or (n, 3, 4)",
                matrices.shape()
            ),
        ));
    };

    let mut frames = Frames {
        poses: Vec::with_capacity(count),
        ..Frames::default()
    };

    let mut worst: f64 = 0.0;
    for (frame, matrix) in matrices.outer_iter().enumerate() {
        let wrong = |problem: Cause| Error::Frame {
            file: file.to_owned(),
            frame,
            problem,
        };

        // Unlike in the other formats, a frame is never dropped here: timestamps and features
        // belong to the poses by row.
        // Matrices (3, 4) lack the last row, which is the same for all poses.
        let last_row = [0.0, 0.0, 0.0, 1.0];
        let numbers = matrix.iter().copied().chain(last_row).take(16);
        let matrix = Matrix4::from_row_iterator(numbers);
        let (pose, deviation) = pose_from_matrix(&matrix).map_err(|error| match error {
            GivenPoseError::NotFinite => wrong("the pose has a number that is not finite".into()),
            GivenPoseError::Singular => {
                wrong("the upper left 3×3 block is not a rotation (singular or mirrored)".into())
            }
            error => wrong(error.into()),
        })?;
        worst = worst.max(deviation);
        frames.poses.push(pose);
    }

    Ok(Recording {
        frames,
        worst_rotation_deviation: worst,
        ..Recording::default()
    })
}

/// Reads features from an array (n, d) of f32, f64 or f16.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Malformed`] for another shape or type.
pub fn read_features(file: &Path) -> Result<Array2<f32>, Error> {
    let npy = NpyFile::read(file)?;
    let array = match npy.view::<f32>() {
        Ok(view) => view.to_owned(),
        Err(ViewNpyError::WrongDescriptor(_)) => npy.floats(file)?.mapv(|x| x as f32),
        Err(error) => return Err(malformed(file, &error.to_string())),
    };
    let shape = array.shape().to_vec();

    let wrong_shape = |_| malformed(file, &format!("has shape {shape:?}, features are (n, d)"));
    array.into_dimensionality::<Ix2>().map_err(wrong_shape)
}

/// Reads frame numbers from an array (n,) of int64 or int32.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Malformed`] for another shape or type.
pub(super) fn read_numbers(file: &Path) -> Result<Vec<i64>, Error> {
    let npy = NpyFile::read(file)?;
    let array: ArrayD<i64> = match npy.view::<i64>() {
        Ok(view) => view.to_owned(),
        Err(ViewNpyError::WrongDescriptor(_)) => npy
            .view::<i32>()
            .map(|view| view.mapv(i64::from))
            .map_err(|error| malformed(file, &format!("{error}; expected int64 or int32")))?,
        Err(error) => return Err(malformed(file, &error.to_string())),
    };

    if array.ndim() != 1 {
        return Err(malformed(
            file,
            &format!("has shape {:?}; must be (n,)", array.shape()),
        ));
    }

    Ok(array.iter().copied().collect())
}

/// Reads timestamps, nanoseconds, from an array (n,) of int64 nanoseconds or float seconds.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Malformed`] for another shape or type, or for
/// a time that is not finite or does not fit into 64 bits of nanoseconds.
pub fn read_timestamps(file: &Path) -> Result<Vec<i64>, Error> {
    let npy = NpyFile::read(file)?;
    let array: ArrayD<i64> = match npy.view::<i64>() {
        Ok(view) => view.to_owned(),
        Err(ViewNpyError::WrongDescriptor(_)) => {
            let seconds = npy.floats(file)?;

            // An i64 holds nanoseconds up to about 9.2e9 s.
            if let Some(bad) = seconds.iter().find(|x| !x.is_finite() || x.abs() > 9.2e9) {
                return Err(malformed(file, &format!("time {bad} s is out of range")));
            }

            seconds.mapv(|x| (x * 1e9).round() as i64)
        }
        Err(error) => return Err(malformed(file, &error.to_string())),
    };

    if array.ndim() != 1 {
        return Err(malformed(
            file,
            &format!("has shape {:?}, timestamps are (n,)", array.shape()),
        ));
    }

    Ok(array.iter().copied().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(bytes: &[u8]) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        file
    }

    fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
        let header =
            format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());

        bytes.extend(header.as_bytes());
        bytes.extend(data);

        bytes
    }

    /// Oracle: the NumPy format's own definition, with a header of odd length, and f64 beside f32.
    #[test]
    fn both_float_types_are_read_at_any_alignment() {
        let data: Vec<u8> = [1.5f64, -2.0]
            .iter()
            .flat_map(|x| x.to_le_bytes())
            .collect();

        for shape in ["(1, 2)", "(1,  2)", "(1,   2)"] {
            let file = written(&npy("<f8", shape, &data));
            assert_eq!(
                read_features(file.path()).unwrap(),
                ndarray::array![[1.5, -2.0]]
            );
        }
    }

    /// Oracle: IEEE 754: a half has 5 bits of exponent with the bias 15, and 10 of mantissa. 1.5 is
    /// 0x3E00, −2 is 0xC000, and the smallest number above 0 is 2⁻²⁴.
    #[test]
    fn halves_are_read() {
        let data: Vec<u8> = [0x3E00u16, 0xC000, 0x0001, 0x7BFF]
            .iter()
            .flat_map(|bits| bits.to_le_bytes())
            .collect();
        let file = written(&npy("<f2", "(2, 2)", &data));
        assert_eq!(
            read_features(file.path()).unwrap(),
            ndarray::array![[1.5, -2.0], [2.0f32.powi(-24), 65504.0]]
        );
        let file = written(&npy("<f2", "(3, 2)", &data));
        assert!(read_features(file.path()).is_err());
    }

    /// Oracle: the same poses with their last row.
    #[test]
    fn poses_may_lack_their_last_row() {
        let three: Vec<u8> = (0..2)
            .flat_map(|k| {
                let k = f64::from(k);
                [1.0, 0.0, 0.0, k, 0.0, 1.0, 0.0, 2.0, 0.0, 0.0, 1.0, 3.0]
            })
            .flat_map(f64::to_le_bytes)
            .collect();
        let read = |shape: &str| {
            let file = written(&npy("<f8", shape, &three));
            read_poses(file.path()).map(|read| read.frames.poses)
        };
        let poses = read("(2, 3, 4)").unwrap();
        assert_eq!(
            poses[1].translation,
            nalgebra::Translation3::new(1.0, 2.0, 3.0)
        );
        assert_eq!(poses[1].rotation.angle(), 0.0);
        assert!(read("(2, 4, 3)").is_err());
    }

    /// Oracle: the NumPy format. Cases: a size larger than any file, a truncated file, a wrong
    /// shape, Python objects, and two files that are not NumPy at all.
    #[test]
    fn hostile_files_are_refused_without_believing_their_sizes() {
        for bytes in [
            npy("<f4", "(1000000000, 1000000000)", &[0; 16]),
            npy("<f4", "(2, 2)", &[0; 12]),
            npy("<f4", "(4,)", &[0; 16]),
            npy("|O", "(1, 1)", &[0; 8]),
            b"not numpy at all".to_vec(),
            vec![],
        ] {
            let file = written(&bytes);
            assert!(read_features(file.path()).is_err());
            assert!(read_poses(file.path()).is_err());
        }
    }

    /// Oracle: by hand. A scaled rotation is over the limit; a transposed pose has its translation
    /// in the last row.
    #[test]
    fn matrices_that_are_no_poses_are_refused_by_frame() {
        let pose = |scale: f64, last: f64| -> Vec<u8> {
            let mut m = Matrix4::<f64>::identity() * scale;
            m[(3, 3)] = 1.0;
            m[(3, 0)] = last;
            let eye = Matrix4::<f64>::identity();

            eye.transpose()
                .iter()
                .chain(m.transpose().iter())
                .flat_map(|x| x.to_le_bytes())
                .collect()
        };

        for (scale, last) in [
            (1.1, 0.0),
            (-1.0, 0.0),
            (0.0, 0.0),
            (1.0, 0.5),
            (f64::NAN, 0.0),
        ] {
            let file = written(&npy("<f8", "(2, 4, 4)", &pose(scale, last)));
            let message = read_poses(file.path()).unwrap_err().to_string();
            assert!(message.contains("frame 1"), "{message}");
        }

        let file = written(&npy("<f8", "(2, 4, 4)", &pose(1.0005, 0.0)));
        let recording = read_poses(file.path()).unwrap();
        assert!((recording.worst_rotation_deviation - 0.001_000_25).abs() < 1e-12);
    }
}

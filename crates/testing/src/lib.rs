//! Test support: files of expected results, and synthetic rooms.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "a failed step is a failed test"
)]

#[cfg(feature = "world")]
pub mod keypoint_map;
pub mod keypoint_scene;
pub mod oracle_room;
pub mod panorama;
pub mod recording;
#[cfg(feature = "world")]
pub mod wave_room;
#[cfg(feature = "world")]
pub mod world;

use std::path::{Path, PathBuf};

use ndarray::{Array2, Ix2};
use safetensors::{Dtype, SafeTensors};
use seese3_core::geometry::{Pose, nearest_rotation};

/// Deterministic noise in [-1, 1), from `seed` and `place`.
#[cfg(feature = "world")]
pub fn noise(seed: u64, place: usize) -> f64 {
    let mixed = (seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ place as u64)
        .wrapping_mul(0xbf58_476d_1ce4_e5b9);
    ((mixed ^ (mixed >> 29)).wrapping_mul(0x94d0_49bb_1331_11eb) >> 40) as f64 / f64::from(1 << 23)
        - 1.0
}

/// Rooms in the form that training takes, all of revision 1.
#[cfg(feature = "world")]
pub(crate) fn room_data(
    rooms: &[(seese3_core::room::Room, seese3_core::features::Features)],
) -> Vec<seese3_core::training::RoomData<'_>> {
    rooms
        .iter()
        .map(|(room, features)| seese3_core::training::RoomData {
            room,
            revision: 1,
            features,
        })
        .collect()
}

/// The folder of large inputs outside the repository: `SEESE3_SHARED`, else `../shared`.
///
/// # Panics
/// If the folder is absent. Tests that need it are ignored by default.
pub fn shared() -> PathBuf {
    let given = std::env::var_os("SEESE3_SHARED").map(PathBuf::from);
    let folder =
        given.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"));
    assert!(
        folder.is_dir(),
        "no folder {}: name the folder of large inputs in SEESE3_SHARED",
        folder.display()
    );
    folder
}

/// The folder of committed oracles.
pub fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden")
}

/// A float array of a NumPy file.
pub fn npy<T: ndarray_npy::ReadableElement>(path: &Path) -> ndarray::ArrayD<T> {
    ndarray_npy::read_npy(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Features of an oracle room, shape (n, d).
pub fn features(folder: &Path, room: &str) -> Array2<f32> {
    npy::<f32>(&folder.join(format!("rooms/{room}/features.npy")))
        .into_dimensionality::<Ix2>()
        .unwrap()
}

/// Poses of a NumPy file of shape (n, 4, 4).
pub fn poses(path: &Path) -> Vec<Pose> {
    npy::<f64>(path)
        .outer_iter()
        .map(|matrix| pose(&matrix.iter().copied().collect::<Vec<_>>()))
        .collect()
}

/// A pose from a 4×4 matrix, 16 numbers, row-major.
pub fn pose(matrix: &[f64]) -> Pose {
    let m = nalgebra::Matrix4::from_row_slice(matrix);
    let rotation = nearest_rotation(&m.fixed_view::<3, 3>(0, 0).into_owned())
        .unwrap()
        .rotation;

    Pose::from_parts(
        m.fixed_view::<3, 1>(0, 3).into_owned().into(),
        nalgebra::UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// An open safetensors file.
pub struct Tensors(Vec<u8>);

impl Tensors {
    pub fn open(path: &Path) -> Self {
        Self(std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
    }

    /// A float tensor as rows of its last axis; a vector is one row.
    pub fn rows(&self, name: &str) -> Array2<f64> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let tensor = file
            .tensor(name)
            .unwrap_or_else(|error| panic!("{name}: {error}"));

        let values: Vec<f64> = match tensor.dtype() {
            Dtype::F64 => tensor
                .data()
                .chunks_exact(8)
                .map(|b| f64::from_le_bytes(b.try_into().unwrap()))
                .collect(),
            Dtype::F32 => tensor
                .data()
                .chunks_exact(4)
                .map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap())))
                .collect(),
            Dtype::I64 => tensor
                .data()
                .chunks_exact(8)
                .map(|b| i64::from_le_bytes(b.try_into().unwrap()) as f64)
                .collect(),
            Dtype::I32 => tensor
                .data()
                .chunks_exact(4)
                .map(|b| f64::from(i32::from_le_bytes(b.try_into().unwrap())))
                .collect(),
            other => panic!("{name} is {other:?}"),
        };

        let columns = *tensor.shape().last().unwrap_or(&1);
        Array2::from_shape_vec((values.len() / columns, columns), values).unwrap()
    }
}

/// A JSON file.
pub fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(
        &std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())),
    )
    .unwrap()
}

/// A number of a JSON value.
pub fn number(value: &serde_json::Value) -> f64 {
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{value} is not a number"))
}

/// Digest of a large tensor: sum, sum of squares, and sum weighted by cos k, k from 1.
pub fn digest(tensor: &Array2<f64>) -> [f64; 3] {
    let numbered = tensor.iter().enumerate();
    numbered.fold([0.0; 3], |[a, b, c], (k, x)| {
        [a + x, b + x * x, c + x * ((k + 1) as f64).cos()]
    })
}

/// The largest absolute difference of two arrays of one shape.
pub fn worst(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    assert_eq!(a.dim(), b.dim());

    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

/// Fails unless two numbers agree.
#[track_caller]
pub fn near(what: &str, actual: f64, expected: f64, tolerance: f64) {
    assert!(
        (actual - expected).abs() <= tolerance,
        "{what}: {actual} is not {expected} within {tolerance}"
    );
}

/// Fails unless each number agrees with the expected one of its key: (key, actual, tolerance).
#[track_caller]
pub fn near_each(what: &str, expected: &serde_json::Value, numbers: &[(&str, f64, f64)]) {
    for &(key, actual, tolerance) in numbers {
        near(
            &format!("{what} {key}"),
            actual,
            number(&expected[key]),
            tolerance,
        );
    }
}

/// Defines two tests of `fn name(room: &str, folder: PathBuf)`: on the committed synthetic room,
/// and on the real room, which needs the folder of large inputs.
#[macro_export]
macro_rules! on_oracle_rooms {
    ($name:ident) => {
        mod $name {
            #[test]
            fn on_the_synthetic_room() {
                super::$name("synthetic", $crate::golden());
            }

            #[test]
            #[ignore = "needs the folder of large inputs: SEESE3_SHARED or ../shared"]
            fn on_the_real_room() {
                super::$name("real", $crate::shared().join("oracles"));
            }
        }
    };
}

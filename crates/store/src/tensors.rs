//! Reading and writing named arrays as safetensors files.

use seese3_core::Cause;
use std::collections::BTreeMap;

use ndarray::{Array2, ArrayD};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};

use super::Error;

/// Collects named tensors and serializes them into one file.
#[derive(Default)]
pub struct TensorWriter(BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>);

impl TensorWriter {
    pub fn f32(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = f32>) {
        self.0.insert(
            name.to_owned(),
            (
                Dtype::F32,
                shape.to_vec(),
                values.flat_map(f32::to_le_bytes).collect(),
            ),
        );
    }

    pub fn f64(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = f64>) {
        self.0.insert(
            name.to_owned(),
            (
                Dtype::F64,
                shape.to_vec(),
                values.flat_map(f64::to_le_bytes).collect(),
            ),
        );
    }

    pub fn u16(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = u16>) {
        self.0.insert(
            name.to_owned(),
            (
                Dtype::U16,
                shape.to_vec(),
                values.flat_map(u16::to_le_bytes).collect(),
            ),
        );
    }

    pub fn u8(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = u8>) {
        self.0.insert(
            name.to_owned(),
            (Dtype::U8, shape.to_vec(), values.collect()),
        );
    }

    pub fn i8(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = i8>) {
        self.0.insert(
            name.to_owned(),
            (
                Dtype::I8,
                shape.to_vec(),
                values.flat_map(i8::to_le_bytes).collect(),
            ),
        );
    }

    pub fn i64(&mut self, name: &str, shape: &[usize], values: impl Iterator<Item = i64>) {
        self.0.insert(
            name.to_owned(),
            (
                Dtype::I64,
                shape.to_vec(),
                values.flat_map(i64::to_le_bytes).collect(),
            ),
        );
    }

    /// Serializes the collected tensors. `file` is the name used in errors.
    pub fn finish(self, file: &str) -> Result<Vec<u8>, Error> {
        let damaged = |problem: Cause| Error::Damaged {
            file: file.to_owned(),
            problem,
        };

        let mut views = Vec::with_capacity(self.0.len());
        for (name, (dtype, shape, bytes)) in &self.0 {
            let view = TensorView::new(*dtype, shape.clone(), bytes)
                .map_err(|error| damaged(error.into()))?;
            views.push((name.clone(), view));
        }

        safetensors::serialize(views, None).map_err(|error| damaged(error.into()))
    }
}

/// The tensors of a safetensors file in memory.
pub struct TensorReader<'a> {
    file: &'a str,
    tensors: SafeTensors<'a>,
}

impl<'a> TensorReader<'a> {
    pub fn new(file: &'a str, bytes: &'a [u8]) -> Result<Self, Error> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| Error::Damaged {
            file: file.to_owned(),
            problem: error.into(),
        })?;
        Ok(Self { file, tensors })
    }

    pub fn has(&self, name: &str) -> bool {
        self.tensors.tensor(name).is_ok()
    }

    pub fn f32(&self, name: &str) -> Result<Array2<f32>, Error> {
        self.rows(name, Dtype::F32, f32::from_le_bytes)
    }

    pub fn u16(&self, name: &str) -> Result<Array2<u16>, Error> {
        self.rows(name, Dtype::U16, u16::from_le_bytes)
    }

    pub fn u8(&self, name: &str) -> Result<Array2<u8>, Error> {
        self.rows(name, Dtype::U8, u8::from_le_bytes)
    }

    pub fn i8(&self, name: &str) -> Result<Array2<i8>, Error> {
        self.rows(name, Dtype::I8, i8::from_le_bytes)
    }

    pub fn f64(&self, name: &str) -> Result<Array2<f64>, Error> {
        self.rows(name, Dtype::F64, f64::from_le_bytes)
    }

    pub fn i64(&self, name: &str) -> Result<Array2<i64>, Error> {
        self.rows(name, Dtype::I64, i64::from_le_bytes)
    }

    /// A tensor as a matrix: a scalar becomes (1, 1), a vector (n,) becomes (1, n), and a tensor
    /// (n, a, b, …) becomes (n, a·b·…).
    fn rows<T, const N: usize>(
        &self,
        name: &str,
        dtype: Dtype,
        read: fn([u8; N]) -> T,
    ) -> Result<Array2<T>, Error> {
        let damaged = |problem: Cause| Error::Damaged {
            file: self.file.to_owned(),
            problem,
        };
        let tensor = self
            .tensors
            .tensor(name)
            .map_err(|_| damaged(format!("has no tensor '{name}'").into()))?;

        // The schema defines one type per tensor. A file with another type is rejected, not
        // converted.
        if tensor.dtype() != dtype {
            return Err(damaged(
                format!(
                    "tensor '{name}' is {:?}, expected {dtype:?}",
                    tensor.dtype()
                )
                .into(),
            ));
        }

        // The bytes are little-endian and possibly unaligned, so each number is decoded from its
        // own `N` bytes.
        let values = tensor
            .data()
            .as_chunks::<N>()
            .0
            .iter()
            .map(|bytes| read(*bytes))
            .collect();

        let array = ArrayD::from_shape_vec(tensor.shape().to_vec(), values)
            .map_err(|e| damaged(e.into()))?;

        let shape = match tensor.shape() {
            [] => (1, 1),
            [columns] => (1, *columns),
            [rows, rest @ ..] => (*rows, rest.iter().product()),
        };

        array
            .into_shape_with_order(shape)
            .map_err(|error| damaged(error.into()))
    }
}

/// Errors of reading weights from a file.
pub enum WeightError {
    File(Error),
    Shape(seese3_core::adapter::Error),
}

impl From<seese3_core::adapter::Error> for WeightError {
    fn from(error: seese3_core::adapter::Error) -> Self {
        Self::Shape(error)
    }
}

impl WeightError {
    pub fn within(self, file: &str) -> Error {
        match self {
            Self::File(error) => error,
            Self::Shape(error) => Error::Damaged {
                file: file.to_owned(),
                problem: error.into(),
            },
        }
    }
}

pub fn read_weights(tensors: &TensorReader<'_>, name: &str) -> Result<Array2<f32>, WeightError> {
    tensors.f32(name).map_err(WeightError::File)
}

//! The relational reader of an adapter, as tensors of its weights file.
//!
//! `relational.M.NAME` is a tensor of member M. `relational.error_scale` (2,) f64 has the factors on
//! the predicted standard deviations of v and ω. `golden.relational` (n, 6) f64 has the motions from
//! the first golden input to each.

use ndarray::{Array2, ArrayView2};

use super::Error;
use super::tensors::{TensorReader, TensorWriter, read_weights};
use seese3_core::adapter::{self, Network, RelationalNetwork, RelationalReader};
use seese3_core::features::FeatureSource;

const ERROR_SCALE: &str = "relational.error_scale";
const GOLDEN: &str = "golden.relational";

/// Tolerance of a golden motion, meters and radians. The reader computes in f32, so that processors
/// with other instructions round differently.
const GOLDEN_TOLERANCE: f64 = 1e-3;

fn tensor_name(member: usize, name: &str) -> String {
    format!("relational.{member}.{name}")
}

/// Writes the reader's tensors, with golden motions between the rows of `golden`, shape (n, d).
pub fn write(
    tensors: &mut TensorWriter,
    reader: &RelationalReader,
    golden: ArrayView2<'_, f32>,
) -> Result<(), adapter::Error> {
    for (member, network) in reader.members().iter().enumerate() {
        for (name, array) in network.names().iter().zip(network.parameters()) {
            let shape = match array.dim() {
                (1, columns) => vec![columns],
                (rows, columns) => vec![rows, columns],
            };
            tensors.f32(&tensor_name(member, name), &shape, array.iter().copied());
        }
    }

    if let Some(factors) = reader.error_scale() {
        tensors.f64(ERROR_SCALE, &[2], factors.into_iter());
    }

    let motions = golden_motions(reader, golden)?;
    tensors.f64(GOLDEN, &[motions.nrows(), 6], motions.iter().copied());
    Ok(())
}

/// Reads a reader of `members` networks for features of a source, and checks its golden motions.
pub fn read(
    tensors: &TensorReader<'_>,
    source: &FeatureSource,
    members: usize,
    file: &str,
) -> Result<RelationalReader, Error> {
    let damaged = |error: adapter::Error| Error::Damaged {
        file: file.to_owned(),
        problem: error.into(),
    };

    let mut networks = Vec::with_capacity(members.min(adapter::MAX_MEMBERS));
    for member in 0..members.min(adapter::MAX_MEMBERS + 1) {
        let read = |name: &str| read_weights(tensors, &tensor_name(member, name));
        networks.push(RelationalNetwork::from_tensors(read).map_err(|error| error.within(file))?);
    }

    let mut reader = RelationalReader::new(source, networks).map_err(damaged)?;
    if tensors.has(ERROR_SCALE) {
        let factors = tensors.f64(ERROR_SCALE)?;
        let [linear, angular] = match factors.as_slice() {
            Some(&[linear, angular]) => [linear, angular],
            _ => {
                return Err(Error::Damaged {
                    file: file.to_owned(),
                    problem: format!("'{ERROR_SCALE}' does not have 2 numbers").into(),
                });
            }
        };
        reader = reader
            .with_error_scale([linear, angular])
            .map_err(damaged)?;
    }

    let golden = tensors.f32("golden.features")?;
    let found = golden_motions(&reader, golden.view()).map_err(damaged)?;
    let stored = tensors.f64(GOLDEN)?;
    let is_near = |(found, stored): (&f64, &f64)| (found - stored).abs() <= GOLDEN_TOLERANCE;
    if found.dim() != stored.dim() || !found.iter().zip(&stored).all(is_near) {
        return Err(Error::Damaged {
            file: file.to_owned(),
            problem:
                "its golden inputs do not give the golden motions of its relational reader on this \
                      machine; publish it again"
                    .into(),
        });
    }

    Ok(reader)
}

/// The motions from the first golden input to each, shape (n, 6).
fn golden_motions(
    reader: &RelationalReader,
    golden: ArrayView2<'_, f32>,
) -> Result<Array2<f64>, adapter::Error> {
    let cells = reader.cells(golden)?;
    let motions = match golden.nrows() {
        0 => Vec::new(),
        _ => reader.motions(&cells, 0, &cells),
    };

    Ok(Array2::from_shape_fn(
        (motions.len(), 6),
        |(row, column)| motions[row].twist.to_vector()[column],
    ))
}

//! An adapter's calibration among its tensors.

use nalgebra::Matrix6;
use ndarray::Array2;

use super::Error;
use super::tensors::{TensorReader, TensorWriter};
use crate::adapter::{Calibration, ErrorTable, Measured, MotionErrors, Stratum};

const FLICKER: &str = "calibration.flicker";
const SPREAD: &str = "calibration.spread";
/// By stratum: frames or distance, gain, and 36 numbers of the covariance on (v, ω).
const MOTIONS: &str = "calibration.motions";
/// As above.
const ANCHORS: &str = "calibration.anchors";
/// The motions' floor, the limit of a room, the sure one, the length of a jump, the factor of
/// places.
const LIMITS: &str = "calibration.limits";

pub fn write(tensors: &mut TensorWriter, calibration: &Calibration) {
    let Measured {
        flicker,
        spread,
        motion,
        anchor,
        foreign,
        sure,
        jump,
        place,
    } = calibration.measured();

    for (name, matrix) in [(FLICKER, flicker), (SPREAD, spread)] {
        tensors.f64(
            name,
            &[matrix.nrows(), matrix.ncols()],
            matrix.iter().copied(),
        );
    }

    let row = |stratum: &Stratum| {
        let covariance: Vec<f64> = stratum.covariance.transpose().iter().copied().collect();
        [stratum.at, stratum.gain].into_iter().chain(covariance)
    };

    for (name, table) in [(MOTIONS, &motion.shapes), (ANCHORS, anchor)] {
        tensors.f64(
            name,
            &[table.strata().len(), 38],
            table.strata().iter().flat_map(row),
        );
    }

    tensors.f64(
        LIMITS,
        &[5],
        [motion.floor, *foreign, *sure, *jump, *place].into_iter(),
    );
}

/// The calibration, if the file has one.
pub fn read(tensors: &TensorReader<'_>, file: &str) -> Result<Option<Calibration>, Error> {
    if !tensors.has(FLICKER) {
        return Ok(None);
    }

    let limits = sized(tensors, LIMITS, Some(1), 5, file)?;

    let stratum = |row: ndarray::ArrayView1<'_, f64>| Stratum {
        at: row[0],
        gain: row[1],
        covariance: Matrix6::from_fn(|i, j| row[2 + 6 * i + j]),
    };

    let damaged = |error: crate::adapter::Error| Error::Damaged {
        file: file.to_owned(),
        problem: error.to_string(),
    };
    let table = |name: &str| {
        let rows = sized(tensors, name, None, 38, file)?;
        ErrorTable::new(rows.outer_iter().map(stratum).collect()).map_err(damaged)
    };

    let measured = Measured {
        flicker: tensors.f64(FLICKER)?,
        spread: tensors.f64(SPREAD)?,
        motion: MotionErrors {
            shapes: table(MOTIONS)?,
            floor: limits[(0, 0)],
        },
        anchor: table(ANCHORS)?,
        foreign: limits[(0, 1)],
        sure: limits[(0, 2)],
        jump: limits[(0, 3)],
        place: limits[(0, 4)],
    };

    Calibration::new(measured).map(Some).map_err(damaged)
}

/// A tensor with so many columns, and rows if those are known.
fn sized(
    tensors: &TensorReader<'_>,
    name: &str,
    rows: Option<usize>,
    columns: usize,
    file: &str,
) -> Result<Array2<f64>, Error> {
    let array = tensors.f64(name)?;
    if array.ncols() != columns || rows.is_some_and(|rows| rows != array.nrows()) {
        let problem = format!(
            "'{name}' has shape {:?}, expected {columns} columns",
            array.dim()
        );
        return Err(Error::Damaged {
            file: file.to_owned(),
            problem,
        });
    }

    Ok(array)
}

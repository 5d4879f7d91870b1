//! Storage of an adapter's calibration, as tensors in its weights file.

use nalgebra::Matrix6;
use ndarray::Array2;

use super::Error;
use super::tensors::{TensorReader, TensorWriter};
use seese3_core::adapter::{ErrorModel, ErrorStatistics, ErrorTable, Stratum};
use seese3_robot::tracking::ASSUMED_PERIOD_S;

const FRAME_NOISE: &str = "calibration.flicker";
/// One row per stratum: the match distance, whitened by the covariance of the frame noise, and the
/// covariance on (v, ω), 36 entries in row-major order. Files of earlier versions have a gain in
/// between.
const MATCH_ERRORS: &str = "calibration.anchors";
/// The out-of-distribution limit and the certain-match limit. Files of earlier versions have five
/// numbers, with these two at the second and third place.
const LIMITS: &str = "calibration.limits";
/// Frame period, seconds. Absent in files of earlier versions, whose rooms were recorded at 30 Hz.
const FRAME_PERIOD: &str = "calibration.period";

pub fn write(tensors: &mut TensorWriter, error_model: &ErrorModel) {
    // Destructured with no `..`, so that a new statistic breaks the build here.
    let ErrorStatistics {
        frame_period_s,
        frame_noise,
        match_errors,
        out_of_distribution_ratio,
        certain_match_ratio,
    } = error_model.statistics();

    tensors.f64(
        FRAME_NOISE,
        &[frame_noise.nrows(), frame_noise.ncols()],
        frame_noise.iter().copied(),
    );

    // nalgebra iterates in column-major order; the transpose gives row-major entries.
    let row = |stratum: &Stratum| {
        let covariance: Vec<f64> = stratum.covariance.transpose().iter().copied().collect();
        std::iter::once(stratum.at).chain(covariance)
    };

    tensors.f64(
        MATCH_ERRORS,
        &[match_errors.strata().len(), 37],
        match_errors.strata().iter().flat_map(row),
    );
    tensors.f64(FRAME_PERIOD, &[1], [*frame_period_s].into_iter());

    tensors.f64(
        LIMITS,
        &[2],
        [*out_of_distribution_ratio, *certain_match_ratio].into_iter(),
    );
}

/// Reads the calibration; `None` if the file has none.
pub fn read(tensors: &TensorReader<'_>, file: &str) -> Result<Option<ErrorModel>, Error> {
    // Calibration tensors are written together, so one of them indicates whether a calibration
    // exists. If another is missing, the file is damaged.
    if !tensors.has(FRAME_NOISE) {
        return Ok(None);
    }

    let limits = tensors.f64(LIMITS)?;
    let limits = match limits.dim() {
        (1, 2) => [limits[(0, 0)], limits[(0, 1)]],
        _ => {
            let limits = sized(tensors, LIMITS, Some(1), 5, file)?;
            [limits[(0, 1)], limits[(0, 2)]]
        }
    };

    let frame_period_s = if tensors.has(FRAME_PERIOD) {
        sized(tensors, FRAME_PERIOD, Some(1), 1, file)?[(0, 0)]
    } else {
        ASSUMED_PERIOD_S
    };

    let damaged = |error: seese3_core::adapter::Error| Error::Damaged {
        file: file.to_owned(),
        problem: error.into(),
    };
    let rows = tensors.f64(MATCH_ERRORS)?;
    let first = if rows.ncols() == 37 { 1 } else { 2 };
    let rows = sized(tensors, MATCH_ERRORS, None, first + 36, file)?;
    let stratum = |row: ndarray::ArrayView1<'_, f64>| Stratum {
        at: row[0],
        covariance: Matrix6::from_fn(|i, j| row[first + 6 * i + j]),
    };

    let statistics = ErrorStatistics {
        frame_period_s,
        frame_noise: tensors.f64(FRAME_NOISE)?,
        match_errors: ErrorTable::new(rows.outer_iter().map(stratum).collect()).map_err(damaged)?,
        out_of_distribution_ratio: limits[0],
        certain_match_ratio: limits[1],
    };

    ErrorModel::new(statistics).map(Some).map_err(damaged)
}

/// Reads a tensor and checks its number of columns and, if given, of rows.
pub(super) fn sized(
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
            problem: problem.into(),
        });
    }

    Ok(array)
}

//! Storage of an adapter's calibration, as tensors in its weights file.

use nalgebra::Matrix6;
use ndarray::Array2;

use super::Error;
use super::tensors::{TensorReader, TensorWriter};
use seese3_core::adapter::{ErrorModel, ErrorStatistics, ErrorTable, MotionErrors, Stratum};
use seese3_robot::tracking::ASSUMED_PERIOD_S;

const FRAME_NOISE: &str = "calibration.flicker";
const MOTION_SPREAD: &str = "calibration.spread";
/// One row per stratum: the number of frames between the two views, the gain, and the covariance on
/// (v, ω), 36 entries in row-major order.
const MOTIONS: &str = "calibration.motions";
/// As [`MOTIONS`], but the first column is the match distance, whitened by the covariance of the
/// frame noise.
const ANCHORS: &str = "calibration.anchors";
/// Five numbers, in this order: the floor u₀ of the motion errors, the out-of-distribution limit,
/// the certain-match limit, the jump distance and the map-pose factor.
const LIMITS: &str = "calibration.limits";
/// Frame period, seconds. Absent in files of earlier versions, whose rooms were recorded at 30 Hz.
const FRAME_PERIOD: &str = "calibration.period";

pub fn write(tensors: &mut TensorWriter, error_model: &ErrorModel) {
    // Destructured with no `..`, so that a new statistic breaks the build here.
    let ErrorStatistics {
        frame_period_s,
        frame_noise,
        motion_spread,
        motion_errors,
        anchor_errors,
        out_of_distribution_ratio,
        certain_match_ratio,
        jump_distance,
        map_pose_factor,
    } = error_model.statistics();

    for (name, matrix) in [(FRAME_NOISE, frame_noise), (MOTION_SPREAD, motion_spread)] {
        tensors.f64(
            name,
            &[matrix.nrows(), matrix.ncols()],
            matrix.iter().copied(),
        );
    }

    // nalgebra iterates in column-major order; the transpose gives row-major entries.
    let row = |stratum: &Stratum| {
        let covariance: Vec<f64> = stratum.covariance.transpose().iter().copied().collect();
        [stratum.at, stratum.gain].into_iter().chain(covariance)
    };

    for (name, table) in [(MOTIONS, &motion_errors.shapes), (ANCHORS, anchor_errors)] {
        tensors.f64(
            name,
            &[table.strata().len(), 38],
            table.strata().iter().flat_map(row),
        );
    }

    tensors.f64(FRAME_PERIOD, &[1], [*frame_period_s].into_iter());

    // The order of the five numbers is part of the file format; `read` relies on it.
    tensors.f64(
        LIMITS,
        &[5],
        [
            motion_errors.floor,
            *out_of_distribution_ratio,
            *certain_match_ratio,
            *jump_distance,
            *map_pose_factor,
        ]
        .into_iter(),
    );
}

/// Reads the calibration; `None` if the file has none.
pub fn read(tensors: &TensorReader<'_>, file: &str) -> Result<Option<ErrorModel>, Error> {
    // Calibration tensors are written together, so one of them indicates whether a calibration
    // exists. If another is missing, the file is damaged.
    if !tensors.has(FRAME_NOISE) {
        return Ok(None);
    }

    let limits = sized(tensors, LIMITS, Some(1), 5, file)?;

    let frame_period_s = if tensors.has(FRAME_PERIOD) {
        sized(tensors, FRAME_PERIOD, Some(1), 1, file)?[(0, 0)]
    } else {
        ASSUMED_PERIOD_S
    };

    let stratum = |row: ndarray::ArrayView1<'_, f64>| Stratum {
        at: row[0],
        gain: row[1],
        covariance: Matrix6::from_fn(|i, j| row[2 + 6 * i + j]),
    };

    let damaged = |error: seese3_core::adapter::Error| Error::Damaged {
        file: file.to_owned(),
        problem: error.into(),
    };
    let table = |name: &str| {
        let rows = sized(tensors, name, None, 38, file)?;
        ErrorTable::new(rows.outer_iter().map(stratum).collect()).map_err(damaged)
    };

    let statistics = ErrorStatistics {
        frame_period_s,
        frame_noise: tensors.f64(FRAME_NOISE)?,
        motion_spread: tensors.f64(MOTION_SPREAD)?,
        motion_errors: MotionErrors {
            shapes: table(MOTIONS)?,
            floor: limits[(0, 0)],
        },
        anchor_errors: table(ANCHORS)?,
        out_of_distribution_ratio: limits[(0, 1)],
        certain_match_ratio: limits[(0, 2)],
        jump_distance: limits[(0, 3)],
        map_pose_factor: limits[(0, 4)],
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

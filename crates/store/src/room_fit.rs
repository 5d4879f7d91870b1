//! Storage of a fitted adapter's reading rules, as a tensor in its weights file.

use nalgebra::Matrix6;
use ndarray::ArrayView1;
use strum::VariantArray;

use super::Error;
use super::error_model::sized;
use super::format::FittedEntry;
use super::stored_adapter::{BaseAdapter, RoomFit};
use super::tensors::{TensorReader, TensorWriter};
use seese3_core::Cause;
use seese3_core::room::RoomId;
use seese3_robot::fitting::{MotionReader, PartRule, ReadingRule, ReadingRules};

/// One row per rule: the largest distance; the reader and gain for translation, then those for
/// rotation; the minimum disagreement; and the covariance on (v, ω), 36 entries in row-major order.
/// A reader is stored as its index in [`MotionReader::VARIANTS`].
const RULES: &str = "fit.rules";
/// Number of columns of [`RULES`] before the covariance.
const COLUMNS_BEFORE_COVARIANCE: usize = 6;
const COLUMNS: usize = COLUMNS_BEFORE_COVARIANCE + 36;

pub fn write(tensors: &mut TensorWriter, rules: &ReadingRules) {
    let part = |rule: PartRule| {
        let position = MotionReader::VARIANTS
            .iter()
            .position(|reader| *reader == rule.reader);
        [position.unwrap_or_default() as f64, rule.gain]
    };

    // nalgebra iterates in column-major order; the transpose gives row-major entries.
    let row = |rule: &ReadingRule| {
        let covariance: Vec<f64> = rule.covariance.transpose().iter().copied().collect();
        [rule.up_to]
            .into_iter()
            .chain(part(rule.translation))
            .chain(part(rule.rotation))
            .chain([rule.least_disagreement])
            .chain(covariance)
    };

    let shape = [rules.rules().len(), COLUMNS];
    tensors.f64(RULES, &shape, rules.rules().iter().flat_map(row));
}

/// Reads the room fit of an adapter.
pub fn read(entry: FittedEntry, tensors: &TensorReader<'_>, file: &str) -> Result<RoomFit, Error> {
    let damaged = |problem: Cause| Error::Damaged {
        file: file.to_owned(),
        problem,
    };

    let part = |reader: f64, gain: f64| {
        let known = MotionReader::VARIANTS
            .iter()
            .enumerate()
            .find(|(position, _)| *position as f64 == reader);
        match known {
            Some((_, &reader)) => Ok(PartRule { reader, gain }),
            None => Err(damaged(
                format!("names a reader {reader}, which this program does not know").into(),
            )),
        }
    };

    let rule = |row: ArrayView1<'_, f64>| {
        Ok(ReadingRule {
            up_to: row[0],
            translation: part(row[1], row[2])?,
            rotation: part(row[3], row[4])?,
            least_disagreement: row[5],
            covariance: Matrix6::from_fn(|i, j| row[COLUMNS_BEFORE_COVARIANCE + 6 * i + j]),
        })
    };

    let rows = sized(tensors, RULES, None, COLUMNS, file)?;
    let rules: Vec<ReadingRule> = rows.outer_iter().map(rule).collect::<Result<_, Error>>()?;

    Ok(RoomFit {
        room: RoomId::new(&entry.room).map_err(|error| damaged(error.into()))?,
        room_revision: entry.room_revision,
        base: entry
            .base
            .map(|(name, revision)| BaseAdapter { name, revision }),
        rules: ReadingRules::new(rules).map_err(|error| damaged(error.into()))?,
    })
}

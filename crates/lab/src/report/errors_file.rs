//! Errors of every pair or view as Parquet files, so that others can resample them.

use super::Error;
use super::columns::ParquetColumn::{Real, Text, Whole};
use super::columns::{ParquetColumn, parquet_file};
use crate::experiments::EstimateError;
use crate::experiments::cross_room::CrossRoomRun;
use seese3_core::eval::{RetrievedPair, Row};

/// A scored pair, with where and by which navigator.
struct PairRow<'a> {
    room: &'a str,
    learned_rooms: u64,
    seed: u64,
    navigator: &'a str,
    pair: RetrievedPair,
}

/// The bytes of a Parquet file with a row for each navigator and pair of one room.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects a column.
pub fn retrieval_errors_file(room: &str, rows: &[Row]) -> Result<Vec<u8>, Error> {
    let pairs: Vec<PairRow<'_>> = pair_rows(room, rows, [0, 0]).collect();
    parquet_file(&pairs, &pair_columns())
}

/// The bytes of a Parquet file with a row for each run, held-out room, navigator and pair.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects a column.
pub fn cross_room_errors_file(runs: &[CrossRoomRun]) -> Result<Vec<u8>, Error> {
    let mut pairs = Vec::new();
    for run in runs {
        for outcome in &run.outcomes {
            let protocol = [run.training_rooms.len() as u64, run.seed];
            pairs.extend(pair_rows(outcome.room.as_str(), &outcome.rows, protocol));
        }
    }

    let mut columns = vec![
        (
            "learned_rooms",
            Whole(|row: &PairRow<'_>| row.learned_rooms),
        ),
        ("seed", Whole(|row| row.seed)),
    ];
    columns.extend(pair_columns());
    parquet_file(&pairs, &columns)
}

/// The columns of one pair.
fn pair_columns<'a>() -> Vec<(&'static str, ParquetColumn<PairRow<'a>>)> {
    vec![
        ("room", Text(|row| row.room)),
        ("navigator", Text(|row| row.navigator)),
        ("source", Whole(|row| u64::from(row.pair.pair.source.0))),
        ("target", Whole(|row| u64::from(row.pair.pair.target.0))),
        ("retrieved", Whole(|row| u64::from(row.pair.retrieved.0))),
        ("twist_error", Real(|row| row.pair.twist_error)),
        (
            "translation_m",
            Real(|row| row.pair.pose_error.translation_m),
        ),
        (
            "rotation_deg",
            Real(|row| row.pair.pose_error.rotation_rad.to_degrees()),
        ),
    ]
}

fn pair_rows<'a>(
    room: &'a str,
    rows: &'a [Row],
    [learned_rooms, seed]: [u64; 2],
) -> impl Iterator<Item = PairRow<'a>> {
    rows.iter().flat_map(move |row| {
        row.retrieval.pairs.iter().map(move |&pair| PairRow {
            room,
            learned_rooms,
            seed,
            navigator: &row.name,
            pair,
        })
    })
}

/// The bytes of a Parquet file with a row for each method and view, or pair of views, of one room.
/// The errors of a view without an answer are NaN; the source of a single view is the view.
///
/// # Errors
/// [`Error::Parquet`] if the library rejects a column.
pub fn estimate_errors_file(room: &str, errors: &[EstimateError]) -> Result<Vec<u8>, Error> {
    let rows: Vec<(&str, EstimateError)> = errors.iter().map(|error| (room, *error)).collect();
    parquet_file(
        &rows,
        &[
            ("room", Text(|row| row.0)),
            ("method", Text(|row| row.1.method)),
            (
                "source",
                Whole(|row| u64::from(row.1.source.unwrap_or(row.1.target).0)),
            ),
            ("target", Whole(|row| u64::from(row.1.target.0))),
            (
                "translation_m",
                Real(|row| row.1.error.map_or(f64::NAN, |error| error.translation_m)),
            ),
            (
                "rotation_deg",
                Real(|row| {
                    row.1
                        .error
                        .map_or(f64::NAN, |error| error.rotation_rad.to_degrees())
                }),
            ),
            ("squared_mahalanobis", Real(|row| row.1.squared_length)),
        ],
    )
}

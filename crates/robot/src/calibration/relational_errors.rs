//! The error scale of a relational reader: how much larger its errors are than it predicts, in
//! rooms that it was not trained on.

use nalgebra::{Matrix3, Vector3};

use super::Error;
use seese3_core::adapter::{self, RelationalReader};
use seese3_core::geometry::body_twist;
use seese3_core::splits::Split;
use seese3_core::statistics::quantile;
use seese3_core::training::RoomData;

/// Step between the measured strides, frames.
const STRIDE_STEP: usize = 5;
/// The largest measured stride, frames.
const LONGEST_STRIDE: u32 = 40;
/// Largest number of measured pairs of a room at one stride.
const PAIRS_PER_STRIDE: usize = 50;
/// The share of errors that the scaled ellipsoid of one standard deviation contains.
const SHARE: f64 = 0.682_689_492;
/// The quantile of the χ² distribution with 3 degrees of freedom at [`SHARE`].
const CHI_SQUARED: f64 = 3.526_74;

/// Factors on the predicted standard deviations of v and ω with which 68 % of the errors are within
/// the ellipsoid of one standard deviation; over all rooms and strides up to 40 together.
///
/// # Errors
/// [`adapter::Error::NoPairs`] if the rooms have no pair of frames, or for features of another
/// width.
pub fn error_scale(reader: &RelationalReader, rooms: &[RoomData<'_>]) -> Result<[f64; 2], Error> {
    let mut squares: [Vec<f64>; 2] = Default::default();
    for data in rooms {
        let cells = reader.cells(data.features.rows())?;
        let poses = data.room.poses();

        for stride in (1..=LONGEST_STRIDE).step_by(STRIDE_STEP) {
            let pairs = Split::Whole
                .train_pairs(data.room.timeline(), stride)
                .unwrap_or_default();
            for pair in pairs
                .iter()
                .step_by(pairs.len().div_ceil(PAIRS_PER_STRIDE).max(1))
            {
                let [from, to] = [pair.source.row(), pair.target.row()];
                let read = reader.motions(&cells, from, &cells.select(&[to]))[0];
                let error =
                    body_twist(&poses[from], &poses[to]).to_vector() - read.twist.to_vector();

                for (part, squares) in squares.iter_mut().enumerate() {
                    let error: Vector3<f64> = error.fixed_rows::<3>(3 * part).into();
                    let block: Matrix3<f64> = read
                        .covariance
                        .fixed_view::<3, 3>(3 * part, 3 * part)
                        .into();
                    // A covariance that cannot be inverted is not of this reader.
                    let inverse = block.try_inverse().unwrap_or_else(Matrix3::identity);
                    squares.push((error.transpose() * inverse * error)[(0, 0)]);
                }
            }
        }
    }

    let [linear, angular] = squares.map(|squares| quantile(&squares, SHARE));
    let (linear, angular) = linear.zip(angular).ok_or(adapter::Error::NoPairs)?;
    Ok([linear, angular].map(|square| (square / CHI_SQUARED).sqrt()))
}

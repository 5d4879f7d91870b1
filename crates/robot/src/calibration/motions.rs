//! Errors of the motions that an adapter predicts between two frames.

use nalgebra::Vector6;
use ndarray::{Array2, Axis};

use super::Error;
use super::embedded_room::EmbeddedRoom;
use super::robust_covariance;
use seese3_core::adapter::{self, Adapter, ErrorTable, MotionErrors, PairPlan, Stratum, Whitener};
use seese3_core::geometry::body_twist;
use seese3_core::splits::Pair;

/// u₀ of [`MotionErrors`]: chosen by hand, near the squared length u between successive frames.
/// It matters only if u is near zero.
const FLOOR: f64 = 0.05;

/// A pair of frames of one calibration room.
#[derive(Debug, Clone, Copy)]
pub struct RoomPair {
    /// Index into the calibration rooms.
    pub room: usize,
    /// The two frames.
    pub pair: Pair,
}

/// Strides at which motion errors are measured: the Fibonacci numbers 1, 2, 3, 5, 8, … below the
/// longest trained stride, then that stride. Errors change with the logarithm of the stride, so
/// short strides are sampled more densely.
pub fn fibonacci_strides(plan: &PairPlan) -> Vec<u32> {
    let longest = match plan {
        PairPlan::Stride(stride) => *stride,
        PairPlan::Range(range) => range.high,
    };

    let mut strides = vec![1, 2];
    while let [.., a, b] = strides[..]
        && a + b < longest
    {
        strides.push(a + b);
    }

    strides.retain(|&stride| stride < longest);
    strides.push(longest);
    strides
}

/// Second moment of the latent differences d of the pairs, mean d dᵀ, shape (c, c).
///
/// # Errors
/// [`adapter::Error::NoPairs`] unless there are more pairs than columns.
pub fn second_moment(rooms: &[EmbeddedRoom<'_>], pairs: &[RoomPair]) -> Result<Array2<f64>, Error> {
    let size = rooms[0].coordinates.ncols();
    if pairs.len() <= size {
        return Err(adapter::Error::NoPairs.into());
    }

    let mut differences = Array2::zeros((pairs.len(), size));
    for (at, mut row) in pairs.iter().zip(differences.axis_iter_mut(Axis(0))) {
        let coordinates = &rooms[at.room].coordinates;
        let target = coordinates.row(at.pair.target.row());
        let source = coordinates.row(at.pair.source.row());
        row.assign(&(&target - &source));
    }

    let moment = differences.t().dot(&differences) / pairs.len() as f64;
    // Rounding may leave the product asymmetric in its last bits.
    Ok((&moment + &moment.t()) * 0.5)
}

/// Gains and covariances of motion errors by stride; `spread` is the whitener of the motion
/// spread.
pub fn motion_errors(
    adapter: &Adapter,
    rooms: &[EmbeddedRoom<'_>],
    pairs_by_stride: &[(u32, Vec<RoomPair>)],
    spread: &Whitener,
) -> Result<MotionErrors, Error> {
    let scale = adapter.scale().deviation;
    let mut strata = Vec::with_capacity(pairs_by_stride.len());
    for (stride, pairs) in pairs_by_stride {
        let motions: Vec<ReadPair> = pairs
            .iter()
            .map(|at| ReadPair::of(adapter, &rooms[at.room], at.pair, spread))
            .collect();
        let read = motions.iter().map(|pair| (&pair.truth, &pair.read));
        let gain = share_to_believe(read, &scale);

        // Residuals divided by √(u + u₀) have the covariance S(n).
        let residuals: Vec<Vector6<f64>> = motions
            .iter()
            .map(|pair| (pair.truth - pair.read * gain) / (pair.squared_length + FLOOR).sqrt())
            .collect();
        strata.push(Stratum {
            at: f64::from(*stride),
            gain,
            covariance: robust_covariance(&residuals)?,
        });
    }

    Ok(MotionErrors {
        shapes: ErrorTable::new(strata)?,
        floor: FLOOR,
    })
}

/// Shrinkage gain of predicted motions: the slope of the regression of true on predicted motions
/// through the origin, clamped to 0 to 1. `pairs` are (truth, prediction); `scale` makes meters
/// and radians comparable.
pub fn share_to_believe<'a>(
    pairs: impl Iterator<Item = (&'a Vector6<f64>, &'a Vector6<f64>)>,
    scale: &Vector6<f64>,
) -> f64 {
    let mut truth_on_read = 0.0;
    let mut read_on_read = 0.0;
    for (truth, read) in pairs {
        let read = read.component_div(scale);
        truth_on_read += truth.component_div(scale).dot(&read);
        read_on_read += read.dot(&read);
    }

    let slope = truth_on_read / read_on_read;
    if slope.is_finite() {
        slope.clamp(0.0, 1.0)
    } else {
        0.0
    }
}

/// A true motion and the adapter's prediction.
struct ReadPair {
    truth: Vector6<f64>,
    read: Vector6<f64>,
    /// u: squared length of the latent difference in the motion spread.
    squared_length: f64,
}

impl ReadPair {
    fn of(adapter: &Adapter, room: &EmbeddedRoom<'_>, pair: Pair, spread: &Whitener) -> Self {
        let from = pair.source.row();
        let to = pair.target.row();
        let read = adapter.motion_without_mean(room.latents.row(from), room.latents.row(to));
        let difference = &room.coordinates.row(to) - &room.coordinates.row(from);

        Self {
            truth: body_twist(&room.poses[from], &room.poses[to]).to_vector(),
            read: read.to_vector(),
            squared_length: spread.squared_length(difference.view()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn strides_grow_to_the_longest() {
        assert_eq!(fibonacci_strides(&PairPlan::Stride(1)), [1]);
        assert_eq!(fibonacci_strides(&PairPlan::Stride(2)), [1, 2]);
        assert_eq!(
            fibonacci_strides(&PairPlan::Stride(40)),
            [1, 2, 3, 5, 8, 13, 21, 34, 40]
        );
    }
}

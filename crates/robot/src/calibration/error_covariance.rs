//! The second moment of an adapter's motion errors in rooms that it was not trained on.

use nalgebra::Matrix6;

use super::Error;
use seese3_core::adapter::{self, Adapter, PairPlan, TrainingRecord};
use seese3_core::geometry::body_twist;
use seese3_core::splits::{self, Pair, Split};
use seese3_core::training::{self, RoomData};

/// Step between the measured strides of a range: neighboring strides have nearly the same errors.
const STRIDE_STEP: usize = 5;
/// A six-dimensional covariance needs at least this many errors.
const FEWEST_PAIRS: usize = 6;

/// Second moment of motion errors without μ: Σ = mean r rᵀ with r = ΔP − σ⊙W(g₂ − g₁), on (v, ω),
/// meters and radians. The mean is over all pairs of the rooms at the trained stride, or at every
/// fifth stride of a trained range.
///
/// # Errors
/// [`Error`] if a room is too short to have a pair.
pub fn error_covariance(
    adapter: &Adapter,
    record: &TrainingRecord,
    rooms: &[RoomData<'_>],
) -> Result<Matrix6<f64>, Error> {
    let strides = trained_strides(&record.pairs);
    let mut sum = Matrix6::zeros();
    let mut count = 0usize;

    for data in rooms {
        let latents = adapter.embed(data.features.rows())?;
        let poses = data.room.poses();

        for pair in pairs(data, &strides)? {
            let from = pair.source.row();
            let to = pair.target.row();
            let read = adapter
                .motion(latents.row(from), latents.row(to))
                .to_vector()
                - adapter.scale().mean;
            let truth = body_twist(&poses[from], &poses[to]).to_vector();

            let residual = truth - read;
            sum += residual * residual.transpose();
            count += 1;
        }
    }

    if count < FEWEST_PAIRS {
        return Err(adapter::Error::NoPairs.into());
    }

    Ok(sum / count as f64)
}

/// Measured strides: the trained stride; for a range, every fifth from the lowest, and the highest.
fn trained_strides(plan: &PairPlan) -> Vec<u32> {
    match plan {
        PairPlan::Stride(stride) => vec![*stride],
        PairPlan::Range(range) => {
            let mut strides: Vec<u32> = (range.low..=range.high).step_by(STRIDE_STEP).collect();
            if strides.last() != Some(&range.high) {
                strides.push(range.high);
            }
            strides
        }
    }
}

/// All pairs of a room at these strides; at least one.
fn pairs(data: &RoomData<'_>, strides: &[u32]) -> Result<Vec<Pair>, training::Error> {
    let timeline = data.room.timeline();
    let pairs: Vec<Pair> = strides
        .iter()
        .filter_map(|&stride| Split::Whole.train_pairs(timeline, stride).ok())
        .flatten()
        .collect();

    if pairs.is_empty() {
        return Err(training::Error::RoomPairs {
            room: data.room.id().clone(),
            problem: splits::Error::NoPairs {
                frame_count: data.room.frame_count(),
                stride: strides[0],
                split: Split::Whole,
                side: "calibration",
            },
        });
    }

    Ok(pairs)
}

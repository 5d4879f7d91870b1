//! The motion between two views of a room, as an adapter reads it, beside the simplest answers.

use seese3_core::adapter::Adapter;
use seese3_core::geometry::{Twist, exp};
use seese3_core::splits::{Pair, Split};
use seese3_core::training::{RoomData, motions};

use super::Error;
use super::localization::ErrorQuantiles;

/// How far read motions are from the true ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionErrors {
    /// Distances between where the read and the true motion end, metres.
    pub translation_m: ErrorQuantiles,
    /// Angles between how they end, degrees.
    pub rotation_deg: ErrorQuantiles,
}

/// The results in one room at one stride.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionEvaluation {
    /// How many pairs of frames were read.
    pub n: usize,
    /// What `EstimateMotion` answers: the adapter's reading with the mean training motion μ.
    pub ours: MotionErrors,
    /// The adapter's reading without μ, as trackers take it.
    pub without_mean: MotionErrors,
    /// μ, whatever the views show.
    pub constant: MotionErrors,
    /// No motion at all.
    pub no_motion: MotionErrors,
}

/// Reads the motion between the frames of every pair of a room at a stride.
///
/// # Errors
/// [`Error::Adapter`] when the features are not the adapter's, [`Error::Splits`] when the room is
/// too short for the stride.
pub fn evaluate(
    data: &RoomData<'_>,
    adapter: &Adapter,
    stride: u32,
) -> Result<MotionEvaluation, Error> {
    adapter.check_source(data.features.source())?;
    let pairs = Split::Whole.test_pairs(data.room.timeline(), stride)?;
    let truth = motions(data.room.poses(), &pairs);
    let latents = adapter.embed(data.features.rows())?;

    let read = |of: &dyn Fn(&Pair) -> Twist| {
        let read: Vec<Twist> = pairs.iter().map(of).collect();
        errors(&truth, &read)
    };
    let ends = |pair: &Pair| {
        (
            latents.row(pair.source.row()),
            latents.row(pair.target.row()),
        )
    };
    let mean = Twist::from_vector(&adapter.scale().mean);

    Ok(MotionEvaluation {
        n: pairs.len(),
        ours: read(&|pair| {
            let (from, to) = ends(pair);
            adapter.motion(from, to)
        }),
        without_mean: read(&|pair| {
            let (from, to) = ends(pair);
            adapter.motion_without_mean(from, to)
        }),
        constant: read(&|_| mean),
        no_motion: read(&|_| Twist::default()),
    })
}

fn errors(truth: &[Twist], read: &[Twist]) -> MotionErrors {
    let apart = truth
        .iter()
        .zip(read)
        .map(|(truth, read)| exp(read).inv_mul(&exp(truth)));

    let mut metres = Vec::with_capacity(truth.len());
    let mut degrees = Vec::with_capacity(truth.len());
    for error in apart {
        metres.push(error.translation.vector.norm());
        degrees.push(error.rotation.angle().to_degrees());
    }

    MotionErrors {
        translation_m: ErrorQuantiles::of(&metres),
        rotation_deg: ErrorQuantiles::of(&degrees),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: a motion of 3 and 4 m along two axes that is read as none is 5 m off.
    #[test]
    fn no_motion_is_off_by_the_motion_itself() {
        let truth = Twist {
            linear: [3.0, 0.0, 4.0].into(),
            angular: [0.0; 3].into(),
        };
        let found = errors(&[truth], &[Twist::default()]);

        assert!((found.translation_m.median - 5.0).abs() < 1e-12);
        assert!(found.rotation_deg.median.abs() < 1e-12);
    }
}

//! Evaluates motion estimates between two views of a room: by an adapter, by a two-view estimator,
//! and by simple baselines.

use ndarray::ArrayView3;
use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::Adapter;
use seese3_core::features::Features;
use seese3_core::geometry::{CameraIntrinsics, PoseError, Twist, exp, log};
use seese3_core::nalgebra::Cholesky;
use seese3_core::room::Room;
use seese3_core::splits::Pair;
use seese3_core::statistics::{Coverage, coverage};
use seese3_core::training::motions;
use seese3_robot::two_view;

use super::Error;
use super::localization::LocalizationErrors;

/// The results in one room. Errors are those of the poses at the end of the motions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MotionEvaluation {
    /// Number of frame pairs.
    pub n: usize,
    /// The adapter's estimate with the mean training motion μ, as `EstimateMotion` returns it.
    /// This and the next two are `None` without an adapter.
    pub ours: Option<LocalizationErrors>,
    /// The adapter's estimate without μ, as trackers use it.
    pub without_mean: Option<LocalizationErrors>,
    /// The constant baseline, which always predicts μ.
    pub constant: Option<LocalizationErrors>,
    /// Errors of the two-view estimator, if feature maps were given.
    pub two_view: Option<TwoViewErrors>,
    /// Errors of the zero-motion baseline.
    pub no_motion: LocalizationErrors,
}

/// The errors of a two-view estimator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TwoViewErrors {
    /// Errors over all pairs; pairs without an estimate count as zero motion.
    #[serde(flatten)]
    pub ours: LocalizationErrors,
    /// Fraction of pairs with an estimate.
    pub answered: f64,
    /// Coverage of its covariances, over the pairs with an estimate.
    #[serde(flatten)]
    pub coverage: Coverage,
}

/// The feature maps of a room's frames, for a two-view estimator.
#[derive(Debug, Clone, Copy)]
pub struct Maps<'a> {
    /// One flattened map per row, in the order (channels, rows, columns).
    pub features: &'a Features,
    /// Channels, rows and columns of a map; their product is the feature width.
    pub shape: [usize; 3],
    /// The camera that took the images.
    pub camera: CameraIntrinsics,
}

/// Estimates the motion between the frames of every pair. `on_pair_read` is called after each pair
/// of the two-view estimator.
///
/// # Errors
/// [`Error::Adapter`] when the features do not match the adapter, [`Error::TwoView`] when the maps
/// are too small.
pub fn evaluate(
    room: &Room,
    adapter: Option<(&Adapter, &Features)>,
    maps: Option<Maps<'_>>,
    pairs: &[Pair],
    on_pair_read: &(dyn Fn() + Sync),
) -> Result<MotionEvaluation, Error> {
    let truth = motions(room.poses(), pairs);
    let [ours, without_mean, constant] = match adapter {
        Some((adapter, features)) => by_adapter(adapter, features, pairs, &truth)?.map(Some),
        None => [None; 3],
    };

    Ok(MotionEvaluation {
        n: pairs.len(),
        ours,
        without_mean,
        constant,
        two_view: maps
            .map(|maps| by_two_views(maps, pairs, &truth, on_pair_read))
            .transpose()?,
        no_motion: errors(&truth, &vec![Twist::default(); truth.len()]),
    })
}

/// Errors of the adapter's estimates, of those without μ, and of μ alone.
fn by_adapter(
    adapter: &Adapter,
    features: &Features,
    pairs: &[Pair],
    truth: &[Twist],
) -> Result<[LocalizationErrors; 3], Error> {
    adapter.check_source(features.source())?;
    let latents = adapter.embed(features.rows())?;
    let ends = |pair: &Pair| [pair.source, pair.target].map(|frame| latents.row(frame.row()));
    let read = |of: &dyn Fn(&Pair) -> Twist| {
        let read: Vec<Twist> = pairs.iter().map(of).collect();
        errors(truth, &read)
    };

    let mean = Twist::from_vector(&adapter.scale().mean);
    Ok([
        read(&|pair| {
            let [from, to] = ends(pair);
            adapter.motion(from, to)
        }),
        read(&|pair| {
            let [from, to] = ends(pair);
            adapter.motion_without_mean(from, to)
        }),
        read(&|_| mean),
    ])
}

fn by_two_views(
    maps: Maps<'_>,
    pairs: &[Pair],
    truth: &[Twist],
    on_pair_read: &(dyn Fn() + Sync),
) -> Result<TwoViewErrors, Error> {
    let rows = maps.features.rows();
    let map = |row: usize| {
        let numbers = rows.row(row).to_slice().unwrap_or_default();
        ArrayView3::from_shape(maps.shape, numbers).map_err(|_| two_view::Error::Shape {
            first: maps.shape,
            second: maps.shape,
        })
    };
    let readings: Vec<two_view::MotionEstimate> = pairs
        .par_iter()
        .map(|pair| {
            let first = map(pair.source.row())?;
            let second = map(pair.target.row())?;
            let reading = two_view::read(first, second, &maps.camera);
            on_pair_read();

            reading
        })
        .collect::<Result<_, _>>()?;

    let read: Vec<Twist> = readings
        .iter()
        .map(two_view::MotionEstimate::twist)
        .collect();
    let lengths: Vec<f64> = readings
        .iter()
        .zip(truth)
        .filter(|(reading, _)| reading.is_estimated)
        .filter_map(|(reading, truth)| {
            let off = log(&reading.motion.inv_mul(&exp(truth))).to_vector();
            Some(off.dot(&Cholesky::new(reading.covariance)?.solve(&off)))
        })
        .collect();
    let answered = readings
        .iter()
        .filter(|reading| reading.is_estimated)
        .count();

    Ok(TwoViewErrors {
        ours: errors(truth, &read),
        answered: answered as f64 / readings.len() as f64,
        coverage: coverage(&lengths),
    })
}

fn errors(truth: &[Twist], read: &[Twist]) -> LocalizationErrors {
    let error = |(truth, read): (&Twist, &Twist)| {
        let apart = exp(read).inv_mul(&exp(truth));
        PoseError {
            translation_m: apart.translation.vector.norm(),
            rotation_rad: apart.rotation.angle(),
        }
    };

    let errors: Vec<PoseError> = truth.iter().zip(read).map(error).collect();
    LocalizationErrors::of(&errors)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand: for a true motion of 3 m and 4 m along two axes, zero motion is 5 m off.
    #[test]
    fn no_motion_is_off_by_the_motion_itself() {
        let truth = Twist {
            linear: [3.0, 0.0, 4.0].into(),
            angular: [0.0; 3].into(),
        };
        let found = errors(&[truth], &[Twist::default()]);

        assert!((found.translation_m.median.median - 5.0).abs() < 1e-12);
        assert!(found.rotation_deg.median.median.abs() < 1e-12);
    }
}

//! Evaluates motion estimates between two views of a room: by an adapter, by a two-view estimator,
//! and by simple baselines.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::adapter::{Adapter, MotionReading};
use seese3_core::features::Features;
use seese3_core::geometry::{CameraIntrinsics, PoseError, Twist, exp, log};
use seese3_core::keypoints::Keypoints;
use seese3_core::nalgebra::Cholesky;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::Pair;
use seese3_core::statistics::{Coverage, RecordedMedian, coverage, median_of_recording};
use seese3_core::training::motions;
use seese3_robot::matched_views::ViewKeypoints;
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
    /// The adapter's estimate without μ, as retrieval uses it.
    pub without_mean: Option<LocalizationErrors>,
    /// The constant baseline, which always predicts μ.
    pub constant: Option<LocalizationErrors>,
    /// Errors of the adapter's relational reader, if it has one.
    pub relational: Option<RelationalErrors>,
    /// Errors of the two-view estimator, if keypoints were given.
    pub two_view: Option<TwoViewErrors>,
    /// Errors of the zero-motion baseline.
    pub no_motion: LocalizationErrors,
    /// Absolute errors of the zero-motion baseline by component of (v, ω), meters and radians: the
    /// sizes of the motions.
    pub no_motion_components: [RecordedMedian; 6],
}

/// The errors of a relational reader.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RelationalErrors {
    /// Errors over all pairs.
    #[serde(flatten)]
    pub ours: LocalizationErrors,
    /// Absolute errors by component of (v, ω), meters and radians.
    pub components: [RecordedMedian; 6],
    /// Coverage of its covariances; `None` if the reader is not calibrated.
    pub coverage: Option<Coverage>,
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

/// The keypoints of a room's frames, for the two-view estimator.
#[derive(Debug, Clone, Copy)]
pub struct FrameKeypoints<'a> {
    /// One per row.
    pub keypoints: &'a [Keypoints],
    /// The camera that took the images.
    pub camera: CameraIntrinsics,
}

/// Estimates the motion between the frames of every pair. `on_pair_read` is called after each pair
/// of the two-view estimator.
///
/// # Errors
/// [`Error::Adapter`] when the features do not match the adapter.
pub fn evaluate(
    room: &Room,
    adapter: Option<(&Adapter, &Features)>,
    views: Option<FrameKeypoints<'_>>,
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
        relational: match adapter {
            Some((adapter, features)) => by_reader(adapter, features, pairs, &truth)?,
            None => None,
        },
        two_view: views.map(|views| by_two_views(views, pairs, &truth, on_pair_read)),
        no_motion: errors(&truth, &vec![Twist::default(); truth.len()]),
        no_motion_components: by_component(&truth, &vec![Twist::default(); truth.len()]),
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

/// Errors of the adapter's relational reader; `None` without one.
fn by_reader(
    adapter: &Adapter,
    features: &Features,
    pairs: &[Pair],
    truth: &[Twist],
) -> Result<Option<RelationalErrors>, Error> {
    let Some(reader) = adapter.relational() else {
        return Ok(None);
    };

    let cells = reader.cells(features.rows())?;
    let readings: Vec<MotionReading> = pairs
        .par_iter()
        .map(|pair| {
            let target = cells.select(&[pair.target.row()]);
            reader.motions(&cells, pair.source.row(), &target)[0]
        })
        .collect();

    let read: Vec<Twist> = readings.iter().map(|reading| reading.twist).collect();
    let lengths: Vec<f64> = readings
        .iter()
        .zip(truth)
        .filter_map(|(reading, truth)| {
            let off = truth.to_vector() - reading.twist.to_vector();
            Some(off.dot(&Cholesky::new(reading.covariance)?.solve(&off)))
        })
        .collect();

    Ok(Some(RelationalErrors {
        ours: errors(truth, &read),
        components: by_component(truth, &read),
        coverage: reader.error_scale().map(|_| coverage(&lengths)),
    }))
}

/// Absolute errors of twists by component, with intervals over blocks of the recording.
fn by_component(truth: &[Twist], read: &[Twist]) -> [RecordedMedian; 6] {
    std::array::from_fn(|component| {
        let errors: Vec<f64> = truth
            .iter()
            .zip(read)
            .map(|(truth, read)| (truth.to_vector()[component] - read.to_vector()[component]).abs())
            .collect();
        median_of_recording(&errors, 0)
    })
}

fn by_two_views(
    views: FrameKeypoints<'_>,
    pairs: &[Pair],
    truth: &[Twist],
    on_pair_read: &(dyn Fn() + Sync),
) -> TwoViewErrors {
    let view = |frame: FrameId| ViewKeypoints {
        keypoints: &views.keypoints[frame.row()],
        camera: &views.camera,
    };
    let readings: Vec<two_view::MotionEstimate> = pairs
        .par_iter()
        .map(|pair| {
            let reading = two_view::estimate(view(pair.source), view(pair.target));
            on_pair_read();
            reading
        })
        .collect();

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

    TwoViewErrors {
        ours: errors(truth, &read),
        answered: answered as f64 / readings.len() as f64,
        coverage: coverage(&lengths),
    }
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

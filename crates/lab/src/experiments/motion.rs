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
use seese3_core::statistics::{
    Blocks, Coverage, Extent, MeanInterval, RecordedMedian, coverage, median_of_recording,
};
use seese3_core::training::motions;
use seese3_robot::matched_views::ViewKeypoints;
use seese3_robot::two_view;

use super::localization::LocalizationErrors;
use super::{Error, EstimateError};

/// The results in one room. Errors are those of the poses at the end of the motions.
#[derive(Debug, Clone, PartialEq, Serialize)]
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
    /// The errors of every pair, by method.
    #[serde(skip)]
    pub pairs: Vec<EstimateError>,
}

/// The errors of a relational reader.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RelationalErrors {
    /// Errors over all pairs.
    #[serde(flatten)]
    pub ours: LocalizationErrors,
    /// Absolute errors by component of (v, ω), meters and radians.
    pub components: [RecordedMedian; 6],
    /// Mean absolute error minus that of no motion, by component, paired: below 0 where the reader
    /// is better.
    pub components_over_no_motion: [MeanInterval; 6],
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
    let mut scoring = Scoring {
        pairs,
        truth: motions(room.poses(), pairs),
        errors: Vec::new(),
    };
    let [ours, without_mean, constant] = match adapter {
        Some((adapter, features)) => scoring.by_adapter(adapter, features)?.map(Some),
        None => [None; 3],
    };
    let relational = match adapter {
        Some((adapter, features)) => scoring.by_reader(adapter, features)?,
        None => None,
    };
    let two_view = views.map(|views| scoring.by_two_views(views, on_pair_read));
    let still = vec![Twist::default(); pairs.len()];

    Ok(MotionEvaluation {
        n: pairs.len(),
        ours,
        without_mean,
        constant,
        relational,
        two_view,
        no_motion: scoring.add("no_motion", &still, None),
        no_motion_components: scoring.by_component(&still),
        pairs: scoring.errors,
    })
}

/// Scores estimates of the motions of pairs, and keeps their errors.
struct Scoring<'a> {
    pairs: &'a [Pair],
    /// The true motions.
    truth: Vec<Twist>,
    /// The errors of all methods so far.
    errors: Vec<EstimateError>,
}

impl Scoring<'_> {
    /// Errors of the adapter's estimates, of those without μ, and of μ alone.
    fn by_adapter(
        &mut self,
        adapter: &Adapter,
        features: &Features,
    ) -> Result<[LocalizationErrors; 3], Error> {
        adapter.check_source(features.source())?;
        let latents = adapter.embed(features.rows())?;
        let ends = |pair: &Pair| [pair.source, pair.target].map(|frame| latents.row(frame.row()));
        let mean = Twist::from_vector(&adapter.scale().mean);

        let mut read = |method, of: &dyn Fn(&Pair) -> Twist| {
            let read: Vec<Twist> = self.pairs.iter().map(of).collect();
            self.add(method, &read, None)
        };
        Ok([
            read("ours", &|pair| {
                let [from, to] = ends(pair);
                adapter.motion(from, to)
            }),
            read("without_mean", &|pair| {
                let [from, to] = ends(pair);
                adapter.motion_without_mean(from, to)
            }),
            read("constant", &|_| mean),
        ])
    }

    /// Errors of the adapter's relational reader; `None` without one.
    fn by_reader(
        &mut self,
        adapter: &Adapter,
        features: &Features,
    ) -> Result<Option<RelationalErrors>, Error> {
        let Some(reader) = adapter.relational() else {
            return Ok(None);
        };

        let cells = reader.cells(features.rows())?;
        let readings: Vec<MotionReading> = self
            .pairs
            .par_iter()
            .map(|pair| {
                let target = cells.select(&[pair.target.row()]);
                reader.motions(&cells, pair.source.row(), &target)[0]
            })
            .collect();

        let read: Vec<Twist> = readings.iter().map(|reading| reading.twist).collect();
        let lengths: Vec<f64> = readings
            .iter()
            .zip(&self.truth)
            .map(|(reading, truth)| {
                let off = truth.to_vector() - reading.twist.to_vector();
                let cholesky = Cholesky::new(reading.covariance);
                cholesky.map_or(f64::NAN, |cholesky| off.dot(&cholesky.solve(&off)))
            })
            .collect();
        let known: Vec<f64> = lengths.iter().copied().filter(|x| !x.is_nan()).collect();

        Ok(Some(RelationalErrors {
            ours: self.add("relational", &read, Some(&lengths)),
            components: self.by_component(&read),
            components_over_no_motion: self.over_no_motion(&read),
            coverage: reader.error_scale().map(|_| coverage(&known)),
        }))
    }

    fn by_two_views(
        &mut self,
        views: FrameKeypoints<'_>,
        on_pair_read: &(dyn Fn() + Sync),
    ) -> TwoViewErrors {
        let view = |frame: FrameId| ViewKeypoints {
            keypoints: &views.keypoints[frame.row()],
            camera: &views.camera,
        };
        let readings: Vec<two_view::MotionEstimate> = self
            .pairs
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
            .zip(&self.truth)
            .map(|(reading, truth)| {
                let off = log(&reading.motion.inv_mul(&exp(truth))).to_vector();
                let cholesky = Cholesky::new(reading.covariance).filter(|_| reading.is_estimated);
                cholesky.map_or(f64::NAN, |cholesky| off.dot(&cholesky.solve(&off)))
            })
            .collect();
        let known: Vec<f64> = lengths.iter().copied().filter(|x| !x.is_nan()).collect();
        let answered = readings
            .iter()
            .filter(|reading| reading.is_estimated)
            .count();

        TwoViewErrors {
            ours: self.add("two_view", &read, Some(&lengths)),
            answered: answered as f64 / readings.len() as f64,
            coverage: coverage(&known),
        }
    }

    /// Scores and keeps the errors of a method's estimates, one per pair, with the squared
    /// Mahalanobis lengths of its errors if it states covariances.
    fn add(
        &mut self,
        method: &'static str,
        read: &[Twist],
        squared_lengths: Option<&[f64]>,
    ) -> LocalizationErrors {
        let errors = pose_errors(&self.truth, read);
        for (place, (pair, error)) in self.pairs.iter().zip(&errors).enumerate() {
            self.errors.push(EstimateError {
                method,
                source: Some(pair.source),
                target: pair.target,
                error: Some(*error),
                squared_length: squared_lengths.map_or(f64::NAN, |lengths| lengths[place]),
            });
        }
        LocalizationErrors::of(&errors)
    }

    /// Absolute errors of twists by component, with intervals over blocks of the recording.
    fn by_component(&self, read: &[Twist]) -> [RecordedMedian; 6] {
        std::array::from_fn(|component| {
            let errors: Vec<f64> = (0..read.len())
                .map(|place| self.component_error(read, place, component))
                .collect();
            median_of_recording(&errors, 0)
        })
    }

    /// Mean absolute errors by component, minus those of no motion.
    fn over_no_motion(&self, read: &[Twist]) -> [MeanInterval; 6] {
        let extent = |pair: &Pair| Extent {
            start: pair.source.0.min(pair.target.0),
            length: pair.source.0.abs_diff(pair.target.0),
        };
        let blocks = Blocks::of(&self.pairs.iter().map(extent).collect::<Vec<_>>());
        std::array::from_fn(|component| {
            blocks.mean(|place| {
                let size = self.truth[place].to_vector()[component].abs();
                self.component_error(read, place, component) - size
            })
        })
    }

    fn component_error(&self, read: &[Twist], place: usize, component: usize) -> f64 {
        let [truth, read] = [self.truth[place], read[place]].map(|twist| twist.to_vector());
        (truth[component] - read[component]).abs()
    }
}

/// Errors of the poses at the ends of the motions.
fn pose_errors(truth: &[Twist], read: &[Twist]) -> Vec<PoseError> {
    let error = |(truth, read): (&Twist, &Twist)| {
        let apart = exp(read).inv_mul(&exp(truth));
        PoseError {
            translation_m: apart.translation.vector.norm(),
            rotation_rad: apart.rotation.angle(),
        }
    };
    truth.iter().zip(read).map(error).collect()
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
        let found = pose_errors(&[truth], &[Twist::default()])[0];

        assert!((found.translation_m - 5.0).abs() < 1e-12);
        assert!(found.rotation_rad.abs() < 1e-12);
    }
}

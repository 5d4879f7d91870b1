//! Fits the parameters of a filter to recordings with known poses.

use rayon::prelude::*;
use serde::Serialize;

use super::tracked_room::{RecordedStream, TrackedRoom};
use super::tracking_scores::is_wrong;
use crate::json;
use seese3_core::geometry::PoseError;
use seese3_core::nalgebra::{Matrix6, Vector6};
use seese3_core::statistics::root_mean_square;
use seese3_robot::pose_filter::FilterParameters;
use seese3_robot::tracking::Status;

/// Factors that are tried on each parameter.
const FACTORS: [f64; 4] = [0.5, 0.7, 1.4, 2.0];
/// Rounds over all parameters.
const ROUNDS: usize = 3;
/// Largest change of a parameter, as a factor.
const MOST_CHANGE: f64 = 16.0;
/// Least gain of log density per frame for which a parameter changes.
const LEAST_GAIN: f64 = 1e-3;
/// Squared Mahalanobis length above which an error counts no further: it is an outlier.
const MOST_SURPRISE: f64 = 40.0;
/// Standard deviation of the rotation of an unknown pose, radians.
const UNKNOWN_RAD: f64 = 1.0;

/// A parameter that is fitted, as a factor on its value. Factors on a correlated share are on the
/// rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::Display, strum::VariantArray)]
#[strum(serialize_all = "snake_case")]
enum Tuned {
    CorrelatedShare,
    CorrelationRange,
    ProcessNoiseFactor,
    VisualNoise,
    VisualDesignEffect,
    VisualScaleTimeS,
}

/// How well a filter's map poses agree with the truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseScores {
    /// Mean logarithm of the density of the true pose, up to a constant. Errors beyond a squared
    /// Mahalanobis length of 40 count as 40; an unknown pose counts as one that is as uncertain as
    /// the room is wide.
    pub log_density: f64,
    /// Root mean square of the position errors, meters.
    pub fused_m: f64,
    /// Fraction of TRACKING frames.
    pub tracking: f64,
    /// Fraction of wrong poses among them.
    pub tracking_wrong: f64,
    /// Fractions of TRACKING poses inside the 68 % and the 95 % ellipsoid.
    pub coverage: [f64; 2],
}

/// Fitted parameters.
#[derive(Debug, Clone, Serialize)]
pub struct TrackingFit {
    /// All parameters of the filter.
    pub parameters: FilterParameters,
    /// Factors on the parameters that were fitted.
    pub factors: Vec<(String, f64)>,
    /// Scores with the given parameters.
    pub before: PoseScores,
    /// Scores with the fitted ones.
    pub after: PoseScores,
}

/// The streams of a room as the front end reads them.
pub struct RecordedRoom<'a> {
    room: &'a TrackedRoom<'a>,
    streams: Vec<RecordedStream>,
}

impl<'a> RecordedRoom<'a> {
    /// Reads the tracked frames of a room.
    pub fn of(room: &'a TrackedRoom<'a>) -> Self {
        Self {
            room,
            streams: room.recorded(),
        }
    }
}

impl Tuned {
    /// The parameters with this one multiplied by a factor.
    fn scaled(self, from: &FilterParameters, factor: f64) -> FilterParameters {
        let mut to = *from;
        match self {
            Self::CorrelatedShare => {
                to.correlated_share = 1.0 - (1.0 - from.correlated_share) * factor;
            }
            Self::CorrelationRange => {
                to.correlation_range *= factor;
            }
            Self::ProcessNoiseFactor => to.process_noise_factor *= factor,
            Self::VisualNoise => {
                let noise = &mut to.visual_noise;
                noise.at_rest *= factor;
                noise.over_motion *= factor;
                noise.rotation_over_meter *= factor;
            }
            Self::VisualDesignEffect => to.visual_design_effect *= factor,
            Self::VisualScaleTimeS => to.visual_scale_time_s *= factor,
        }
        to
    }
}

/// Scores of a filter with these parameters over all streams of some rooms.
pub fn scores(rooms: &[RecordedRoom<'_>], parameters: &FilterParameters) -> PoseScores {
    let streams: Vec<(&TrackedRoom<'_>, &RecordedStream)> = rooms
        .iter()
        .flat_map(|room| room.streams.iter().map(|stream| (room.room, stream)))
        .collect();
    let frames: Vec<FrameScore> = streams
        .into_par_iter()
        .flat_map_iter(|(room, stream)| frame_scores(room, stream, parameters))
        .collect();

    let count = frames.len().max(1) as f64;
    let tracking: Vec<&FrameScore> = frames.iter().filter(|frame| frame.is_tracking).collect();
    let wrong = tracking.iter().filter(|frame| frame.is_wrong).count();
    let surprises: Vec<f64> = tracking.iter().map(|frame| frame.surprise).collect();
    let errors: Vec<f64> = frames.iter().filter_map(|frame| frame.error_m).collect();
    PoseScores {
        log_density: frames.iter().map(|frame| frame.log_density).sum::<f64>() / count,
        fused_m: root_mean_square(&errors),
        tracking: tracking.len() as f64 / count,
        tracking_wrong: wrong as f64 / tracking.len().max(1) as f64,
        coverage: json::covered(&surprises),
    }
}

struct FrameScore {
    log_density: f64,
    error_m: Option<f64>,
    surprise: f64,
    is_tracking: bool,
    is_wrong: bool,
}

fn frame_scores(
    room: &TrackedRoom<'_>,
    stream: &RecordedStream,
    parameters: &FilterParameters,
) -> Vec<FrameScore> {
    let filter = room.filter().with_parameters(*parameters);
    let mut state = filter.start(stream.start.as_ref());
    let variance = room.extent_m().powi(2).max(1.0);
    let unknown = Matrix6::from_diagonal(&Vector6::new(
        variance,
        variance,
        variance,
        UNKNOWN_RAD,
        UNKNOWN_RAD,
        UNKNOWN_RAD,
    ));
    let density = |surprise: f64, covariance: &Matrix6<f64>| {
        -0.5 * (surprise.min(MOST_SURPRISE) + covariance.determinant().ln())
    };

    let frames = stream.frames.iter().filter_map(|(observation, truth)| {
        let update = filter.observe(&mut state, observation).ok()?;
        let known = update
            .map_pose
            .and_then(|pose| Some((pose, pose.squared_error(truth)?)));
        let is_tracking = update.status == Status::Tracking;
        Some(match known {
            Some((pose, surprise)) => FrameScore {
                log_density: density(surprise, &pose.covariance).max(density(6.0, &unknown)),
                error_m: Some(PoseError::between(&pose.pose, truth).translation_m),
                surprise,
                is_tracking,
                is_wrong: is_wrong(&pose.pose, truth),
            },
            None => FrameScore {
                log_density: density(6.0, &unknown),
                error_m: None,
                surprise: f64::INFINITY,
                is_tracking,
                is_wrong: false,
            },
        })
    });
    frames.collect()
}

/// Fits the parameters to some rooms, one after the other, from the given ones. `tried` is called
/// after each trial.
pub fn fit(rooms: &[RecordedRoom<'_>], from: &FilterParameters, tried: &dyn Fn()) -> TrackingFit {
    let all = <Tuned as strum::VariantArray>::VARIANTS;
    let mut factors = vec![1.0; all.len()];
    let mut parameters = *from;
    let before = scores(rooms, from);
    let mut after = before;
    for _ in 0..ROUNDS {
        for (tuned, total) in all.iter().zip(&mut factors) {
            for factor in FACTORS {
                let range = MOST_CHANGE.recip()..=MOST_CHANGE;
                let is_allowed = range.contains(&(*total * factor));
                let candidate = tuned.scaled(&parameters, factor);
                if is_allowed && candidate.check().is_ok() {
                    let found = scores(rooms, &candidate);
                    if found.log_density > after.log_density + LEAST_GAIN {
                        parameters = candidate;
                        after = found;
                        *total *= factor;
                    }
                }
                tried();
            }
        }
    }

    TrackingFit {
        parameters,
        factors: all.iter().map(ToString::to_string).zip(factors).collect(),
        before,
        after,
    }
}

/// Number of trials of [`fit`].
pub fn trial_count() -> usize {
    ROUNDS * FACTORS.len() * <Tuned as strum::VariantArray>::VARIANTS.len()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use serde_json::Value;

    use super::*;

    /// Calls `visit` with the path of each number of a JSON value, as errors name it, and a copy of
    /// the whole with that number replaced.
    fn with_each(
        whole: &Value,
        at: &Value,
        path: &str,
        pointer: &str,
        visit: &mut dyn FnMut(&str, Value),
    ) {
        match at {
            Value::Object(fields) => {
                for (name, field) in fields {
                    let inner = if path.is_empty() {
                        name.clone()
                    } else {
                        format!("{path}.{name}")
                    };
                    with_each(whole, field, &inner, &format!("{pointer}/{name}"), visit);
                }
            }
            Value::Array(values) => {
                for (number, value) in values.iter().enumerate() {
                    let inner = format!("{path}[{number}]");
                    with_each(whole, value, &inner, &format!("{pointer}/{number}"), visit);
                }
            }
            _ => {
                let mut changed = whole.clone();
                *changed.pointer_mut(pointer).unwrap() = Value::from(1e300);
                visit(path, changed);
            }
        }
    }

    /// Oracle: the filter has 24 constants. None may be 1e300, and the error names it. Counts are
    /// refused by their type.
    #[test]
    fn every_parameter_has_a_range() {
        let whole = serde_json::to_value(FilterParameters::default()).unwrap();
        let mut count = 0;
        with_each(&whole, &whole, "", "", &mut |path, changed| {
            count += 1;
            match serde_json::from_value::<FilterParameters>(changed) {
                Ok(parameters) => assert_eq!(parameters.check().unwrap_err().field, path),
                Err(error) => assert!(error.to_string().contains("u32"), "{path}: {error}"),
            }
        });
        assert_eq!(count, 24);
        assert_eq!(FilterParameters::default().check(), Ok(()));
    }
}

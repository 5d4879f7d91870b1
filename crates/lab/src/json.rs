//! Shapes of core results in JSON records, for `serialize_with`. Keys are stable; undefined values
//! are null.

use serde::{Serialize, Serializer};

use seese3_core::eval::Baselines;
use seese3_core::motion_scores::MotionScores;
use seese3_core::statistics::{coverage, deviation, mean, median};

/// Serializes a value as a `J`.
pub fn shaped<'a, J, T, S>(value: &'a T, to: S) -> Result<S::Ok, S::Error>
where
    J: From<&'a T> + Serialize,
    S: Serializer,
{
    J::from(value).serialize(to)
}

/// Serializes every value of a list as a `J`.
pub fn each<'a, J, T, S>(values: &'a [T], to: S) -> Result<S::Ok, S::Error>
where
    J: From<&'a T> + Serialize,
    S: Serializer,
{
    to.collect_seq(values.iter().map(J::from))
}

/// Serializes a value as its text.
pub fn shown<T: ToString, S: Serializer>(value: &T, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&value.to_string())
}

/// Serializes baselines, if there are any.
pub fn baselines<S: Serializer>(found: &Option<Baselines>, to: S) -> Result<S::Ok, S::Error> {
    found.as_ref().map(BaselinesJson::from).serialize(to)
}

/// Serializes the coverage of errors with these squared Mahalanobis lengths, by confidence.
pub fn coverages<S: Serializer>(squared_lengths: &[f64], to: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Coverages {
        #[serde(rename = "68")]
        within_68: f64,
        #[serde(rename = "95")]
        within_95: f64,
    }

    let [within_68, within_95] = covered(squared_lengths);
    Coverages {
        within_68,
        within_95,
    }
    .serialize(to)
}

/// Fractions of errors inside the 68 % and the 95 % ellipsoid.
pub fn covered(squared_lengths: &[f64]) -> [f64; 2] {
    let found = coverage(squared_lengths);
    [found.within_68, found.within_95]
}

/// The scores of predicted motions.
#[derive(Serialize)]
pub struct MotionJson {
    n: usize,
    r2: R2Json,
    direction_pairs_dropped: usize,
}

/// R² by component and part of the motion.
#[derive(Serialize)]
struct R2Json {
    components: [f64; 6],
    overall: f64,
    translation: f64,
    rotation: f64,
    direction: f64,
    magnitude: f64,
}

impl From<&MotionScores> for MotionJson {
    fn from(scores: &MotionScores) -> Self {
        Self {
            n: scores.n,
            r2: R2Json {
                components: scores.components,
                overall: scores.overall,
                translation: scores.translation,
                rotation: scores.rotation,
                direction: scores.direction,
                magnitude: scores.magnitude,
            },
            direction_pairs_dropped: scores.direction_pairs_dropped,
        }
    }
}

/// R² by part of the motion, over several runs.
#[derive(Debug, Clone, Serialize)]
pub struct PartsJson {
    overall: SpreadJson,
    translation: SpreadJson,
    rotation: SpreadJson,
    direction: SpreadJson,
    magnitude: SpreadJson,
}

/// A mean and a sample standard deviation over the runs in which a value is defined.
#[derive(Debug, Clone, Serialize)]
struct SpreadJson {
    mean: f64,
    sd: f64,
}

impl From<&Vec<MotionScores>> for PartsJson {
    fn from(runs: &Vec<MotionScores>) -> Self {
        let spread = |part: fn(&MotionScores) -> f64| {
            let values: Vec<f64> = runs
                .iter()
                .map(part)
                .filter(|value| !value.is_nan())
                .collect();
            SpreadJson {
                mean: mean(&values),
                sd: deviation(&values),
            }
        };

        Self {
            overall: spread(|run| run.overall),
            translation: spread(|run| run.translation),
            rotation: spread(|run| run.rotation),
            direction: spread(|run| run.direction),
            magnitude: spread(|run| run.magnitude),
        }
    }
}

/// Baselines to compare an R² with.
#[derive(Serialize)]
pub struct BaselinesJson {
    constant_r2: f64,
    variance_ratio: f64,
    nearest_pose: Option<NearestPoseJson>,
    optimizer_steps: u64,
    /// False if the constant's R² is so far below zero that the recording cannot rate an adapter.
    can_tell: bool,
}

/// Median distance and angle from the test frames to the nearest training poses.
#[derive(Serialize)]
struct NearestPoseJson {
    m: f64,
    deg: f64,
}

impl From<&Baselines> for BaselinesJson {
    fn from(baselines: &Baselines) -> Self {
        Self {
            constant_r2: baselines.constant_r2,
            variance_ratio: baselines.variance_ratio,
            nearest_pose: baselines.nearest_pose.map(|nearest| NearestPoseJson {
                m: nearest.translation_m,
                deg: nearest.rotation_rad.to_degrees(),
            }),
            optimizer_steps: baselines.optimizer_steps,
            can_tell: baselines.can_tell(),
        }
    }
}

/// Medians over the held-out rooms of one adapter; `None` without rooms.
pub fn median_baselines<'a>(
    rooms: impl Iterator<Item = &'a Baselines> + Clone,
) -> Option<Baselines> {
    let first = *rooms.clone().next()?;
    let middle = |of: fn(&Baselines) -> f64| median(&rooms.clone().map(of).collect::<Vec<_>>());

    Some(Baselines {
        constant_r2: middle(|room| room.constant_r2),
        variance_ratio: middle(|room| room.variance_ratio),
        ..first
    })
}

//! Absolute and relative pose errors.

use nalgebra::Matrix4;
use strum::{Display, IntoStaticStr, VariantArray};

use super::{Error, Trajectory};
use crate::geometry::{Pose, PoseError};
use crate::statistics::{mean, median};

/// Measure of a pose error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Relation {
    /// The distance, meters.
    Translation,
    /// The angle, radians.
    Rotation,
    /// The Frobenius norm of the matrix E − I, which mixes meters and rotation.
    Full,
}

impl Relation {
    /// The measure of a pose error E.
    fn of(self, error: &Pose) -> f64 {
        let parts = PoseError::between(&Pose::identity(), error);
        match self {
            Self::Translation => parts.translation_m,
            Self::Rotation => parts.rotation_rad,
            Self::Full => (error.to_homogeneous() - Matrix4::identity()).norm(),
        }
    }
}

/// Pairs of poses for relative errors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RpePairs {
    /// Consecutive intervals: 0 to Δ, Δ to 2Δ, ...
    Consecutive,
    /// All pairs of poses that are Δ apart.
    All,
}

/// Absolute pose errors (APE), one per pose: E = est⁻¹ ref, both `world_from_camera`.
///
/// # Errors
/// [`Error::Unequal`] when the lengths differ.
///
/// Source: evo's `APE`.
pub fn ape(
    reference: &Trajectory,
    estimate: &Trajectory,
    relation: Relation,
) -> Result<Vec<f64>, Error> {
    check(reference, estimate)?;
    let pairs = estimate.poses.iter().zip(&reference.poses);

    Ok(pairs
        .map(|(ours, truth)| relation.of(&ours.inv_mul(truth)))
        .collect())
}

/// Relative pose errors (RPE): E = (ref_i⁻¹ ref_j)⁻¹ (est_i⁻¹ est_j) with j = i + Δ, Δ = `delta`
/// poses.
///
/// # Errors
/// [`Error::Unequal`] when the lengths differ; [`Error::NoPairs`] when `delta` is 0 or not below
/// the number of poses.
///
/// Source: evo's `RPE`.
pub fn rpe(
    reference: &Trajectory,
    estimate: &Trajectory,
    relation: Relation,
    delta: usize,
    pairs: RpePairs,
) -> Result<Vec<f64>, Error> {
    check(reference, estimate)?;
    let have = reference.len();
    if delta == 0 || delta >= have {
        return Err(Error::NoPairs { have, delta });
    }

    let step = match pairs {
        RpePairs::Consecutive => delta,
        RpePairs::All => 1,
    };

    let error = |i: usize| {
        let motion = |path: &Trajectory| path.poses[i].inv_mul(&path.poses[i + delta]);
        relation.of(&motion(reference).inv_mul(&motion(estimate)))
    };

    Ok((0..have - delta).step_by(step).map(error).collect())
}

fn check(reference: &Trajectory, estimate: &Trajectory) -> Result<(), Error> {
    match reference.len() == estimate.len() {
        true => Ok(()),
        false => Err(Error::Unequal {
            reference: reference.len(),
            estimate: estimate.len(),
        }),
    }
}

/// Summary statistics of errors, in the errors' unit.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Statistics {
    /// The root mean square.
    pub rmse: f64,
    /// The mean.
    pub mean: f64,
    /// The median.
    pub median: f64,
    /// The population standard deviation.
    #[cfg_attr(feature = "serde", serde(rename = "std"))]
    pub deviation: f64,
    /// The smallest.
    #[cfg_attr(feature = "serde", serde(rename = "min"))]
    pub least: f64,
    /// The largest.
    #[cfg_attr(feature = "serde", serde(rename = "max"))]
    pub largest: f64,
    /// The sum of squares.
    #[cfg_attr(feature = "serde", serde(rename = "sse"))]
    pub sum_of_squares: f64,
    /// The number of errors.
    #[cfg_attr(feature = "serde", serde(rename = "n"))]
    pub count: usize,
}

impl Statistics {
    /// Statistics of `errors`. For an empty slice, the count and the sum of squares are 0 and all
    /// others NaN.
    pub fn of(errors: &[f64]) -> Self {
        let count = errors.len();
        let sum_of_squares = errors.iter().map(|x| x * x).sum::<f64>();
        let middle = mean(errors);
        let variance = errors
            .iter()
            .map(|x| (x - middle) * (x - middle))
            .sum::<f64>()
            / count as f64;

        // For an empty slice the extremes would be ±∞; adding NaN makes them NaN.
        let none = if count == 0 { f64::NAN } else { 0.0 };
        Self {
            rmse: (sum_of_squares / count as f64).sqrt(),
            mean: middle,
            median: median(errors),
            deviation: variance.sqrt(),
            least: none + errors.iter().copied().fold(f64::INFINITY, f64::min),
            largest: none + errors.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            sum_of_squares,
            count,
        }
    }
}

//! Absolute and relative pose errors.

use nalgebra::Matrix4;

use super::{Error, Trajectory};
use crate::geometry::{Pose, PoseError};
use crate::scores::{mean, median};

/// What of an error is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Relation {
    /// Metres.
    Translation,
    /// Radians.
    Rotation,
    /// The Frobenius norm of E − I; metres and rotation mixed.
    Full,
}

impl Relation {
    /// Every relation.
    pub const ALL: [Self; 3] = [Self::Translation, Self::Rotation, Self::Full];

    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Translation => "translation",
            Self::Rotation => "rotation",
            Self::Full => "full",
        }
    }

    /// Of an error E.
    fn of(self, error: &Pose) -> f64 {
        let parts = PoseError::between(&Pose::identity(), error);
        match self {
            Self::Translation => parts.translation_m,
            Self::Rotation => parts.rotation_rad,
            Self::Full => (error.to_homogeneous() - Matrix4::identity()).norm(),
        }
    }
}

/// Which pairs a relative error takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RpePairs {
    /// One after the other: 0 and Δ, Δ and 2Δ, ...
    Consecutive,
    /// Every pair Δ apart.
    All,
}

/// The absolute pose errors, one a pose: E = est⁻¹ ref, both `world_from_camera`.
///
/// # Errors
/// [`Error::Unequal`].
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

/// The relative pose errors of motions over `delta` poses: E = (ref_i⁻¹ ref_j)⁻¹ (est_i⁻¹ est_j), j
/// = i + Δ.
///
/// # Errors
/// [`Error::Unequal`], [`Error::NoPairs`].
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

/// What errors come to, in their unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Statistics {
    /// The root of the mean square.
    pub rmse: f64,
    /// The mean.
    pub mean: f64,
    /// The median.
    pub median: f64,
    /// The population deviation.
    pub deviation: f64,
    /// The least.
    pub least: f64,
    /// The largest.
    pub largest: f64,
    /// The sum of squares.
    pub sum_of_squares: f64,
    /// How many.
    pub count: usize,
}

impl Statistics {
    /// Of errors; every figure but the count is NaN of none.
    pub fn of(errors: &[f64]) -> Self {
        let count = errors.len();
        let sum_of_squares = errors.iter().map(|x| x * x).sum::<f64>();
        let middle = mean(errors);
        let variance = errors
            .iter()
            .map(|x| (x - middle) * (x - middle))
            .sum::<f64>()
            / count as f64;

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

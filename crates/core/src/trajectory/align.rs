//! Alignment of an estimated trajectory with the reference.

use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use strum::{Display, IntoStaticStr, VariantArray};

use super::{Error, Trajectory};
use crate::geometry::Pose;

/// Alignment of an estimated trajectory with the reference before the comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Alignment {
    /// None: both trajectories are in the same world frame.
    None,
    /// Makes the first poses equal.
    Origin,
    /// Least-squares rotation and translation of the positions. Orientations are ignored and may
    /// keep a constant offset.
    Se3,
    /// [`Alignment::Se3`] with a scale.
    Sim3,
}

impl Alignment {
    /// The aligned estimate. Both trajectories must be associated: pose i of one belongs to pose i
    /// of the other.
    ///
    /// # Errors
    /// Only for [`Alignment::Se3`] and [`Alignment::Sim3`]: [`Error::Unequal`] when the lengths
    /// differ, [`Error::Degenerate`] when the positions lie on a line.
    pub fn apply(self, reference: &Trajectory, estimate: &Trajectory) -> Result<Trajectory, Error> {
        let similarity = match self {
            Self::None => return Ok(estimate.clone()),
            Self::Origin => {
                let (Some(first), Some(ours)) = (reference.poses.first(), estimate.poses.first())
                else {
                    return Ok(estimate.clone());
                };
                Similarity {
                    scale: 1.0,
                    reference_from_estimate: first * ours.inverse(),
                }
            }
            Self::Se3 | Self::Sim3 => Similarity::umeyama(reference, estimate, self == Self::Sim3)?,
        };

        let poses = estimate
            .poses
            .iter()
            .map(|pose| similarity.pose(pose))
            .collect();

        Ok(Trajectory {
            times_ns: estimate.times_ns.clone(),
            poses,
        })
    }
}

/// A similarity: a scale about the origin, then a rigid motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Scale, dimensionless.
    pub scale: f64,
    /// Maps scaled coordinates of the estimate's world to the reference's.
    pub reference_from_estimate: Pose,
}

impl Similarity {
    /// Least-squares similarity from the positions of the estimate to those of the reference.
    ///
    /// # Errors
    /// [`Error::Unequal`] when the lengths differ; [`Error::Degenerate`] when the positions lie on
    /// a line.
    ///
    /// Source: S. Umeyama, Least-squares estimation of transformation parameters between two point
    /// patterns, 1991.
    pub fn umeyama(
        reference: &Trajectory,
        estimate: &Trajectory,
        with_scale: bool,
    ) -> Result<Self, Error> {
        let count = reference.len();
        if count != estimate.len() {
            return Err(Error::Unequal {
                reference: count,
                estimate: estimate.len(),
            });
        }

        let positions = |path: &Trajectory| {
            path.poses
                .iter()
                .map(|p| p.translation.vector)
                .collect::<Vec<_>>()
        };
        let y = positions(reference);

        let x = positions(estimate);
        let mean =
            |points: &[Vector3<f64>]| points.iter().sum::<Vector3<f64>>() / count.max(1) as f64;
        let y_mean = mean(&y);

        let x_mean = mean(&x);

        // Σ = (1/n) Σᵢ (yᵢ − ȳ)(xᵢ − x̄)ᵀ = U D Vᵀ; the rotation that takes x to y is U S Vᵀ.
        let mut covariance = Matrix3::zeros();
        for (y, x) in y.iter().zip(&x) {
            covariance += (y - y_mean) * (x - x_mean).transpose() / count as f64;
        }

        let svd = covariance.svd(true, true);
        let degenerate = Error::Degenerate { have: count };

        // With a rank below 2, the rotation about the line is undetermined. The tolerance is that
        // of numpy.linalg.matrix_rank, as in evo.
        let least = svd.singular_values.max() * 3.0 * f64::EPSILON;
        if svd
            .singular_values
            .iter()
            .filter(|&&value| value > least)
            .count()
            < 2
        {
            return Err(degenerate);
        }

        let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
            return Err(degenerate);
        };

        // S is the identity. If U Vᵀ is a reflection, the direction of the smallest singular value
        // is flipped.
        let mut signs = Vector3::repeat(1.0);
        if u.determinant() * v_t.determinant() < 0.0 {
            signs[svd.singular_values.imin()] = -1.0;
        }

        let rotation = u * Matrix3::from_diagonal(&signs) * v_t;

        // The least-squares scale is tr(D S) / σ², with σ² the variance of the estimate's
        // positions.
        let variance = x.iter().map(|x| (x - x_mean).norm_squared()).sum::<f64>() / count as f64;
        let scale = if with_scale {
            svd.singular_values.dot(&signs) / variance
        } else {
            1.0
        };

        let turn =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));

        // t = ȳ − s R x̄ takes the centroid of the estimate to that of the reference.
        let shift = y_mean - rotation * x_mean * scale;

        Ok(Self {
            scale,
            reference_from_estimate: Pose::from_parts(Translation3::from(shift), turn),
        })
    }

    /// A pose of the estimate's world in the reference's.
    pub fn pose(&self, pose: &Pose) -> Pose {
        let scaled = Pose::from_parts(
            Translation3::from(pose.translation.vector * self.scale),
            pose.rotation,
        );
        self.reference_from_estimate * scaled
    }
}

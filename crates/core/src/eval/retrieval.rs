//! Scores of retrieved frames against the target frames.

use ndarray::{ArrayView2, Axis};

use crate::geometry::{Pose, PoseError, body_twist};
use crate::room::FrameId;
use crate::splits::Pair;
use crate::statistics::{Rate, mean, median};

/// Joint bounds on translation (meters) and rotation (degrees), as in hloc and ACE.
const POSE_BARS: [(f64, f64); 7] = [
    (0.01, 1.0),
    (0.02, 2.0),
    (0.05, 5.0),
    (0.1, 5.0),
    (0.25, 2.0),
    (0.5, 5.0),
    (5.0, 10.0),
];

/// Fraction of pairs with the retrieved pose within a distance and an angle of the target pose.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct PoseRecall {
    /// Bound on the distance, meters.
    pub translation_m: f64,
    /// Bound on the angle, degrees.
    pub rotation_deg: f64,
    /// Fraction of pairs strictly within both bounds.
    #[cfg_attr(feature = "serde", serde(flatten))]
    pub rate: Rate,
}

/// Scores of retrieved frames against the target frames.
#[derive(Debug, Clone, PartialEq)]
pub struct RetrievalScores {
    /// Fraction of pairs for which the target frame itself was retrieved.
    pub top1: Rate,
    /// Hit@ε: ε and the fraction of pairs with ‖ΔP_target − ΔP_retrieved‖₂ < ε. Both twists start
    /// at the source and are unscaled: meters and radians have equal weight.
    pub hits: Vec<(f64, Rate)>,
    /// Mean of ‖ΔP_target − ΔP_retrieved‖₂ over the pairs.
    pub twist_error_mean: f64,
    /// Median of ‖ΔP_target − ΔP_retrieved‖₂ over the pairs.
    pub twist_error_median: f64,
    /// Median distance between the retrieved and the target camera, meters.
    pub translation_m_median: f64,
    /// Median angle between the retrieved and the target camera, radians.
    pub rotation_rad_median: f64,
    /// Joint recall of translation and rotation, one per pair of bounds.
    pub pose_recalls: Vec<PoseRecall>,
}

impl RetrievalScores {
    /// Scores one retrieved frame per pair; `poses` has one pose per frame of the room,
    /// `world_from_camera`.
    pub fn of(pairs: &[Pair], retrieved: &[FrameId], poses: &[Pose], thresholds: &[f64]) -> Self {
        let n = pairs.len();

        // Hit@ε compares motions from the source.
        let twist_errors: Vec<f64> = pairs
            .iter()
            .zip(retrieved)
            .map(|(&pair, &frame)| twist_error(pair, frame, poses))
            .collect();

        // Recalls and medians compare the retrieved pose with the target pose.
        let pose_errors: Vec<PoseError> = pairs
            .iter()
            .zip(retrieved)
            .map(|(pair, frame)| PoseError::between(&poses[frame.row()], &poses[pair.target.row()]))
            .collect();

        let rate = |count: usize| Rate::of(count, n);
        let recall = |(translation_m, rotation_deg): (f64, f64)| PoseRecall {
            translation_m,
            rotation_deg,
            // Strict, like Hit@ε.
            rate: rate(
                pose_errors
                    .iter()
                    .filter(|e| {
                        e.translation_m < translation_m
                            && e.rotation_rad < rotation_deg.to_radians()
                    })
                    .count(),
            ),
        };

        Self {
            top1: rate(
                pairs
                    .iter()
                    .zip(retrieved)
                    .filter(|(pair, frame)| pair.target == **frame)
                    .count(),
            ),
            hits: thresholds
                .iter()
                .map(|&epsilon| {
                    (
                        epsilon,
                        rate(
                            twist_errors
                                .iter()
                                .filter(|&&error| error < epsilon)
                                .count(),
                        ),
                    )
                })
                .collect(),
            twist_error_mean: mean(&twist_errors),
            twist_error_median: median(&twist_errors),
            translation_m_median: median(
                &pose_errors
                    .iter()
                    .map(|e| e.translation_m)
                    .collect::<Vec<_>>(),
            ),
            rotation_rad_median: median(
                &pose_errors
                    .iter()
                    .map(|e| e.rotation_rad)
                    .collect::<Vec<_>>(),
            ),
            pose_recalls: POSE_BARS.into_iter().map(recall).collect(),
        }
    }
}

/// ‖ΔP_target − ΔP_frame‖₂, both motions from the pair's source.
///
/// Source: SeeSE3, Sec. 4.1.
pub fn twist_error(pair: Pair, frame: FrameId, poses: &[Pose]) -> f64 {
    let source = &poses[pair.source.row()];
    let to = |frame: FrameId| body_twist(source, &poses[frame.row()]).to_vector();
    (to(pair.target) - to(frame)).norm()
}

/// Scores of predicted latents against the latents of the target frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LatentScores {
    /// Mean squared error over pairs and columns.
    pub mse: f64,
    /// Variance-weighted R² over all columns. The paper's figures are consistent with this
    /// definition.
    pub r2: f64,
    /// The unweighted mean of the columns' R².
    pub r2_uniform: f64,
}

impl LatentScores {
    /// Scores predicted latents (n, k) against the targets' latents (n, k).
    pub fn of(targets: ArrayView2<'_, f64>, predicted: ArrayView2<'_, f64>) -> Self {
        // A column with a standard deviation below 1e-9 is constant up to rounding and has no R².
        let still = targets.nrows() as f64 * 1e-18;
        let mut column_r2 = Vec::with_capacity(targets.ncols());
        let mut residual = 0.0;
        let mut total = 0.0;

        // Per column for the uniform mean; the sums over all columns give the variance-weighted R².
        for (target, predicted) in targets.axis_iter(Axis(1)).zip(predicted.axis_iter(Axis(1))) {
            let mean = target.sum() / target.len() as f64;

            let column_residual: f64 = target
                .iter()
                .zip(&predicted)
                .map(|(t, p)| (t - p) * (t - p))
                .sum();

            let column_total: f64 = target.iter().map(|t| (t - mean) * (t - mean)).sum();
            column_r2.push(if column_total > still {
                1.0 - column_residual / column_total
            } else {
                f64::NAN
            });

            residual += column_residual;
            total += column_total;
        }

        // 1 − Σ(y − ŷ)² / Σ(y − ȳ)² over all columns, with ȳ the mean of each column.
        let r2 = if total > still {
            1.0 - residual / total
        } else {
            f64::NAN
        };

        Self {
            mse: residual / targets.len() as f64,
            r2,
            r2_uniform: mean(&column_r2),
        }
    }
}

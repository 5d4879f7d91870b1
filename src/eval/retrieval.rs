//! Scores of retrieved frames against the frames that were wanted.

use ndarray::{ArrayView2, Axis};

use crate::geometry::{Pose, PoseError, body_twist};
use crate::pairs::Pair;
use crate::room::FrameId;
use crate::scores::{Rate, mean, median};

/// Joint bars of translation, metres, and rotation, degrees, as hloc and ACE report them.
const POSE_BARS: [(f64, f64); 7] = [
    (0.01, 1.0),
    (0.02, 2.0),
    (0.05, 5.0),
    (0.1, 5.0),
    (0.25, 2.0),
    (0.5, 5.0),
    (5.0, 10.0),
];

/// Share of pairs within a distance and an angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseRecall {
    /// Metres.
    pub translation_m: f64,
    /// Degrees.
    pub rotation_deg: f64,
    /// Strictly within both.
    pub rate: Rate,
}

/// How near the retrieved frames are to the wanted ones.
#[derive(Debug, Clone, PartialEq)]
pub struct RetrievalScores {
    /// The retrieved frame is the target frame itself.
    pub top1: Rate,
    /// ε and the share of pairs with ‖ΔP_target − ΔP_retrieved‖₂ < ε, raw twists from the source.
    pub hits: Vec<(f64, Rate)>,
    /// Mean of that error.
    pub twist_error_mean: f64,
    /// Median of that error.
    pub twist_error_median: f64,
    /// Median distance between retrieved and wanted camera, metres.
    pub translation_m_median: f64,
    /// Median angle between them, radians.
    pub rotation_rad_median: f64,
    /// Joint recalls.
    pub pose_recalls: Vec<PoseRecall>,
}

impl RetrievalScores {
    /// Scores one retrieved frame a pair; frames must be of the room whose `poses` are given.
    pub fn of(pairs: &[Pair], retrieved: &[FrameId], poses: &[Pose], thresholds: &[f64]) -> Self {
        let n = pairs.len();

        let twist_errors: Vec<f64> = pairs
            .iter()
            .zip(retrieved)
            .map(|(&pair, &frame)| twist_error(pair, frame, poses))
            .collect();

        let pose_errors: Vec<PoseError> = pairs
            .iter()
            .zip(retrieved)
            .map(|(pair, frame)| PoseError::between(&poses[frame.row()], &poses[pair.target.row()]))
            .collect();

        let rate = |count: usize| Rate::of(count, n);
        let recall = |(translation_m, rotation_deg): (f64, f64)| PoseRecall {
            translation_m,
            rotation_deg,
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

/// ‖ΔP_target − ΔP_frame‖₂ with both motions taken from the pair's source.
///
/// Source: SeeSE3, sec. 2.6.
pub fn twist_error(pair: Pair, frame: FrameId, poses: &[Pose]) -> f64 {
    let source = &poses[pair.source.row()];
    let to = |frame: FrameId| body_twist(source, &poses[frame.row()]).to_vector();
    (to(pair.target) - to(frame)).norm()
}

/// How near predicted latents are to the targets' latents.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LatentScores {
    /// Mean squared error over pairs and columns.
    pub mse: f64,
    /// R² over all columns together, weighted by their variance: what the paper's figures are
    /// consistent with.
    pub r2: f64,
    /// Mean of the columns' R².
    pub r2_uniform: f64,
}

impl LatentScores {
    /// Scores predictions (n, k) against targets (n, k).
    pub fn of(targets: ArrayView2<'_, f64>, predicted: ArrayView2<'_, f64>) -> Self {
        // Latents that deviate by less than 1e-9 do not vary: it is rounding.
        let still = targets.nrows() as f64 * 1e-18;
        let mut column_r2 = Vec::with_capacity(targets.ncols());
        let mut residual = 0.0;
        let mut total = 0.0;

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

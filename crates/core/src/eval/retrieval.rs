//! Scores of retrieved frames against the target frames.

use ndarray::{ArrayView2, Axis};

use crate::geometry::{Pose, PoseError, body_twist};
use crate::room::FrameId;
use crate::splits::Pair;
use crate::statistics::{Blocks, Extent, MeanInterval, Rate, mean, median};

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

/// The retrieved frame of one pair and its errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RetrievedPair {
    /// The source and the target.
    pub pair: Pair,
    /// The retrieved frame.
    pub retrieved: FrameId,
    /// ‖ΔP_target − ΔP_retrieved‖₂; both twists start at the source and are unscaled: meters and
    /// radians have equal weight.
    pub twist_error: f64,
    /// Distance and angle between the retrieved and the target camera.
    pub pose_error: PoseError,
}

impl RetrievedPair {
    /// Whether the pair is a hit of Hit@ε: its twist error is below ε.
    fn is_hit(&self, epsilon: f64) -> bool {
        self.twist_error < epsilon
    }
}

/// Scores of retrieved frames against the target frames. Intervals are of blocks of the recording
/// ([`Blocks`]), because overlapping pairs are correlated.
#[derive(Debug, Clone, PartialEq)]
pub struct RetrievalScores {
    /// Fraction of pairs for which the target frame itself was retrieved.
    pub top1: Rate,
    /// Hit@ε: ε and the fraction of pairs with a twist error below ε.
    pub hits: Vec<(f64, Rate)>,
    /// Mean twist error over the pairs.
    pub twist_error_mean: f64,
    /// Median twist error over the pairs.
    pub twist_error_median: f64,
    /// Median distance between the retrieved and the target camera, meters.
    pub translation_m_median: f64,
    /// Median angle between the retrieved and the target camera, radians.
    pub rotation_rad_median: f64,
    /// Joint recall of translation and rotation, one per pair of bounds.
    pub pose_recalls: Vec<PoseRecall>,
    /// The scored pairs, in the order given.
    pub pairs: Vec<RetrievedPair>,
}

impl RetrievalScores {
    /// Scores one retrieved frame per pair; `poses` has one pose per frame of the room,
    /// `world_from_camera`.
    pub fn of(pairs: &[Pair], retrieved: &[FrameId], poses: &[Pose], thresholds: &[f64]) -> Self {
        // Hit@ε compares motions from the source; recalls and medians compare the poses.
        let scored: Vec<RetrievedPair> = pairs
            .iter()
            .zip(retrieved)
            .map(|(&pair, &frame)| RetrievedPair {
                pair,
                retrieved: frame,
                twist_error: twist_error(pair, frame, poses),
                pose_error: PoseError::between(&poses[frame.row()], &poses[pair.target.row()]),
            })
            .collect();

        let blocks = blocks_of(&scored);
        let rate = |is_success: &dyn Fn(&RetrievedPair) -> bool| {
            blocks.rate(|position| is_success(&scored[position]))
        };
        let recall = |(translation_m, rotation_deg): (f64, f64)| PoseRecall {
            translation_m,
            rotation_deg,
            // Strict, like Hit@ε.
            rate: rate(&|scored| {
                scored.pose_error.translation_m < translation_m
                    && scored.pose_error.rotation_rad < rotation_deg.to_radians()
            }),
        };
        let column = |of: fn(&RetrievedPair) -> f64| scored.iter().map(of).collect::<Vec<_>>();
        let twist_errors = column(|scored| scored.twist_error);

        Self {
            top1: rate(&|scored| scored.retrieved == scored.pair.target),
            hits: thresholds
                .iter()
                .map(|&epsilon| (epsilon, rate(&|scored| scored.is_hit(epsilon))))
                .collect(),
            twist_error_mean: mean(&twist_errors),
            twist_error_median: median(&twist_errors),
            translation_m_median: median(&column(|scored| scored.pose_error.translation_m)),
            rotation_rad_median: median(&column(|scored| scored.pose_error.rotation_rad)),
            pose_recalls: POSE_BARS.into_iter().map(recall).collect(),
            pairs: scored,
        }
    }

    /// For each ε, the difference of Hit@ε to that of `baseline` on the same pairs, with the interval
    /// of blocks of the recording.
    pub fn hits_over(&self, baseline: &Self) -> Vec<(f64, MeanInterval)> {
        let blocks = blocks_of(&self.pairs);
        let difference = |epsilon: f64| {
            blocks.rate_difference(
                |position| self.pairs[position].is_hit(epsilon),
                |position| baseline.pairs[position].is_hit(epsilon),
            )
        };
        let thresholds = self.hits.iter().map(|(epsilon, _)| *epsilon);
        thresholds
            .map(|epsilon| (epsilon, difference(epsilon)))
            .collect()
    }

    /// Numbers of hits and pairs in each block of the recording.
    pub fn hits_by_block(&self, epsilon: f64) -> Vec<(usize, usize)> {
        blocks_of(&self.pairs).counts(|position| self.pairs[position].is_hit(epsilon))
    }
}

/// The blocks of pairs; a pair extends over the rows from its source to its target.
fn blocks_of(pairs: &[RetrievedPair]) -> Blocks {
    let extent = |scored: &RetrievedPair| {
        let Pair { source, target } = scored.pair;
        Extent {
            start: source.0.min(target.0),
            length: source.0.abs_diff(target.0),
        }
    };
    Blocks::of(&pairs.iter().map(extent).collect::<Vec<_>>())
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

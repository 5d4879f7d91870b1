//! Baselines for R² of motions. R² is relative to the variance of the tested motions, so it depends
//! on the recording as much as on the adapter.

use nalgebra::Vector6;

use crate::adapter::TargetScale;
use crate::geometry::{Pose, PoseError};
use crate::motion_scores::constant_r2;
use crate::room::{FrameId, Room};
use crate::splits::{self, Pair, Split};
use crate::statistics::{mean_of_known, median};
use crate::training::motions;

/// Below this R² of the constant baseline, the R² of an adapter is not informative.
pub const LEAST_CONSTANT_R2: f64 = -1.0;

/// Baselines for R² of motions on the test pairs of a room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Baselines {
    /// R² of the constant prediction μ, the mean training motion. Far below zero, the tested
    /// motions differ so much from the trained ones that no adapter can score well.
    pub constant_r2: f64,
    /// Variance of the tested motions divided by σ² of the trained ones, mean over the components.
    pub variance_ratio: f64,
    /// Median distance and angle from a tested frame to the nearest training pose (nearest in
    /// meters plus radians). `None` if the adapter was not trained on these frames.
    pub nearest_pose: Option<PoseError>,
    /// Number of optimizer steps; 0 for a closed-form fit.
    pub optimizer_steps: u64,
}

impl Baselines {
    /// Baselines for an adapter with the target scale `scale`, trained in `optimizer_steps`.
    /// `learned_here` is true if it was trained on these frames.
    ///
    /// # Errors
    /// [`splits::Error`] when the room has no test pairs.
    pub fn of(
        scale: &TargetScale,
        optimizer_steps: u64,
        room: &Room,
        test: &TestPairs,
        learned_here: bool,
    ) -> Result<Self, splits::Error> {
        let pairs = test.split.test_pairs(room.timeline(), test.stride)?;
        let truth = motions(room.poses(), &pairs);

        let count = truth.len() as f64;
        let mean = truth
            .iter()
            .map(|twist| twist.to_vector())
            .sum::<Vector6<f64>>()
            / count;
        let squares = truth
            .iter()
            .map(|twist| (twist.to_vector() - mean).map(|x| x * x));
        let variance = squares.sum::<Vector6<f64>>() / count;
        let ratios: Vec<f64> = (0..6)
            .map(|c| variance[c] / (scale.deviation[c] * scale.deviation[c]))
            .collect();

        let training_pairs = test.split.train_pairs(room.timeline(), test.stride);
        let nearest_pose = match training_pairs {
            Ok(training) if learned_here => nearest_pose(room.poses(), &training, &pairs),
            _ => None,
        };

        Ok(Self {
            constant_r2: constant_r2(&truth, &scale.mean),
            variance_ratio: mean_of_known(&ratios),
            nearest_pose,
            optimizer_steps,
        })
    }

    /// Baselines for a model that was trained on the room's own training pairs, at the same stride.
    ///
    /// # Errors
    /// [`splits::Error`] when the room has no training or no test pairs.
    pub fn within(
        room: &Room,
        test: &TestPairs,
        optimizer_steps: u64,
    ) -> Result<Self, splits::Error> {
        let training = test.split.train_pairs(room.timeline(), test.stride)?;
        let scale = TargetScale::of(&motions(room.poses(), &training));

        Self::of(&scale, optimizer_steps, room, test, true)
    }

    /// Whether R² is informative in this recording: the constant baseline is at least
    /// [`LEAST_CONSTANT_R2`].
    pub fn can_tell(&self) -> bool {
        self.constant_r2 >= LEAST_CONSTANT_R2
    }
}

/// Selection of the test pairs of a room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TestPairs {
    /// Split into training and test.
    pub split: Split,
    /// Frames from source to target.
    pub stride: u32,
}

/// Median distance and angle from tested frames to the nearest training pose; `None` without
/// frames.
fn nearest_pose(poses: &[Pose], training: &[Pair], tested: &[Pair]) -> Option<PoseError> {
    let known = frames(training);
    let apart = |error: &PoseError| error.translation_m + error.rotation_rad;

    let nearest: Vec<PoseError> = frames(tested)
        .iter()
        .filter_map(|frame| {
            let errors = known
                .iter()
                .map(|other| PoseError::between(&poses[frame.row()], &poses[other.row()]));
            errors.min_by(|a, b| apart(a).total_cmp(&apart(b)))
        })
        .collect();
    if nearest.is_empty() {
        return None;
    }

    let meters: Vec<f64> = nearest.iter().map(|error| error.translation_m).collect();
    let radians: Vec<f64> = nearest.iter().map(|error| error.rotation_rad).collect();
    Some(PoseError {
        translation_m: median(&meters),
        rotation_rad: median(&radians),
    })
}

/// The distinct frames of the pairs, sorted.
fn frames(pairs: &[Pair]) -> Vec<FrameId> {
    let mut frames: Vec<FrameId> = pairs
        .iter()
        .flat_map(|pair| [pair.source, pair.target])
        .collect();
    frames.sort_unstable();
    frames.dedup();
    frames
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. The camera moves one meter per frame: the tested frames 8 and 9 are one and
    /// two meters from the last training frame.
    #[test]
    fn the_nearest_training_pose_is_found() {
        let poses: Vec<Pose> = (0..10)
            .map(|x| Pose::translation(f64::from(x), 0.0, 0.0))
            .collect();
        let pair = |source: u32, target: u32| Pair {
            source: FrameId(source),
            target: FrameId(target),
        };
        let training: Vec<Pair> = (0..7).map(|row| pair(row, row + 1)).collect();

        let found = nearest_pose(&poses, &training, &[pair(8, 9)]).unwrap();
        assert!((found.translation_m - 1.5).abs() < 1e-12 && found.rotation_rad == 0.0);
        assert!(nearest_pose(&poses, &[], &[pair(8, 9)]).is_none());
    }
}

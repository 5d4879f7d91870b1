//! The focal length of a view that fits its matches best.
//!
//! Pose and focal length are refined together. Matches that a wrong focal length excludes join step
//! by step, because the thresholds begin wide.

use std::collections::BTreeSet;

use nalgebra::{Cholesky, SMatrix, SVector, Vector6};

use super::absolute_pose::{Correspondence, Search};
use seese3_core::geometry::{Pose, Twist, exp};

/// Threshold of each step, as a multiple of the inlier threshold.
const THRESHOLDS: [f64; 10] = [4.0, 4.0, 3.0, 3.0, 2.0, 2.0, 1.5, 1.0, 1.0, 1.0];
/// Largest change of the logarithm of the focal length in one step.
const MAX_STEP: f64 = 0.1;
/// Largest logarithm of a fitted focal length over the stated one. Beyond it, the fit has shrunk
/// the view to a point.
const MAX_LOG_FACTOR: f64 = 0.6;

/// A fitted focal length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FocalFit {
    /// Fitted focal length divided by the stated one.
    pub factor: f64,
    /// Number of matches that agree with the fitted focal length.
    pub matches: usize,
    /// Number of keypoints of the view in these matches.
    pub inliers: usize,
    /// Variance of the logarithm of `factor` for independent errors of the matches.
    pub independent_variance: f64,
}

/// Refines `pose`, `world_from_camera`, together with the focal length. `variance_px` is that of a
/// keypoint's position. `None` if the fit does not converge.
pub(super) fn fitted_focal(
    search: &Search,
    matches: &[Correspondence],
    pose: &Pose,
    variance_px: f64,
) -> Option<FocalFit> {
    let mut pose = *pose;
    let mut log_factor = 0.0;
    let mut independent_variance = f64::INFINITY;

    for ratio in THRESHOLDS {
        let threshold_px = ratio * search.threshold_px;
        let (search, matches) = zoomed(search, matches, log_factor);
        let normal = normal_equations(&search, &matches, &pose, threshold_px);
        let cholesky = Cholesky::new(normal.information)?;

        // Long steps leave the range in which the projection is nearly linear.
        let mut step = cholesky.solve(&normal.gradient);
        step *= (MAX_STEP / step[6].abs()).min(1.0);
        if !step.iter().all(|x| x.is_finite()) {
            return None;
        }

        let by_pose: Vector6<f64> = step.fixed_rows::<6>(0).into();
        pose *= exp(&Twist::from_vector(&by_pose));
        log_factor += step[6];
        if log_factor.abs() > MAX_LOG_FACTOR {
            return None;
        }

        let focal_axis = SVector::<f64, 7>::from_fn(|row, _| if row == 6 { 1.0 } else { 0.0 });
        independent_variance = cholesky.solve(&focal_axis)[6] * variance_px;
    }

    let camera_from_world = pose.inverse();
    let squared_threshold = search.threshold_px * search.threshold_px;
    let (search, matches) = zoomed(search, matches, log_factor);
    let agreeing: Vec<usize> = matches
        .iter()
        .filter(|match_| search.squared_error(match_, &camera_from_world) < squared_threshold)
        .map(|match_| match_.keypoint)
        .collect();

    Some(FocalFit {
        factor: log_factor.exp(),
        matches: agreeing.len(),
        inliers: agreeing.into_iter().collect::<BTreeSet<usize>>().len(),
        independent_variance,
    })
}

/// The search and the matches of a camera whose focal length is longer by this logarithm. Residuals
/// stay those in the image.
fn zoomed(
    search: &Search,
    matches: &[Correspondence],
    log_factor: f64,
) -> (Search, Vec<Correspondence>) {
    let factor = log_factor.exp();
    let matches = matches.iter().map(|match_| Correspondence {
        plane: match_.plane / factor,
        ..*match_
    });
    let search = Search {
        focal_px: search.focal_px * factor,
        ..*search
    };
    (search, matches.collect())
}

/// Normal equations of a Gauss–Newton step of pose and logarithmic focal length.
struct NormalEquations {
    information: SMatrix<f64, 7, 7>,
    gradient: SVector<f64, 7>,
}

/// Normal equations of the matches within a threshold, with a Cauchy loss of its scale.
fn normal_equations(
    search: &Search,
    matches: &[Correspondence],
    pose: &Pose,
    threshold_px: f64,
) -> NormalEquations {
    let mut normal = NormalEquations {
        information: SMatrix::zeros(),
        gradient: SVector::zeros(),
    };

    for match_ in matches {
        let Some(row) = search.linearized(match_, pose) else {
            continue;
        };
        let squared = row.residual.norm_squared();
        if squared > threshold_px * threshold_px {
            continue;
        }

        // A longer focal length moves the projected point away from the center.
        let by_focal = match_.plane * search.focal_px - row.residual;
        let mut by_step = SMatrix::<f64, 2, 7>::zeros();
        by_step.fixed_columns_mut::<6>(0).copy_from(&row.by_step);
        by_step.column_mut(6).copy_from(&by_focal);

        let weight = 1.0 / (1.0 + squared / (0.5 * threshold_px).powi(2));
        normal.information += by_step.transpose() * by_step * weight;
        normal.gradient += by_step.transpose() * row.residual * weight;
    }

    normal
}

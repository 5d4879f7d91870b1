//! M2: the intrinsic dimension of the feature manifold.

use std::collections::HashSet;

use ndarray::{ArrayView2, Axis};
use serde::Serialize;

use super::Error;
use super::nearest_rows::{TooFewCandidates, nearest_rows};
use seese3_core::statistics::{mean, median};

/// Number of neighbors K of the maximum-likelihood estimate.
const MLE_NEIGHBORS: usize = 20;
/// Fraction of the largest ratios that TwoNN discards.
const DISCARDED: f64 = 0.1;

/// TwoNN (Facco et al. 2017), estimated in three ways.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoNn {
    /// The usual estimate: slope of −log(1 − F) over log μ through the origin, without the largest
    /// tenth of the ratios μ.
    pub linear: f64,
    /// Maximum likelihood with the largest tenth of the ratios censored.
    pub censored: f64,
    /// Maximum likelihood over all ratios.
    pub likelihood: f64,
}

/// MLE (Levina and Bickel 2004) over 20 neighbors. The unbiased form normalizes by K − 2, the
/// biased form by K − 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Mle {
    /// The harmonic mean over rows (MacKay and Ghahramani), the usual combination.
    pub harmonic: f64,
    /// The mean over rows.
    pub mean: f64,
    /// The median over rows.
    pub median: f64,
}

/// M2 by every estimator.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntrinsicDimension {
    /// See [`TwoNn`].
    pub two_nn: TwoNn,
    /// MLE normalized by K − 1.
    pub mle_biased: Mle,
    /// MLE normalized by K − 2.
    pub mle_unbiased: Mle,
    /// Number of rows used.
    pub used: usize,
    /// Number of rows left out as copies of an earlier row.
    pub dropped: usize,
}

/// The intrinsic dimension of `rows` (n, d). Of identical rows, only the first is used, both as a
/// point and as a neighbor: the estimators take distinct points of the manifold, and a copy would
/// be a neighbor at distance zero. Rows at most `gap` apart do not count as neighbors; a `gap` of 0
/// excludes only the row itself.
///
/// # Errors
/// [`Error::TooFewRows`] when fewer than 21 distinct rows are left; [`Error::TooFewCandidates`]
/// when the gap leaves a row fewer than 20 candidates.
///
/// Source: SeeSE3, M2; the paper states neither gap nor K, nor what it does with identical rows.
pub fn intrinsic_dimension(
    rows: ArrayView2<'_, f32>,
    gap: usize,
) -> Result<IntrinsicDimension, Error> {
    let all = rows.mapv(f64::from);

    // Compare rows by bits. Adding 0.0 turns −0.0 into 0.0, so equal numbers have equal bits.
    let bits = |row: usize| -> Vec<u64> {
        let numbers = all.row(row);
        numbers.iter().map(|x| (x + 0.0).to_bits()).collect()
    };
    let mut seen = HashSet::new();
    let kept: Vec<usize> = (0..all.nrows())
        .filter(|&row| seen.insert(bits(row)))
        .collect();

    if kept.len() <= MLE_NEIGHBORS {
        return Err(Error::TooFewRows {
            kept: kept.len(),
            rows: all.nrows(),
            needed: MLE_NEIGHBORS + 1,
        });
    }

    let points = all.select(Axis(0), &kept);
    let near = |row: usize| {
        let first = kept.partition_point(|&other| other < kept[row].saturating_sub(gap));
        first..kept.partition_point(|&other| other <= kept[row].saturating_add(gap))
    };
    let found = nearest_rows(points.view(), MLE_NEIGHBORS, near);
    let found = found.map_err(|TooFewCandidates { row }| Error::TooFewCandidates {
        frame: kept[row],
        k: MLE_NEIGHBORS,
        exclusion: gap,
    })?;
    let distances_of = |found: Vec<(f64, usize)>| found.into_iter().map(|(d, _)| d).collect();
    let distances: Vec<Vec<f64>> = found.into_iter().map(distances_of).collect();

    Ok(IntrinsicDimension {
        two_nn: two_nn(&distances),
        mle_biased: mle(&distances, MLE_NEIGHBORS as f64 - 1.0),
        mle_unbiased: mle(&distances, MLE_NEIGHBORS as f64 - 2.0),
        used: kept.len(),
        dropped: all.nrows() - kept.len(),
    })
}

fn two_nn(distances: &[Vec<f64>]) -> TwoNn {
    // log μ of each row; μ is the ratio of the distances to its second and first neighbor.
    let mut logs: Vec<f64> = distances.iter().map(|row| (row[1] / row[0]).ln()).collect();
    logs.sort_by(f64::total_cmp);
    let count = logs.len();
    let used = (count as f64 * (1.0 - DISCARDED)) as usize;

    let likelihood = (count as f64 - 1.0) / logs.iter().sum::<f64>();

    // −log(1 − F) at the i-th smallest ratio, with the empirical F = (i + 1)/n.
    let share = |i: usize| -(1.0 - (i + 1) as f64 / count as f64).ln();
    let used_logs = &logs[..used];
    let square: f64 = used_logs.iter().map(|x| x * x).sum();

    let linear = used_logs
        .iter()
        .enumerate()
        .map(|(i, x)| x * share(i))
        .sum::<f64>()
        / square;

    // A censored ratio is known only to be at least as large as the last kept ratio.
    let tail = (count - used) as f64 * used_logs.last().copied().unwrap_or(f64::NAN);
    let censored = (used as f64 - 1.0) / (used_logs.iter().sum::<f64>() + tail);

    TwoNn {
        linear,
        censored,
        likelihood,
    }
}

fn mle(distances: &[Vec<f64>], factor: f64) -> Mle {
    // Estimate of one row: factor / Σ_j log(r_K / r_j).
    let of = |row: &Vec<f64>| {
        factor
            / row
                .iter()
                .map(|r| (row[row.len() - 1] / r).ln())
                .sum::<f64>()
    };

    let each: Vec<f64> = distances.iter().map(of).collect();
    let inverse: Vec<f64> = each.iter().map(|m| 1.0 / m).collect();

    Mle {
        harmonic: 1.0 / mean(&inverse),
        mean: mean(&each),
        median: median(&each),
    }
}

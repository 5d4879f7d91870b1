//! Coverage of covariances: the fractions of errors inside their confidence ellipsoids, and the
//! factor that calibrates them.
//!
//! An error e with covariance Σ has the squared Mahalanobis length eᵀ Σ⁻¹ e. For normal errors in
//! six dimensions it follows χ² with six degrees of freedom.

/// 68 % quantile of χ² with six degrees of freedom.
pub const CHI_SQUARED_68: f64 = 7.012;
/// 95 % quantile of χ² with six degrees of freedom.
pub const CHI_SQUARED_95: f64 = 12.592;

/// A target coverage of one ellipsoid.
struct Wanted {
    /// The ellipsoid's squared Mahalanobis radius.
    radius: f64,
    /// The target fraction of errors inside.
    share: f64,
    /// Unit of the deviation from `share`, so that both targets have equal weight.
    tolerance: f64,
}

const WANTED: [Wanted; 2] = [
    Wanted {
        radius: CHI_SQUARED_68,
        share: 0.68,
        tolerance: 0.08,
    },
    // The target is slightly below 95 %, because the tails of the errors are heavier than normal.
    // Otherwise the inner ellipsoid would become far too large.
    Wanted {
        radius: CHI_SQUARED_95,
        share: 0.945,
        tolerance: 0.035,
    },
];

/// Smallest factor that [`balancing_factor`] tries.
const SMALLEST_FACTOR: f64 = 0.01;
/// Ratio of successive tried factors.
const FACTOR_RATIO: f64 = 1.015;
/// Number of tried factors; the last is about 100.
const FACTOR_COUNT: i32 = 620;

/// Fractions of errors inside the confidence ellipsoids of their covariances.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Coverage {
    /// Fraction inside the 68 % ellipsoid.
    #[cfg_attr(feature = "serde", serde(rename = "coverage_68"))]
    pub within_68: f64,
    /// Fraction inside the 95 % ellipsoid.
    #[cfg_attr(feature = "serde", serde(rename = "coverage_95"))]
    pub within_95: f64,
}

/// Coverage of errors with these squared Mahalanobis lengths; NaN without errors.
pub fn coverage(squared_lengths: &[f64]) -> Coverage {
    let share = |radius: f64| {
        let inside = squared_lengths.iter().filter(|&&x| x <= radius).count();
        inside as f64 / squared_lengths.len() as f64
    };

    Coverage {
        within_68: share(CHI_SQUARED_68),
        within_95: share(CHI_SQUARED_95),
    }
}

/// The covariance factor that brings both coverages closest to their targets; the smallest on ties.
/// Sorts `squared_lengths`; `None` if empty.
pub fn balancing_factor(squared_lengths: &mut [f64]) -> Option<f64> {
    if squared_lengths.is_empty() {
        return None;
    }

    squared_lengths.sort_by(f64::total_cmp);
    let deviation = |factor: f64| deviation_of_sorted(squared_lengths, factor);

    (0..FACTOR_COUNT)
        .map(|step| SMALLEST_FACTOR * FACTOR_RATIO.powi(step))
        .min_by(|a, b| deviation(*a).total_cmp(&deviation(*b)))
}

/// Deviation of the coverage from its targets: the larger of the two, in units of their tolerances.
/// Sorts `squared_lengths`; `None` if empty.
pub fn coverage_deviation(squared_lengths: &mut [f64]) -> Option<f64> {
    squared_lengths.sort_by(f64::total_cmp);
    (!squared_lengths.is_empty()).then(|| deviation_of_sorted(squared_lengths, 1.0))
}

/// [`coverage_deviation`] of sorted squared lengths, with covariances multiplied by `factor`.
fn deviation_of_sorted(sorted: &[f64], factor: f64) -> f64 {
    let share_below =
        |limit: f64| sorted.partition_point(|&length| length <= limit) as f64 / sorted.len() as f64;

    WANTED
        .iter()
        .map(|wanted| (share_below(wanted.radius * factor) - wanted.share).abs() / wanted.tolerance)
        .fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the table of χ² with six degrees of freedom.
    #[test]
    fn coverage_counts_what_is_within() {
        let found = coverage(&[1.0, 7.0, 7.1, 12.5, 20.0]);
        assert_eq!(
            found,
            Coverage {
                within_68: 0.4,
                within_95: 0.8
            }
        );
    }

    /// Oracle: by hand. A factor of 4 brings two of three errors (4·7) inside the inner ellipsoid
    /// and all (4·12) inside the outer one.
    #[test]
    fn the_balancing_factor_brings_errors_inside() {
        let mut lengths = vec![4.0 * 7.0, 4.0 * 7.0, 4.0 * 12.0];
        let factor = balancing_factor(&mut lengths).unwrap();
        assert!((3.9..4.4).contains(&factor), "{factor}");
        assert!(balancing_factor(&mut []).is_none());
    }
}

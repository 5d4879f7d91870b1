//! Whether stated covariances hold: the shares of errors inside their ellipsoids, and the factor
//! that would make them hold.
//!
//! An error e with a stated covariance Σ has the squared Mahalanobis length eᵀ Σ⁻¹ e. If e is
//! normal with six degrees of freedom, these lengths follow χ² with six degrees of freedom.

/// 68 % of χ² with six degrees of freedom lies below.
pub const CHI_SQUARED_68: f64 = 7.012;
/// 95 % of χ² with six degrees of freedom lies below.
pub const CHI_SQUARED_95: f64 = 12.592;

/// A share of errors that is wanted inside an ellipsoid.
struct Wanted {
    /// The ellipsoid's squared Mahalanobis radius.
    radius: f64,
    /// The wanted share.
    share: f64,
    /// A deviation from the share that counts as 1, so that both shares weigh alike.
    tolerance: f64,
}

const WANTED: [Wanted; 2] = [
    Wanted {
        radius: CHI_SQUARED_68,
        share: 0.68,
        tolerance: 0.08,
    },
    // The errors' tails are heavier than a normal distribution's: a little below 95 % is wanted, so
    // that the inner ellipsoid does not have to be far too large for the outer one to hold.
    Wanted {
        radius: CHI_SQUARED_95,
        share: 0.945,
        tolerance: 0.035,
    },
];

/// The smallest factor that [`balancing_factor`] tries.
const SMALLEST_FACTOR: f64 = 0.01;
/// The ratio of each tried factor to the one before.
const FACTOR_RATIO: f64 = 1.015;
/// How many factors are tried: the last is about 100.
const FACTOR_COUNT: i32 = 620;

/// Shares of errors inside the ellipsoids of their stated covariances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coverage {
    /// The share inside the 68 % ellipsoid.
    pub within_68: f64,
    /// The share inside the 95 % ellipsoid.
    pub within_95: f64,
}

/// The coverage of errors with these squared Mahalanobis lengths; NaN without errors.
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

/// The factor by which covariances have to be multiplied so that both shares of errors come nearest
/// to what is wanted; of equally good factors the smallest. Sorts `squared_lengths`; `None` if
/// there are none.
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

/// How far the coverage of errors is from what is wanted: the larger deviation of the two shares,
/// in tolerances. Sorts `squared_lengths`; `None` if there are none.
pub fn coverage_deviation(squared_lengths: &mut [f64]) -> Option<f64> {
    squared_lengths.sort_by(f64::total_cmp);
    (!squared_lengths.is_empty()).then(|| deviation_of_sorted(squared_lengths, 1.0))
}

/// The deviation of sorted squared lengths, if covariances were multiplied by `factor`.
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

    /// Oracle: by hand: two of three errors have to be inside the inner ellipsoid and all inside
    /// the outer one, which a factor of 4 does for lengths of 4·7 and 4·12.
    #[test]
    fn the_balancing_factor_brings_errors_inside() {
        let mut lengths = vec![4.0 * 7.0, 4.0 * 7.0, 4.0 * 12.0];
        let factor = balancing_factor(&mut lengths).unwrap();
        assert!((3.9..4.4).contains(&factor), "{factor}");
        assert!(balancing_factor(&mut []).is_none());
    }
}

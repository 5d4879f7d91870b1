//! Running uncertainty of recent matches, a lower bound for that of the next one.
//!
//! Far from the map most anchors have a large covariance. In a few, the nearest frames agree by
//! chance: the covariance claims 2 cm while the error is 10 cm. The uncertainty of the preceding
//! anchors then predicts the error better.

use super::PoseWithCovariance;

/// Time constant of the running mean, seconds. Chosen on calibration rooms from 0.3 to 1.2; it has
/// little effect.
const MEMORY_S: f64 = 0.4;

/// Exponential running mean of the match uncertainty of a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RecentMatches {
    /// Timestamp of the newest view, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// Mean natural logarithm of the position's standard deviation in meters.
    pub log_deviation: f64,
}

impl RecentMatches {
    /// Updates the mean with one more match; `before` is `None` for the first.
    pub(super) fn after(before: Option<Self>, time_ns: i64, anchor: &PoseWithCovariance) -> Self {
        let log_deviation = anchor.position_deviation_m().ln();
        let Some(before) = before else {
            return Self {
                time_ns,
                log_deviation,
            };
        };

        let seconds = time_ns.abs_diff(before.time_ns) as f64 * 1e-9;
        let share = 1.0 - (-seconds / MEMORY_S).exp();
        Self {
            time_ns,
            log_deviation: before.log_deviation + share * (log_deviation - before.log_deviation),
        }
    }

    /// Inflates the covariance of an anchor to at least the running uncertainty.
    pub(super) fn tempered(&self, anchor: PoseWithCovariance) -> PoseWithCovariance {
        let factor = self.log_deviation.exp() / anchor.position_deviation_m();
        PoseWithCovariance {
            covariance: anchor.covariance * factor.max(1.0).powi(2),
            ..anchor
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::geometry::Pose;

    fn known(deviation: f64) -> PoseWithCovariance {
        PoseWithCovariance::known(Pose::identity(), deviation, deviation)
    }

    /// Oracle: by hand. A match of 1 cm follows matches of 16 cm after 0.1 s: the mean logarithm
    /// moves by the fraction 1 − e^(−1/4), which is the uncertainty used. After 10 s the match is
    /// used unchanged. A match worse than the mean is always used unchanged.
    #[test]
    fn one_sure_match_among_others_is_not_believed() {
        let before = RecentMatches::after(None, 0, &known(0.16));
        let now = RecentMatches::after(Some(before), 100_000_000, &known(0.01));
        let way = 1.0 - (-0.25_f64).exp();
        let expected = 0.16_f64.powf(1.0 - way) * 0.01_f64.powf(way);
        let found = now.tempered(known(0.01)).position_deviation_m();
        assert!((found / expected - 1.0).abs() < 1e-12, "{found} {expected}");

        let later = RecentMatches::after(Some(before), 10_000_000_000, &known(0.01));
        let found = later.tempered(known(0.01)).position_deviation_m();
        assert!((found / 0.01 - 1.0).abs() < 1e-9, "{found}");
        assert_eq!(later.tempered(known(0.3)), known(0.3));
    }
}

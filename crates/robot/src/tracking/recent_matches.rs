//! How sure the matches of the last views were.
//!
//! Where nothing near is mapped, most views are known to be placed badly; in a few the frames that
//! look most alike agree by chance, so that a view seems to be placed to two centimetres and is ten
//! centimetres off. How well the views just before it were placed tells better what to think of it.

use super::PoseWithCovariance;

/// Views are remembered for about so long, seconds. Chosen on calibration rooms, from 0.3 to 1.2,
/// where it makes little difference.
const MEMORY_S: f64 = 0.4;

/// The running mean of how sure the matches of a stream are.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RecentMatches {
    /// When the newest view was taken, nanoseconds on the sensor's clock.
    pub time_ns: i64,
    /// The mean logarithm of the standard deviation of the position, metres.
    pub log_deviation: f64,
}

impl RecentMatches {
    /// As it is after one more match; `before` is none for the first.
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

    /// An anchor that is no surer than the matches lately were.
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

    /// Oracle: by hand. After matches of 16 cm one of 1 cm comes a tenth of a second later: the mean
    /// logarithm goes by 1 − e^(−1/4) of the way, and that is how sure the match counts. After ten
    /// seconds of such matches it counts as it is, and a worse one always does.
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

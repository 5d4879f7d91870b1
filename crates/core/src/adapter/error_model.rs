//! An adapter's error model: the size of its errors in rooms outside its training set. It is
//! measured once, by the calibration in `seese3-robot`, and stored with the adapter. Tracking by
//! latents requires it.
//!
//! Start reading at [`ErrorStatistics`], which lists all measured quantities.

use nalgebra::{Cholesky, Matrix6};
use ndarray::Array2;

use super::{Error, Whitener};

/// Rows to each side of a frame that count as its temporal neighbors. They are near it because
/// little time has passed, not because the camera revisits a place.
pub const TEMPORAL_NEIGHBORS: u32 = 10;

/// Error covariances, tabulated by one predictor of their size, the distance of a match.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorTable {
    strata: Vec<Stratum>,
}

/// Errors at one value of the predictor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stratum {
    /// The value of the predictor, above 0.
    pub at: f64,
    /// Covariance of the errors on (v, ω), meters and radians; positive definite.
    pub covariance: Matrix6<f64>,
}

impl Stratum {
    fn is_sound(&self) -> bool {
        let asymmetry = (self.covariance - self.covariance.transpose()).amax();
        let is_symmetric = asymmetry <= 1e-9 * self.covariance.amax();

        self.at.is_finite()
            && self.at > 0.0
            && is_symmetric
            && Cholesky::new(self.covariance).is_some()
    }
}

impl ErrorTable {
    /// A table of strata, in ascending order of the predictor.
    ///
    /// # Errors
    /// [`Error::ErrorModel`] when there is no stratum, one is invalid, or they are not in ascending
    /// order.
    pub fn new(strata: Vec<Stratum>) -> Result<Self, Error> {
        let is_rising = strata.windows(2).all(|pair| pair[0].at < pair[1].at);
        if strata.is_empty() || !is_rising || !strata.iter().all(Stratum::is_sound) {
            return Err(Error::ErrorModel {
                what: "an error table",
            });
        }

        Ok(Self { strata })
    }

    /// The strata, in ascending order of the predictor.
    pub fn strata(&self) -> &[Stratum] {
        &self.strata
    }

    /// Errors at the predictor value `at`: interpolated in its logarithm between two strata,
    /// constant outside the table.
    pub fn at(&self, at: f64) -> Stratum {
        let first = self.strata[0];
        let last = self.strata[self.strata.len() - 1];

        // NaN gets the last stratum, the safe choice.
        if at.is_nan() || at >= last.at {
            return last;
        }
        if at <= first.at {
            return first;
        }

        let above = self.strata.partition_point(|stratum| stratum.at <= at);
        let low = self.strata[above - 1];
        let high = self.strata[above];
        let share = (at / low.at).ln() / (high.at / low.at).ln();

        Stratum {
            at,
            // A weighted mean of two positive definite matrices is positive definite.
            covariance: low.covariance * (1.0 - share) + high.covariance * share,
        }
    }
}

/// The error statistics that calibration measures, in rooms outside the adapter's training set.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorStatistics {
    /// Frame period of the calibration rooms, seconds: the mean over rooms of the median period.
    pub frame_period_s: f64,
    /// Frame noise: half the second moment of the latent differences between successive frames,
    /// shape (c, c). It includes the camera's motion over one frame.
    pub frame_noise: Array2<f64>,
    /// Errors of a pose estimated from a matched frame, by the distance of the match in
    /// `frame_noise`.
    pub match_errors: ErrorTable,
    /// Out-of-distribution limit of the match distance, as a multiple of the room's typical
    /// distance. Above it, the view counts as another place.
    pub out_of_distribution_ratio: f64,
    /// Limit of the match distance for a certain match, as a multiple of the room's typical
    /// distance. Hardly any frame of another room is below it.
    pub certain_match_ratio: f64,
}

/// A validated error model.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorModel {
    statistics: ErrorStatistics,
    frame_noise: Whitener,
}

impl ErrorModel {
    /// Validates the statistics.
    ///
    /// # Errors
    /// [`Error::ErrorModel`], which names the invalid quantity.
    pub fn new(statistics: ErrorStatistics) -> Result<Self, Error> {
        let frame_noise = Whitener::new(statistics.frame_noise.view())?;

        let positive = [
            ("the frame period", statistics.frame_period_s),
            (
                "the out-of-distribution limit",
                statistics.out_of_distribution_ratio,
            ),
            ("the certain-match limit", statistics.certain_match_ratio),
        ];
        for (what, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::ErrorModel { what });
            }
        }

        Ok(Self {
            statistics,
            frame_noise,
        })
    }

    /// The measured statistics.
    pub fn statistics(&self) -> &ErrorStatistics {
        &self.statistics
    }

    /// Whitener of the frame noise, the unit of match distances.
    pub fn frame_noise(&self) -> &Whitener {
        &self.frame_noise
    }

    /// Errors of a pose estimated from a match at `distance`, in frame noise.
    pub fn match_errors(&self, distance: f64) -> Stratum {
        self.statistics.match_errors.at(distance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stratum(at: f64, variance: f64) -> Stratum {
        Stratum {
            at,
            covariance: Matrix6::from_diagonal_element(variance),
        }
    }

    /// Oracle: by hand; 10 is halfway between 1 and 100 on a logarithmic scale.
    #[test]
    fn errors_between_strata_are_between_theirs() {
        let table = ErrorTable::new(vec![stratum(1.0, 2.0), stratum(100.0, 4.0)]).unwrap();
        for (at, expected) in [
            (0.0, 2.0),
            (1.0, 2.0),
            (10.0, 3.0),
            (100.0, 4.0),
            (1e9, 4.0),
            (f64::NAN, 4.0),
        ] {
            assert!(
                (table.at(at).covariance[(2, 2)] - expected).abs() < 1e-12,
                "{at}"
            );
        }

        for wrong in [
            vec![],
            vec![stratum(2.0, 1.0), stratum(1.0, 1.0)],
            vec![stratum(1.0, 0.0)],
        ] {
            assert!(ErrorTable::new(wrong).is_err());
        }
    }
}

//! What an adapter's errors are like in rooms that it did not learn from: measured once, kept with
//! it.

use nalgebra::{Cholesky, Matrix6};
use ndarray::{Array2, ArrayView1, ArrayView2};

use super::Error;

/// χ² with six degrees of freedom: 68 % and 95 % are below.
pub const ELLIPSOIDS: [f64; 2] = [7.012, 12.592];
/// Rows to each side of a frame that are its neighbours in time, not in place.
pub const BESIDE: u32 = 10;
/// Frames before one that a jump is told from.
pub const RECENT: usize = 5;

/// Covariances of errors by one number that says how large they are to be expected.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorTable {
    strata: Vec<Stratum>,
}

/// Errors where that number is about `at`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stratum {
    /// The number, above 0.
    pub at: f64,
    /// The share of a reading that is to be believed: the slope of truth on reading.
    pub gain: f64,
    /// On (v, ω), metres and radians. Positive definite.
    pub covariance: Matrix6<f64>,
}

impl ErrorTable {
    /// Strata from the smallest number to the largest.
    ///
    /// # Errors
    /// [`Error::Calibration`].
    pub fn new(strata: Vec<Stratum>) -> Result<Self, Error> {
        let rising = strata.windows(2).all(|pair| pair[0].at < pair[1].at);

        let sound = |stratum: &Stratum| {
            let Stratum {
                at,
                gain,
                covariance,
            } = stratum;
            let symmetric =
                (covariance - covariance.transpose()).amax() <= 1e-9 * covariance.amax();

            at.is_finite()
                && *at > 0.0
                && gain.is_finite()
                && symmetric
                && Cholesky::new(*covariance).is_some()
        };

        if strata.is_empty() || !rising || !strata.iter().all(sound) {
            return Err(Error::Calibration {
                what: "an error table",
            });
        }

        Ok(Self { strata })
    }

    /// The strata, from the smallest number to the largest.
    pub fn strata(&self) -> &[Stratum] {
        &self.strata
    }

    /// Errors where the number is `at`: between two strata by the logarithm, outside them the
    /// outermost.
    pub fn at(&self, at: f64) -> Stratum {
        if at == f64::INFINITY {
            return self.strata[self.strata.len() - 1];
        }

        let after = self.strata.partition_point(|stratum| stratum.at <= at);
        let (Some(low), Some(high)) = (
            after.checked_sub(1).map(|i| self.strata[i]),
            self.strata.get(after),
        ) else {
            // Before the first, behind the last, or not a number: the largest errors are the safe
            // answer to the last.
            let outermost = if after == 0 && !at.is_nan() {
                0
            } else {
                self.strata.len() - 1
            };
            return self.strata[outermost];
        };

        let share = (at / low.at).ln() / (high.at / low.at).ln();
        Stratum {
            at,
            gain: low.gain + share * (high.gain - low.gain),
            // A sum of two positive definite matrices with shares of 0 to 1 is positive definite.
            covariance: low.covariance * (1.0 - share) + high.covariance * share,
        }
    }
}

/// Covariances of read motions, Σ = (u + u₀) S(n): they grow with the squared length u of the
/// latents' difference, with an exponent of 1 within a few hundredths, and with the frames n in
/// between, since over few of them u is mostly flicker.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionErrors {
    /// S by the number of frames in between, at 1 and more; on (v, ω), metres and radians.
    pub shapes: ErrorTable,
    /// u₀, above 0: what is read of a camera that stands.
    pub floor: f64,
}

impl MotionErrors {
    /// The covariance of a motion over `frames`, read from latents whose difference has the squared
    /// length `u`.
    pub fn at(&self, u: f64, frames: u64) -> Matrix6<f64> {
        self.shapes.at(frames.max(1) as f64).covariance * (u + self.floor)
    }

    /// That of a motion over as many frames as were measured at most.
    fn longest(&self, u: f64) -> Matrix6<f64> {
        self.shapes.at(f64::INFINITY).covariance * (u + self.floor)
    }
}

/// What was measured of an adapter's errors in rooms that it did not learn from.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Half the second moment of the differences of latents from one frame to the next, shape (c,
    /// c).
    pub flicker: Array2<f64>,
    /// Second moment of the differences of latents over the motions it was trained for, shape (c,
    /// c).
    pub spread: Array2<f64>,
    /// Errors of read motions; lengths are in `spread`.
    pub motion: MotionErrors,
    /// Errors of a retrieved pose by its distance in `flicker`.
    pub anchor: ErrorTable,
    /// The distance from a room over the room's own, above which a frame looks like another place.
    pub foreign: f64,
    /// That below which hardly a frame of another room is.
    pub sure: f64,
    /// The distance in `flicker` from the nearest of the last frames, above which a view jumped.
    pub jump: f64,
    /// What the covariances of places that a tracker just corrected have to be multiplied with to
    /// be those of its errors.
    pub place: f64,
}

/// An adapter's errors in rooms that it did not learn from, as a tracker asks for them.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    measured: Measured,
    flicker: Metric,
    spread: Metric,
}

/// Lengths of latent differences under a covariance: √(dᵀ Σ⁻¹ d).
#[derive(Debug, Clone, PartialEq)]
pub struct Metric {
    /// L⁻¹ with Σ = L Lᵀ.
    whitener: Array2<f64>,
}

impl Metric {
    /// The metric of a covariance, shape (c, c).
    ///
    /// # Errors
    /// [`Error::Calibration`] when it is not symmetric and positive definite.
    pub fn new(covariance: ArrayView2<'_, f64>) -> Result<Self, Error> {
        let wrong = Error::Calibration {
            what: "a covariance of latents",
        };

        let size = covariance.nrows();
        if size == 0 || covariance.ncols() != size || covariance.iter().any(|x| !x.is_finite()) {
            return Err(wrong);
        }

        let matrix = nalgebra::DMatrix::from_fn(size, size, |i, j| covariance[(i, j)]);
        if (&matrix - matrix.transpose()).amax() > 1e-9 * matrix.amax() {
            return Err(wrong);
        }

        let lower = Cholesky::new(matrix).ok_or(wrong.clone())?.unpack();
        let inverse = lower.try_inverse().ok_or(wrong)?;
        let whitener = Array2::from_shape_fn((size, size), |at| inverse[at]);

        Ok(Self { whitener })
    }

    /// Columns of the latents it measures.
    pub fn size(&self) -> usize {
        self.whitener.nrows()
    }

    /// Rows (n, c) in coordinates whose L2 distance is this metric's.
    pub fn whitened(&self, rows: ArrayView2<'_, f64>) -> Array2<f64> {
        rows.dot(&self.whitener.t())
    }

    /// The squared length of a difference, shape (c,).
    pub fn squared_length(&self, difference: ArrayView1<'_, f64>) -> f64 {
        self.whitener.dot(&difference).mapv(|x| x * x).sum()
    }
}

impl Calibration {
    /// Checks what was measured.
    ///
    /// # Errors
    /// [`Error::Calibration`].
    pub fn new(measured: Measured) -> Result<Self, Error> {
        let flicker = Metric::new(measured.flicker.view())?;
        let spread = Metric::new(measured.spread.view())?;
        if flicker.size() != spread.size() {
            return Err(Error::Calibration {
                what: "the size of a covariance of latents",
            });
        }

        for (what, value) in [
            ("the floor of motions", measured.motion.floor),
            ("the factor of places", measured.place),
            ("the limit of a room", measured.foreign),
            ("the sure limit of a room", measured.sure),
            ("the length of a jump", measured.jump),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::Calibration { what });
            }
        }

        Ok(Self {
            measured,
            flicker,
            spread,
        })
    }

    /// What was measured.
    pub fn measured(&self) -> &Measured {
        &self.measured
    }

    /// How latents flicker from one frame to the next: the metric of matches.
    pub fn flicker(&self) -> &Metric {
        &self.flicker
    }

    /// The covariance of a motion over so many frames, read over a difference of latents, shape
    /// (c,).
    pub fn motion_errors(&self, difference: ArrayView1<'_, f64>, frames: u64) -> Matrix6<f64> {
        self.measured
            .motion
            .at(self.spread.squared_length(difference), frames)
    }

    /// The squared length of a difference of latents, shape (c,), against those over the motions
    /// that were trained for.
    pub fn spread_length(&self, difference: ArrayView1<'_, f64>) -> f64 {
        self.spread.squared_length(difference)
    }

    /// The most frames that motions' errors were measured over.
    pub fn longest_frames(&self) -> f64 {
        let strata = self.measured.motion.shapes.strata();
        strata[strata.len() - 1].at
    }

    /// That of a motion of which nothing is known but that it is one of those the adapter was
    /// trained for.
    pub fn unread_errors(&self) -> Matrix6<f64> {
        // The mean squared length of a difference under its own second moment is the number of its
        // columns.
        self.measured.motion.longest(self.spread.size() as f64)
    }

    /// Errors of a pose found by retrieval at a distance in [`Calibration::flicker`].
    pub fn anchor_errors(&self, distance: f64) -> Stratum {
        self.measured.anchor.at(distance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stratum(at: f64, variance: f64) -> Stratum {
        Stratum {
            at,
            gain: at,
            covariance: Matrix6::from_diagonal_element(variance),
        }
    }

    /// Oracle: by hand: half way between 1 and 100 by the logarithm is 10.
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

    /// Oracle: by hand: variances 4 and 9, a difference of (2, 3) is √2 long.
    #[test]
    fn a_metric_measures_in_deviations() {
        let metric = Metric::new(ndarray::array![[4.0, 0.0], [0.0, 9.0]].view()).unwrap();
        let difference = ndarray::array![2.0, 3.0];
        assert!((metric.squared_length(difference.view()) - 2.0).abs() < 1e-12);

        let white = metric.whitened(ndarray::array![[2.0, 3.0], [0.0, 0.0]].view());
        assert!(((&white.row(0) - &white.row(1)).mapv(|x| x * x).sum() - 2.0).abs() < 1e-12);
        assert!(Metric::new(ndarray::array![[1.0, 2.0], [2.0, 1.0]].view()).is_err());
        assert!(Metric::new(ndarray::array![[1.0, 0.5], [0.0, 1.0]].view()).is_err());
    }
}
